"""A robot follows a person: within limits and rates, and as near as these let it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gateway.body.kinematics import joint_positions
from gateway.body.retargeting import Retargeter
from gateway.body.rig import load_rig
from gateway.body.robot import RobotFile, load_robot, robot_of
from gateway.body.urdf import read_urdf
from gateway.emulation.rig import dress, move
from gateway.errors import GatewayError, SettingsError
from gateway.frames import SkeletonFrame
from gateway.geometry import quaternion

pytest.importorskip("mink", reason="the extra robot is not installed")
icub_models = pytest.importorskip("icub_models", reason="icub-models is not installed")

SUIT = load_rig("suit_17")
BODY = SUIT.skeleton
WALK = move(dress(SUIT), BODY.name, 3)
ICUB = Path(icub_models.get_model_file("iCubGazeboV2_7"))
ARM = Path(__file__).parents[2] / "data" / "arm6.urdf"
ARM_FILE = {
    "base": "thorax",
    "links": {
        "tool0": {
            "segment": "right_hand",
            "orientation": 0.0,
            "reach": 1.0,
            "start": "right_upper_arm",
            "start_link": "shoulder_link",
        }
    },
}


def frame(k: int, q_wb, period_ns: int = 10_000_000) -> SkeletonFrame:
    n = len(q_wb)
    p_w = joint_positions(BODY.parents, BODY.offsets, np.ascontiguousarray(q_wb), np.array([1.0, 2.0, 0.95]))
    zeros = np.zeros((n, 3))
    return SkeletonFrame(
        k, 1_000_000_000 + k * period_ns, q_wb, zeros, zeros, p_w, np.zeros(n), np.zeros(n, np.uint8), 0
    )


def walked(seconds: float, rate: float = 100.0):
    for k in range(round(seconds * rate)):
        yield frame(k, WALK.state(np.array([k / rate])).q_wb[0], round(1e9 / rate))


def icub() -> Retargeter:
    return Retargeter(load_robot("icub", BODY, ICUB), BODY)


def test_icub_walks_along_within_limits_and_rates():
    solver = icub()
    poses = [solver.solve(one) for one in walked(8.0)]
    angles = np.array([pose.angles for pose in poses])
    low, high = solver.robot.limits.T
    assert ((angles >= low) & (angles <= high)).all()
    steps = np.abs(np.diff(angles, axis=0)) / 0.01
    assert (steps <= solver.robot.rates * (1 + 1e-9)).all()
    np.testing.assert_allclose(np.diff(angles, axis=0) / 0.01, [pose.rates for pose in poses[1:]], atol=1e-9)
    errors = np.degrees([pose.errors for pose in poses])
    assert np.median(errors) < 2.0
    assert np.mean(errors[200:]) < 3.0


@pytest.mark.parametrize("joint", ["l_knee", "r_hip_pitch", "l_shoulder_roll", "neck_yaw"])
def test_links_turn_as_segments_do(joint):
    """One joint of the robot turned: a person posed as its links then are is answered by that joint alone."""
    solver = icub()
    j = solver.robot.joint_names.index(joint)
    low, high = np.clip(solver.robot.limits[j], -1.0, 1.0)
    wanted = np.clip(solver.robot.neutral, *solver.robot.limits.T)
    wanted[j] = 0.5 * (low + high) if abs(low + high) > 0.2 else 0.5 * high
    twin = icub()
    twin._configuration.update(wanted)
    q_wb = np.tile(BODY.neutral, (BODY.n_segments, 1))
    to_world = twin._turn
    for i, link in enumerate(twin._links):
        turn = quaternion.multiply(twin._orientation(link), quaternion.conjugate(twin._neutral[i]))
        turn = quaternion.multiply(to_world, quaternion.multiply(turn, quaternion.conjugate(to_world)))
        q_wb[twin._segments[i]] = quaternion.multiply(turn, BODY.neutral)
    for k in range(300):
        pose = solver.solve(frame(k, q_wb))
    assert np.nanmax(pose.errors) < np.radians(1.0)
    np.testing.assert_allclose(pose.angles, wanted, atol=np.radians(2.0))


def test_the_base_stands_on_its_lower_sole_over_the_person():
    solver = icub()
    pose = solver.solve(frame(0, np.tile(BODY.neutral, (BODY.n_segments, 1))))
    robots_leg = pose.base_position[2]
    assert 0.4 < robots_leg < 0.7  # of a robot of one metre
    np.testing.assert_allclose(pose.base_position[:2], solver._scale * np.array([1.0, 2.0]))
    forward = quaternion.rotate(pose.base_orientation, np.array([-1.0, 0, 0]))
    np.testing.assert_allclose(forward, [1, 0, 0], atol=1e-6)


def test_what_is_not_known_keeps_its_posture_and_a_lost_base_gives_no_pose():
    solver = icub()
    q_wb = np.tile(BODY.neutral, (BODY.n_segments, 1))
    for k in range(20):
        before = solver.solve(frame(k, q_wb))
    q_wb = q_wb.copy()
    q_wb[BODY.index("left_hand")] = np.nan
    pose = solver.solve(frame(21, q_wb))
    hand = list(solver.robot.file.links).index("l_hand")
    assert np.isnan(pose.errors[hand])
    assert np.isfinite(np.delete(pose.errors, hand)).all()
    np.testing.assert_allclose(pose.angles, before.angles, atol=0.02)
    q_wb[BODY.index("pelvis")] = np.nan
    assert solver.solve(frame(22, q_wb)) is None
    assert solver.solve(frame(21, np.tile(BODY.neutral, (BODY.n_segments, 1)))) is None


def test_a_leap_is_followed_no_faster_than_joints_may():
    solver = icub()
    neutral = np.tile(BODY.neutral, (BODY.n_segments, 1))
    before = solver.solve(frame(0, neutral))
    leapt = neutral.copy()
    turn = quaternion.from_rotation_vector(np.array([0.0, -1.2, 0.0]))
    leapt[BODY.index("left_thigh")] = quaternion.multiply(turn, BODY.neutral)
    for k in range(1, 6):
        pose = solver.solve(frame(k, leapt))
        assert (np.abs(pose.angles - before.angles) <= solver.robot.rates * 0.01 * (1 + 1e-9)).all()
        before = pose
    late = solver.solve(frame(600, leapt))  # seconds later: as after a tenth of one
    assert (np.abs(late.angles - before.angles) <= solver.robot.rates * 0.1 * (1 + 1e-9)).all()


def test_an_arm_reaches_as_the_person_does():
    robot = robot_of(read_urdf(ARM.read_text()), RobotFile.model_validate(ARM_FILE), BODY, "arm.yaml")
    solver = Retargeter(robot, BODY)
    q_wb = np.tile(BODY.neutral, (BODY.n_segments, 1))
    forward = quaternion.from_rotation_vector(np.array([0.0, -0.9, 0.0]))
    bent = quaternion.from_rotation_vector(np.array([0.0, -2.5, 0.3]))
    q_wb[BODY.index("right_upper_arm")] = quaternion.multiply(forward, BODY.neutral)
    q_wb[BODY.index("right_forearm")] = quaternion.multiply(bent, BODY.neutral)
    q_wb[BODY.index("right_hand")] = q_wb[BODY.index("right_forearm")]
    for k in range(500):
        one = frame(k, q_wb)
        pose = solver.solve(one)
    reach = solver._reaches[0]
    wanted = reach.scale * (one.p_w[reach.segment] - one.p_w[reach.start])
    found = solver._site("tool0").translation() - solver._site("shoulder_link").translation()
    np.testing.assert_allclose(found, wanted, atol=0.01)
    assert pose.base_position is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base": "trunk"}, "'trunk' is no segment of body 'human_17'"),
        (
            {"links": {"wrist_3": "right_hand"}},
            "'wrist_3' is no link of the robot (did you mean 'wrist_3_link'?)",
        ),
        ({"links": {"tool0": "right_hnd"}}, "right_hand"),
        ({"neutral_deg": {"elbow": 3}}, "'elbow' is no turning joint of the robot"),
        ({"soles": ["foot"]}, "'foot' is no link"),
    ],
)
def test_wrong_names_are_named(change, message):
    file = RobotFile.model_validate({**ARM_FILE, **change})
    with pytest.raises(SettingsError, match=re.escape(message)):
        robot_of(read_urdf(ARM.read_text()), file, BODY, "arm.yaml")


def test_a_robot_file_is_read_with_its_urdf(tmp_path):
    (tmp_path / "arm.yaml").write_text("{urdf: arm.urdf, base: thorax, links: {tool0: right_hand}}")
    with pytest.raises(SettingsError, match="no such file"):
        load_robot(str(tmp_path / "arm.yaml"), BODY)
    (tmp_path / "arm.urdf").write_text(ARM.read_text())
    robot = load_robot(str(tmp_path / "arm.yaml"), BODY)
    assert robot.file.links["tool0"].segment == "right_hand"
    assert robot.rates[robot.joint_names.index("shoulder_pan_joint")] == 3.15
    with pytest.raises(SettingsError, match=r"outputs\.retarget\.urdf"):
        load_robot("icub", BODY)
    with pytest.raises(SettingsError, match="icub"):
        load_robot("icab", BODY)
    (tmp_path / "arm.yaml").write_text("{base: head, links: {tool0: {segment: head, reach: 1}}}")
    with pytest.raises(SettingsError, match="start"):
        load_robot(str(tmp_path / "arm.yaml"), BODY)


def test_a_start_that_the_link_does_not_hang_from_is_refused():
    file = RobotFile.model_validate(ARM_FILE)
    entry = file.links["tool0"].model_copy(update={"start": "left_upper_arm"})
    robot = robot_of(read_urdf(ARM.read_text()), file, BODY, "arm.yaml")
    other = replace(robot, file=file.model_copy(update={"links": {"tool0": entry}}))
    with pytest.raises(GatewayError, match="name a start that it hangs from"):
        Retargeter(other, BODY)
