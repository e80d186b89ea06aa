"""Wands that do not stand in the plane of joint axis and bone: the angle is told, the centre is met."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from devices.marker_files import MarkerTrial, read_markers
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.reconstruction.optical import point_rules
from gateway.reconstruction.optical.landmarks import Landmarks, landmarks_of, measurements
from gateway.reconstruction.optical.marker_set import load_marker_set

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[5] / "shared" / "data"))
TRIAL = DATA / "c3d_pycgm" / "Static_trial.c3d"
needs_data = pytest.mark.skipif(not TRIAL.is_file(), reason="no recordings: set MOCAP_DATA")
seeded = settings(deadline=None, derandomize=True, max_examples=200)
length = st.floats(0.02, 0.5)
angle = st.floats(-1.5, 1.5)


def turned(points: FloatArray, origin: FloatArray, end: FloatArray, by: float) -> FloatArray:
    """(F, 3) about the line from origin to end, (F, 3) each, right-handed."""
    axes = point_rules.unit(end - origin)
    rotated: FloatArray = origin + Rotation.from_rotvec(by * axes).apply(points - origin)
    return rotated


@seeded
@given(st.integers(0, 1000), length, length, length, st.floats(-0.1, 1.1), angle)
def test_the_centre_is_met_from_a_wand_at_any_angle(seed, bone, width, reach, height, by):
    pose = Rotation.random(random_state=seed)
    hip = np.array([[0.0, 0.0, bone]])
    marker, wand = np.array([[width, 0.0, 0.0]]), np.array([[reach, 0.0, height * bone]])
    wand = turned(wand, np.zeros((1, 3)), hip, by)
    hip, marker, wand, centre = (pose.apply(each) + 0.3 for each in (hip, marker, wand, np.zeros((1, 3))))
    to_marker, to_wand = point_rules.unit(marker - hip), point_rules.unit(wand - hip)
    assume(
        np.arccos(np.clip(np.sum(to_marker * to_wand), -1.0, 1.0)) > np.arctan2(width, bone) + 0.01
    )  # else there are two
    found = point_rules.chord(hip, marker, wand, width, by)
    np.testing.assert_allclose(found, centre, atol=1e-7)


@seeded
@given(st.integers(0, 1000), length)
def test_no_angle_changes_nothing(seed, distance):
    points = np.random.default_rng(seed).normal(size=(3, 5, 3))
    plain = point_rules.chord(*points, distance)
    np.testing.assert_array_equal(point_rules.chord(*points, distance, 0.0), plain)
    np.testing.assert_allclose(point_rules.chord(*points, distance, 1e-9), plain, atol=1e-6)


def test_a_wand_that_no_centre_explains_gives_none():
    hip, marker = np.array([[0.0, 0.0, 0.4]]), np.array([[0.05, 0.0, 0.0]])
    near_the_line = np.array([[0.0251, 0.001, 0.2]])
    assert np.isnan(point_rules.chord(hip, marker, near_the_line, 0.05, 1.2)).all()


def landmarks(trial: MarkerTrial) -> Landmarks:
    marker_set = load_marker_set("plug_in_gait")
    return landmarks_of(marker_set, trial, "z", measurements(marker_set, [trial], {}))


def shifted_wand(
    trial: MarkerTrial, label: str, centre: FloatArray, upper: FloatArray, by: float
) -> MarkerTrial:
    positions = trial.positions.copy()
    m = trial.labels.index(label)
    positions[:, m] = turned(positions[:, m], centre, upper, by)
    return replace(trial, positions=positions)


@needs_data
@pytest.mark.parametrize("ahead", [0.2, -0.15])
def test_wands_turned_forwards_on_both_legs_leave_centres_where_they_were(ahead):
    """A positive angle is a wand ahead of the axis: to the left's right and the right's left, from above."""
    trial = read_markers(TRIAL)
    before, moved, told = landmarks(trial), trial, {}
    bones = (("knee", "hip", "THI", "THIGHROTATION"), ("ankle", "knee", "TIB", "SHANKROTATION"))
    for side, letter, turn in (("left", "L", -ahead), ("right", "R", ahead)):
        for joint, upper, wand, parameter in bones:
            centre, above = before.point(f"{side}_{joint}"), before.point(f"{side}_{upper}")
            moved = shifted_wand(moved, letter + wand, centre, above, turn)
            told[letter + parameter] = ahead
    blind = landmarks(moved)
    after = landmarks(replace(moved, parameters=trial.parameters | told))
    for point in ("left_knee", "right_knee", "left_ankle", "right_ankle"):
        np.testing.assert_allclose(after.point(point), before.point(point), atol=1e-7)
        assert np.nanmin(np.linalg.norm(blind.point(point) - before.point(point), axis=1)) > 0.002
    ahead_of = moved.positions[:, moved.labels.index("LTHI")] - trial.positions[:, trial.labels.index("LTHI")]
    pelvis = before.axes("pelvis")
    assert pelvis is not None
    assert (np.sign(np.sum(ahead_of * pelvis[:, :, 0], axis=1)) == np.sign(ahead)).all()


@needs_data
def test_angles_told_are_checked():
    marker_set, trial = load_marker_set("plug_in_gait"), read_markers(TRIAL)
    assert set(measurements(marker_set, [trial], {}).angles.values()) == {0.0}
    with pytest.raises(GatewayError, match="no angle 'left_thig_rotation'"):
        measurements(marker_set, [trial], {}, {"left_thig_rotation": 0.1})
    degrees = replace(trial, parameters=trial.parameters | {"LTHIGHROTATION": 8.0})
    with pytest.raises(GatewayError, match="LTHIGHROTATION is 8 rad"):
        measurements(marker_set, [degrees], {})
    given_anyhow = measurements(marker_set, [degrees], {}, {"left_thigh_rotation": 0.14})
    assert given_anyhow.angles["left_thigh_rotation"] == 0.14
