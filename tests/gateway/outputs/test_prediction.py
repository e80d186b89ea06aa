"""Predicted poses against motions whose future is known."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import orjson
import ormsgpack
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from gateway.body.kinematics import joint_positions
from gateway.body.rig import load_rig
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import PredictedPoseMessage
from gateway.contract.topics import Topics
from gateway.frames import SkeletonFrame, Status
from gateway.outputs.pose_encoding import PosePublications
from gateway.outputs.prediction import PosePredictor
from gateway.outputs.settings import LONGEST_HORIZON_MS, MqttSettings, PoseFormat, PoseMap

BEGUN_NS = 1_700_000_000_000_000_000
NAMES = ("pelvis", "left_thigh", "left_shank")
OFFSETS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, -0.4, 0]])
SKELETON = Skeleton("leg", NAMES, np.array([-1, 0, 1]), OFFSETS, np.array([[0.0, 0.1, 0]] * 3))


class Swing:
    """Segments that swing about fixed axes, each at its own frequency, while the pelvis travels."""

    axes = np.array([[1.0, 0, 0], [0, 0.6, 0.8], [0, 0, 1.0]])
    hertz = np.array([0.5, 1.0, 1.5])
    amplitude = np.array([0.4, 0.6, 0.8])  # rad
    speed = np.array([1.0, 0.5, 0.0])  # m/s

    def frame(self, t: float, status: tuple[Status, ...] = (Status.MEASURED,) * 3) -> SkeletonFrame:
        turn = 2 * np.pi * self.hertz
        angle = self.amplitude * np.sin(turn * t)
        rate = self.amplitude * turn * np.cos(turn * t)
        q_wb = Rotation.from_rotvec(self.axes * angle[:, None]).as_quat(scalar_first=True)
        return SkeletonFrame(
            sequence=round(t * 1000),
            time_ns=BEGUN_NS + round(t * 1e9),
            q_wb=q_wb,
            angular_rate=self.axes * rate[:, None],
            joint_acceleration=np.zeros((3, 3)),
            p_w=joint_positions(SKELETON.parents, OFFSETS, q_wb, self.speed * t),
            sigma=np.full(3, 0.01),
            status=np.array(status, np.uint8),
            root=0,
        )


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    turns = Rotation.from_quat(a, scalar_first=True).inv() * Rotation.from_quat(b, scalar_first=True)
    return turns.magnitude()


def errors_of(ahead_s: float, rate_hz: float = 100.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of predictions, of the poses taken as they are, and what grew on sigma; each (T, 3), rad."""
    swing, predictor = Swing(), PosePredictor(SKELETON, ahead_s)
    off, held, grown = [], [], []
    for k in range(round(3 * rate_hz)):
        t = k / rate_hz
        frame = swing.frame(t)
        found = predictor.predict(frame).frame
        later = swing.frame(t + ahead_s)
        off.append(angles(found.q_wb, later.q_wb))
        held.append(angles(frame.q_wb, later.q_wb))
        grown.append(np.sqrt(found.sigma**2 - frame.sigma**2))
    return np.array(off), np.array(held), np.array(grown)


@pytest.mark.parametrize(("ahead_s", "share"), [(0.01, 0.02), (0.02, 0.05), (0.05, 0.15)])
@pytest.mark.parametrize("rate_hz", [60.0, 100.0, 285.0])
def test_a_swing_is_predicted_far_better_than_by_the_pose_as_it_is(ahead_s, share, rate_hz):
    off, held, _ = errors_of(ahead_s, rate_hz)
    assert np.sqrt(np.mean(off**2)) < share * np.sqrt(np.mean(held**2))


@pytest.mark.parametrize("ahead_s", [0.02, 0.05])
def test_sigma_grows_by_what_predictions_were_off(ahead_s):
    off, _, grown = errors_of(ahead_s)
    late = slice(100, None)
    rms = np.sqrt(np.mean(off[late] ** 2, axis=0))
    np.testing.assert_allclose(np.sqrt(np.mean(grown[late] ** 2, axis=0)), rms, rtol=0.25)
    assert np.mean(off[late] < 2 * grown[late]) > 0.9


def test_a_further_horizon_is_less_certain():
    near, far = (errors_of(ahead_s)[2][-1] for ahead_s in (0.01, 0.05))
    assert (far > 2 * near).all()


def test_a_body_at_rest_stays_where_it_is():
    predictor = PosePredictor(SKELETON, 0.05)
    still = replace(Swing().frame(0.3), angular_rate=np.zeros((3, 3)))
    for k in range(5):
        found = predictor.predict(replace(still, time_ns=BEGUN_NS + k * 10_000_000)).frame
    np.testing.assert_allclose(found.q_wb, still.q_wb, atol=1e-15)
    np.testing.assert_allclose(found.p_w, still.p_w, atol=1e-15)
    np.testing.assert_allclose(found.sigma, still.sigma, atol=1e-12)


def test_joints_go_where_the_segments_will_be():
    swing, predictor = Swing(), PosePredictor(SKELETON, 0.02)
    for k in range(60):
        found = predictor.predict(swing.frame(k * 0.01))
    assert found.frame.time_ns - found.measured_ns == 20_000_000
    np.testing.assert_allclose(found.frame.p_w, swing.frame(0.61).p_w, atol=0.01)
    expected = joint_positions(SKELETON.parents, OFFSETS, found.frame.q_wb, found.frame.p_w[0])
    np.testing.assert_allclose(found.frame.p_w, expected, atol=1e-12)


def test_the_angular_rate_is_that_of_the_instant():
    swing, predictor = Swing(), PosePredictor(SKELETON, 0.02)
    for k in range(30):
        found = predictor.predict(swing.frame(k * 0.01)).frame
    later, now = swing.frame(0.31).angular_rate, swing.frame(0.29).angular_rate
    assert np.linalg.norm(found.angular_rate - later) < 0.5 * np.linalg.norm(now - later)


@pytest.mark.parametrize("status", Status)
def test_only_what_is_of_this_instant_moves_on(status):
    swing, predictor = Swing(), PosePredictor(SKELETON, 0.02)
    for k in range(10):
        frame = swing.frame(k * 0.01, (Status.MEASURED, status, Status.MEASURED))
        found = predictor.predict(frame).frame
    stays = status in (Status.HELD, Status.MISSING, Status.WARMING_UP)
    assert (angles(found.q_wb, frame.q_wb)[1] < 1e-9) == stays
    told = Status.PREDICTED if status in (Status.MEASURED, Status.INTERPOLATED) else status
    assert found.status.tolist() == [Status.PREDICTED, told, Status.PREDICTED]


def test_a_segment_without_a_rate_turns_with_its_parent_or_is_held():
    swing, predictor = Swing(), PosePredictor(SKELETON, 0.02)
    for k in range(10):
        frame = swing.frame(k * 0.01)
        frame.angular_rate[[0, 2]] = np.nan
        found = predictor.predict(frame).frame
    assert found.status.tolist() == [Status.HELD, Status.PREDICTED, Status.PREDICTED]
    np.testing.assert_array_equal(found.q_wb[0], frame.q_wb[0])
    parent, child = (
        Rotation.from_quat(found.q_wb[s], scalar_first=True)
        * Rotation.from_quat(frame.q_wb[s], scalar_first=True).inv()
        for s in (1, 2)
    )
    np.testing.assert_allclose(child.as_matrix(), parent.as_matrix(), atol=1e-12)
    assert np.isnan(found.angular_rate[2]).all()


def test_what_is_not_known_stays_unknown():
    predictor = PosePredictor(SKELETON, 0.02)
    frame = Swing().frame(0.1)
    frame.q_wb[2], frame.sigma[:], frame.p_w[:] = np.nan, np.nan, np.nan
    found = predictor.predict(frame).frame
    assert np.isnan(found.q_wb[2]).all()
    assert np.isnan(found.sigma).all()
    assert np.isnan(found.p_w).all()
    assert np.isfinite(found.q_wb[:2]).all()


@pytest.mark.parametrize("step_s", [-1.0, 0.0, 5.0])
def test_after_a_gap_or_a_step_back_nothing_of_before_is_used(step_s):
    swing, predictor = Swing(), PosePredictor(SKELETON, 0.05)
    for k in range(50):
        predictor.predict(swing.frame(1.0 + k * 0.01))
    afterwards = swing.frame(1.49 + step_s)
    fresh = PosePredictor(SKELETON, 0.05).predict(afterwards)
    found = predictor.predict(afterwards)
    np.testing.assert_array_equal(found.frame.q_wb, fresh.frame.q_wb)
    np.testing.assert_array_equal(found.frame.sigma, fresh.frame.sigma)
    np.testing.assert_array_equal(found.frame.p_w, fresh.frame.p_w)


@pytest.mark.parametrize(("late_ms", "ahead_ms"), [(0, 0), (17, 17), (3000, LONGEST_HORIZON_MS), (-5, 0)])
def test_up_to_the_instant_of_publishing_within_bounds(late_ms, ahead_ms):
    frame = Swing().frame(0.2)
    predictor = PosePredictor(SKELETON, None, lambda: frame.time_ns + late_ms * 1_000_000)
    found = predictor.predict(frame)
    assert (found.frame.time_ns - found.measured_ns) * 1e-6 == pytest.approx(ahead_ms)


def test_a_frame_of_another_skeleton_is_refused():
    with pytest.raises(ValueError, match="17"):
        PosePredictor(load_rig("suit_17").skeleton, 0.02).predict(Swing().frame(0.0))


@pytest.mark.parametrize("formats", [{"json"}, {"msgpack"}, {"json", "msgpack"}])
@pytest.mark.parametrize("include", [set(), set(PoseMap)])
def test_predictions_are_published_beside_the_poses(formats, include):
    settings = MqttSettings(predict_ms=20, pose_formats=formats, include=include)
    publications = PosePublications(settings, SKELETON, Topics("mocap", "lab"))
    for k in range(3):
        made = {each.topic: each.payload for each in publications.of(Swing().frame(k * 0.01))}
    topics = {
        PoseFormat.JSON: "mocap/lab/pose/predicted",
        PoseFormat.MSGPACK: "mocap/lab/pose/predicted/msgpack",
    }
    read = {PoseFormat.JSON: orjson.loads, PoseFormat.MSGPACK: ormsgpack.unpackb}
    assert len(made) == 2 * len(formats)
    for word in formats:
        found = PredictedPoseMessage.model_validate(read[PoseFormat(word)](made[topics[PoseFormat(word)]]))
        assert found.t_ns == BEGUN_NS + 40_000_000
        assert found.predicted_from_ns == BEGUN_NS + 20_000_000
        assert set(found.status.values()) == {"predicted"}
        assert (found.sigma is not None) == bool(include)


def test_without_being_asked_for_there_are_none():
    publications = PosePublications(MqttSettings(), SKELETON, Topics("mocap", "lab"))
    assert [each.topic for each in publications.of(Swing().frame(0.0))] == ["mocap/lab/pose"]


@pytest.mark.parametrize("wrong", [0, -5, 101, float("nan"), "soon"])
def test_horizons_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValidationError, match="predict_ms"):
        MqttSettings(predict_ms=wrong)


def test_frames_that_come_irregularly_are_predicted_as_well():
    swing, predictor = Swing(), PosePredictor(SKELETON, 0.02)
    times = np.cumsum(np.random.default_rng(5).choice([0.01, 0.02, 0.05], 200))
    off = []
    for before, now in pairwise(times):
        assert now > before
        off.append(angles(predictor.predict(swing.frame(now)).frame.q_wb, swing.frame(now + 0.02).q_wb))
    assert np.sqrt(np.mean(np.square(off))) < np.radians(0.5)
