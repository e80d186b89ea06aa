"""The published method as a user has it: a trial in, a recording out, and refused where it would stream."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from devices.marker_files import MarkerTrial
from devices.recording_file import RecordingError
from gateway.body.body_file import WorldSettings, load_body, worn_without_modules
from gateway.body.skeleton import BodyMarkers, WornSuit
from gateway.cli.optical import optical_app
from gateway.errors import GatewayError
from gateway.frames import FloatArray, Status
from gateway.geometry import quaternion
from gateway.geometry import rotation_matrix as rm
from gateway.reconstruction import BOTH_WAYS, PUBLISHED
from gateway.reconstruction.optical import kernels
from gateway.recording import open_recording
from gateway.recording.optical import SolvedTrial, write_solved_trial
from gateway.recording.solving import verify
from gateway.report import gather, write_report

N_FRAMES, RATE_HZ, HIDDEN = 10, 50.0, 9


def _subject() -> WornSuit:
    body = load_body("human_17")
    segments = np.repeat(np.arange(body.n_segments), 4)
    places = np.random.default_rng(5).normal(0.0, 0.08, (len(segments), 3))
    labels = tuple(f"m{i}" for i in range(len(segments)))
    markers = BodyMarkers(labels, segments, places, np.full(len(segments), 0.004))
    return worn_without_modules(body, markers, WorldSettings())


def _truth(suit: WornSuit) -> FloatArray:
    """(F, S, 3, 3): all segments turn about the vertical, the left arm also upwards."""
    body = suit.skeleton
    neutral = quaternion.to_matrix(body.neutral)
    poses = np.empty((N_FRAMES, body.n_segments, 3, 3))
    for f in range(N_FRAMES):
        turned = rm.from_rotation_vector(np.array([0.0, 0.0, 0.02 * f]))
        poses[f] = turned @ neutral
        raised = turned @ rm.from_rotation_vector(np.array([0.0, -0.03 * f, 0.0])) @ neutral
        poses[f, [body.index(f"left_{name}") for name in ("upper_arm", "forearm", "hand")]] = raised
    return poses


def _trial(suit: WornSuit, truth: FloatArray) -> MarkerTrial:
    body, markers = suit.skeleton, suit.markers
    assert markers is not None
    positions = np.empty((N_FRAMES, len(markers.labels), 3))
    for f, R in enumerate(truth):
        p = kernels.places(body.parents, body.offsets, R, np.array([0.01 * f, 0.0, 0.95]))
        positions[f] = kernels.marker_places(markers.segments, markers.positions, R, p)
    positions[3, HIDDEN] = np.nan
    positions[5, markers.segments == body.index("left_hand")] = np.nan
    return MarkerTrial("walk", markers.labels, RATE_HZ, positions)


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> tuple[WornSuit, SolvedTrial]:
    folder = tmp_path_factory.mktemp("published")
    source = folder / "walk.c3d"
    source.write_bytes(b"whatever it is: only its name and sum are kept")
    suit = _subject()
    done = write_solved_trial(
        _trial(suit, _truth(suit)), source, suit, "anna.yaml", folder / "walk.mcap", method=PUBLISHED
    )
    return suit, done


def test_its_recording_holds_the_truth_and_says_what_was_measured(solved):
    suit, done = solved
    arrays = open_recording(done.path).skeleton_arrays()
    assert done.frames == len(arrays.time_ns) == N_FRAMES
    for q_wb, truth in zip(arrays.q_wb, _truth(suit), strict=True):
        for q, true in zip(q_wb, truth, strict=True):
            assert np.degrees(quaternion.angle_between(q, quaternion.from_matrix(true))) < 1.0
    assert done.rmse < 0.002
    assert np.isnan(done.residuals[3, HIDDEN])
    hand = suit.skeleton.index("left_hand")
    assert arrays.status[5, hand] == Status.PREDICTED
    assert (np.delete(arrays.status, 5, axis=0) == Status.MEASURED).all()
    assert arrays.rate_hz == pytest.approx(RATE_HZ)


def test_its_recording_cannot_be_verified_and_says_so(solved):
    recording = open_recording(solved[1].path)
    assert recording.meta.solved_by == "published"
    assert recording.meta.suit.markers is not None
    with pytest.raises(RecordingError, match="offline method 'published'"):
        verify(recording)


def test_its_page_tells_poses_and_no_modules(solved, tmp_path):
    pytest.importorskip("matplotlib")
    found = gather(open_recording(solved[1].path))
    assert found.n_poses == N_FRAMES
    assert not found.modules
    write_report(found, tmp_path / "walk.html")
    assert "Joint angles" in (tmp_path / "walk.html").read_text()


def test_a_trial_bridged_both_ways_is_recorded_as_such(tmp_path: Path):
    suit = _subject()
    source, target = tmp_path / "walk.c3d", tmp_path / "walk.mcap"
    source.write_bytes(b"whatever it is")
    done = write_solved_trial(_trial(suit, _truth(suit)), source, suit, "anna.yaml", target, method=BOTH_WAYS)
    recording = open_recording(target)
    arrays = recording.skeleton_arrays()
    assert done.frames == len(arrays.time_ns) == N_FRAMES
    for q_wb, truth in zip(arrays.q_wb, _truth(suit), strict=True):
        for q, true in zip(q_wb, truth, strict=True):
            assert np.degrees(quaternion.angle_between(q, quaternion.from_matrix(true))) < 1.0
    assert np.isnan(done.residuals[3, HIDDEN])
    assert not done.used[3, HIDDEN]
    with pytest.raises(RecordingError, match="offline method 'both_ways'"):
        verify(recording)


def test_nothing_to_solve_is_one_error_and_leaves_no_file(tmp_path: Path):
    suit = _subject()
    trial = _trial(suit, _truth(suit))
    empty = MarkerTrial("walk", trial.labels, RATE_HZ, np.full_like(trial.positions, np.nan))
    target = tmp_path / "walk.mcap"
    with pytest.raises(GatewayError, match=r"no frame shows 3 of the markers of anna.yaml"):
        write_solved_trial(empty, tmp_path / "walk.c3d", suit, "anna.yaml", target, method=PUBLISHED)
    assert not target.exists()


@pytest.mark.parametrize(
    ("command", "method", "message"),
    [
        ("play", "published", "cannot stream"),
        ("play", "both_ways", "cannot stream"),
        ("solve", "publishd", "one of default, both_ways, published"),
    ],
)
def test_a_method_that_cannot_be_is_refused_at_once(command, method, message):
    done = CliRunner().invoke(optical_app, [command, "no.c3d", "-s", "none.yaml", "--method", method])
    assert done.exit_code == 1
    assert message in str(done.exception)
