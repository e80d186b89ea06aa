"""Markers of an optical recording, as the page shows them: read again from the bytes, against the poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.marker_files import MarkerTrial
from gateway.body.body_file import WorldSettings, load_body, worn_without_modules
from gateway.body.skeleton import BodyMarkers
from gateway.geometry import quaternion
from gateway.reconstruction.optical import kernels
from gateway.recording import open_recording
from gateway.recording.optical import write_solved_trial
from gateway.recording.solving import verify

viser = pytest.importorskip("viser", reason="the extra 'viewer' is not installed")

from gateway.viewer.marker_points import (  # noqa: E402 - needs the extra
    FAR,
    LEFT_OUT,
    NEAR,
    recorded_markers,
    residual_colours,
)
from gateway.viewer.playback import Playback  # noqa: E402 - needs the extra

N_FRAMES, GHOST, HIDDEN, OFF_M = 8, 10, 21, 0.2


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A person that stands, with y up in the system's axes; one marker flies away, one is not seen, and a
    nameless point stands far off."""
    folder = tmp_path_factory.mktemp("markers")
    body = load_body("human_17")
    segments = np.repeat(np.arange(body.n_segments), 4)
    places = np.random.default_rng(7).normal(0.0, 0.08, (len(segments), 3))
    labels = tuple(f"m{i}" for i in range(len(segments)))
    markers = BodyMarkers(labels, segments, places, np.full(len(segments), 0.004), "y")
    R = np.tile(quaternion.to_matrix(body.neutral), (body.n_segments, 1, 1))
    p = kernels.places(body.parents, body.offsets, R, np.array([0.5, 0.2, 0.9]))
    standing = kernels.marker_places(segments, places, R, p)
    positions = np.tile(standing, (N_FRAMES, 1, 1))
    positions[4:, GHOST, 2] += OFF_M
    positions[:, HIDDEN] = np.nan
    nameless = np.tile([[2.0, 2.0, 2.0]], (N_FRAMES, 1, 1))
    theirs = np.concatenate([positions, nameless], axis=1)[..., [0, 2, 1]] * [1.0, 1.0, -1.0]
    trial = MarkerTrial("stand", (*labels, "*1"), 100.0, theirs)
    source = folder / "stand.c3d"
    source.write_bytes(b"only its sum is kept")
    suit = worn_without_modules(body, markers, WorldSettings())
    done = write_solved_trial(trial, source, suit, "anna.yaml", Path(folder / "stand.mcap"))
    return open_recording(done.path), standing


def test_markers_stand_where_they_were_with_their_distance_from_the_body(recording):
    opened, standing = recording
    found = recorded_markers(opened, opened.skeleton_arrays())
    assert found is not None
    before, after = found.at(0), found.at(6)
    kept = np.delete(np.arange(len(standing)), HIDDEN)
    np.testing.assert_allclose(before.positions, standing[kept], atol=1e-9)
    np.testing.assert_allclose(before.virtual, standing[kept], atol=0.003)
    np.testing.assert_allclose(before.unlabelled, [[2.0, 2.0, 2.0]], atol=1e-9)
    assert after.residuals[GHOST] == pytest.approx(OFF_M, abs=0.003)
    assert np.delete(after.residuals, GHOST).max() < 0.003
    assert after.summary()[0].endswith("1 left out")
    assert after.summary()[1].startswith(f"farthest, mm: m{GHOST} 2")
    assert "left out" not in before.summary()[0]
    assert [label for label, used in zip(after.labels, after.used, strict=True) if not used] == [f"m{GHOST}"]


def test_a_recording_that_tells_only_what_came_shows_the_same_places(recording):
    opened, _ = recording
    arrays = opened.skeleton_arrays()
    told, received = (
        recorded_markers(opened, each).at(6) for each in (arrays, replace(arrays, markers=None))
    )
    assert told.labels == received.labels
    for name in ("positions", "virtual", "unlabelled"):
        np.testing.assert_allclose(getattr(told, name), getattr(received, name), atol=1e-6)
    assert received.used.all()


def test_markers_out_of_a_recording_are_those_of_its_poses(recording):
    opened, standing = recording
    arrays = opened.skeleton_arrays()
    assert arrays.markers.labels == tuple(f"m{i}" for i in range(len(standing)))
    assert np.isnan(arrays.markers.positions[:, HIDDEN]).all()
    assert not arrays.markers.used[:, HIDDEN].any()
    np.testing.assert_array_equal(arrays.markers.used[:, GHOST], np.arange(N_FRAMES) < 4)
    assert np.nanmax(np.delete(arrays.markers.residuals, [HIDDEN, GHOST], axis=1)) < 0.003
    assert [len(each) for each in arrays.markers.unlabelled] == [1] * N_FRAMES
    assert verify(opened).is_identical


def test_colours_go_from_near_to_far():
    colours = residual_colours(np.array([0.0, 0.004, 0.03, 0.5]))
    assert [tuple(colour) for colour in colours.tolist()] == [NEAR, NEAR, FAR, FAR]


def test_the_page_draws_them_and_hides_them_when_asked(recording):
    opened, _ = recording
    arrays = opened.skeleton_arrays()
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        playback = Playback(server, arrays, "stand", recorded_markers(opened, arrays))
        playback.advance(0.05)
        scene = playback._marker_scene
        n = len(recorded_markers(opened, arrays).at(5).positions)
        assert len(scene._points.points) == n + 1
        assert len(scene._lines.points) == n
        assert tuple(scene._points.colors[GHOST]) == LEFT_OUT
        assert scene._points.visible
        scene._is_wanted.value = False
        playback.advance(0.01)
        assert not scene._points.visible
        assert not scene._lines.visible
    finally:
        server.stop()
