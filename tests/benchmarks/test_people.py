"""Hinges tell of orientations without a reference: on bodies whose orientations are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.people import in_axes_of_readings, plane_of
from devices.recorded_tracks import ModuleTrack, RecordedTracks, ReferenceTrack
from gateway.frames import FloatArray

BONE = np.array([0.0, -0.6, 0.8])


def _wxyz(rotation: Rotation) -> FloatArray:
    q: FloatArray = rotation.as_quat(scalar_first=True)
    return q


def _leg(n: int = 2001) -> tuple[FloatArray, FloatArray]:
    """Return (n, 4) orientations of the modules of a thigh, turning about all axes, and its bending shank.

    The thigh's module sits askew; in axes of the shank's, the bone is ``BONE``.
    """
    times = np.linspace(0.0, 20.0, n)
    turns = np.stack([np.sin(0.3 * times), 0.6 * np.sin(times), 0.5 * np.cos(1.3 * times)], axis=1)
    thigh = Rotation.from_euler("zyx", turns)
    knee = Rotation.from_rotvec(np.outer(0.8 + 0.6 * np.sin(2.0 * times), [0.0, 0.0, 1.0]))
    mounted = Rotation.from_rotvec([0.3, -1.0, 0.7])
    across, _ = Rotation.align_vectors([[1.0, 0.0, 0.0]], [BONE])
    return _wxyz(thigh * mounted), _wxyz(thigh * knee * across)


def test_a_hinge_by_true_orientations_is_plane() -> None:
    q_before, q_beyond = _leg()
    hinge = plane_of(q_before, q_beyond, BONE)
    assert hinge.off_deg < 0.01
    assert hinge.turned_off_deg < 0.01


@pytest.mark.parametrize("turn_deg", [-40.0, 15.0, 100.0])
def test_a_wrong_relative_heading_shows_and_is_found(turn_deg: float) -> None:
    q_before, q_beyond = _leg()
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(turn_deg)])
    turned = _wxyz(turn * Rotation.from_quat(q_beyond, scalar_first=True))
    hinge = plane_of(q_before, turned, BONE)
    assert hinge.off_deg > 2.0
    assert hinge.turned_off_deg < 0.01


def test_one_heading_for_both_changes_nothing() -> None:
    turn = Rotation.from_rotvec([0.0, 0.0, 1.0])
    q_before, q_beyond = (_wxyz(turn * Rotation.from_quat(q, scalar_first=True)) for q in _leg())
    assert plane_of(q_before, q_beyond, BONE).off_deg < 0.01


def test_orientations_are_brought_to_the_axes_of_the_readings() -> None:
    """A maker's orientations in other axes than its readings: gravity tells the rotation between."""
    q, _ = _leg()
    times = np.linspace(0.0, 20.0, len(q))
    true = Rotation.from_quat(q, scalar_first=True)
    force = true.inv().apply([0.0, 0.0, 9.81])
    track = ModuleTrack(1, "left_thigh", times, force, np.zeros((len(q), 3)), np.full((len(q), 3), np.nan))
    other = _wxyz(true * Rotation.from_rotvec([0.4, -1.2, 2.0]))
    other[7] = np.nan
    recording = RecordedTracks("made", 100.0, (track,), (ReferenceTrack("left_thigh", times, other),))
    (found,) = in_axes_of_readings(recording).references
    assert np.isnan(found.q_wb[7]).all()
    known = np.isfinite(found.q_wb).all(axis=1)
    wanted = Rotation.from_quat(q[known], scalar_first=True)
    off = (Rotation.from_quat(found.q_wb[known], scalar_first=True).inv() * wanted).magnitude()
    assert np.size(off) == len(q) - 1
    assert np.max(off) < 1e-6
