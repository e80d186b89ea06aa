"""A robot's URDF as a body: its forward kinematics are the URDF's own."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from gateway.body.body_file import load_body
from gateway.body.joint_angles import JointAngles, posture
from gateway.body.kinematics import joint_positions
from gateway.body.urdf import import_urdf
from gateway.cli.main import app
from gateway.errors import SettingsError

URDF = (Path(__file__).parents[2] / "data" / "arm6.urdf").read_text()
JOINTS = [
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
]
IDENTITY = np.array([1.0, 0, 0, 0])


def loaded(tmp_path, text=URDF, **options):
    robot = import_urdf(text, "arm6.urdf", **options)
    path = tmp_path / "arm6.yaml"
    path.write_text(yaml.safe_dump(robot.content))
    return robot, load_body(str(path))


def urdf_links(angles):
    """Every link's pose in the base by the URDF's own rules, joint after joint."""
    poses = {"base_link": np.eye(4)}
    for joint in ElementTree.fromstring(URDF).findall("joint"):
        origin = joint.find("origin")
        at = np.eye(4)
        at[:3, 3] = [float(x) for x in origin.get("xyz").split()]
        at[:3, :3] = Rotation.from_euler("xyz", [float(x) for x in origin.get("rpy").split()]).as_matrix()
        if joint.get("name") in angles:
            axis = np.array([float(x) for x in joint.find("axis").get("xyz").split()])
            turn = Rotation.from_rotvec(angles[joint.get("name")] * axis / np.linalg.norm(axis))
            at[:3, :3] = at[:3, :3] @ turn.as_matrix()
        poses[joint.find("child").get("link")] = poses[joint.find("parent").get("link")] @ at
    return poses


def test_forward_kinematics_are_those_of_the_urdf(tmp_path):
    robot, body = loaded(tmp_path)
    rng = np.random.default_rng(3)
    for _ in range(20):
        angles = dict(zip(JOINTS, rng.uniform(-1.2, 1.2, 6), strict=True))
        q_wb = posture(body, {name: [value] for name, value in angles.items()}, IDENTITY)
        p_w = joint_positions(body.parents, body.offsets, q_wb, np.zeros(3))
        for link, pose in urdf_links(angles).items():
            segment = body.index(robot.segment_of_link[link])
            in_world = np.eye(4)
            in_world[:3, :3] = Rotation.from_quat(q_wb[segment], scalar_first=True).as_matrix()
            in_world[:3, 3] = p_w[segment]
            np.testing.assert_allclose(in_world @ robot.link_in_segment[link], pose, atol=1e-8)


def test_its_joint_angles_read_back(tmp_path):
    _, body = loaded(tmp_path)
    wanted = [0.4, -1.0, 1.3, -0.2, 2.0, -0.7]
    q_wb = posture(body, {name: [value] for name, value in zip(JOINTS, wanted, strict=True)}, IDENTITY)
    np.testing.assert_allclose(JointAngles(body).update(q_wb).angles[:, 0], wanted, atol=1e-8)
    q_wb[0] = np.nan  # the base carries no module: its joint turns against the world
    np.testing.assert_allclose(JointAngles(body).update(q_wb).angles[:, 0], wanted, atol=1e-8)


def test_fixed_joints_are_merged_and_limits_kept(tmp_path):
    robot, body = loaded(tmp_path)
    assert body.n_segments == 7
    assert {robot.segment_of_link[link] for link in ("flange", "tool0", "finger")} == {"wrist_3_link"}
    assert robot.segment_of_link["pedestal"] == "base_link"
    limits = {joint.name: joint.angles[0].limits for joint in body.joints}
    np.testing.assert_allclose(limits["elbow_joint"], [-2.8, 2.8])
    assert limits["wrist_3_joint"] == (-np.inf, np.inf)
    assert robot.notes == ["joint 'finger_joint' slides: it is taken as fixed at zero"]


def test_a_fixed_joint_needs_no_axis():
    bolt = (
        '<link name="plate"/><joint name="bolt" type="fixed"><parent link="base_link"/>'
        '<child link="plate"/><axis xyz="0 0 0"/></joint></robot>'
    )
    robot = import_urdf(URDF.replace("</robot>", bolt))
    assert robot.segment_of_link["plate"] == robot.segment_of_link["base_link"]


def test_a_moving_base_is_what_the_first_joint_turns_against(tmp_path):
    _, body = loaded(tmp_path, has_fixed_base=False)
    assert body.joints[0].proximal == 0


ENTITY = '<!DOCTYPE robot [<!ENTITY a "aaaa">]><robot name="&a;"/>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "no XML"),
        ("", "no XML"),
        ("<sdf/>", "begins with <sdf>"),
        (ENTITY, "refused"),
        ('<robot name="r"/>', "one tree; found 0 bases"),
        ('<robot name="r"><link name="a"/></robot>', "no joint of robot 'r' turns"),
        (URDF.replace('<link name="tool0"/>', ""), "names link 'tool0', which is not there"),
        (URDF.replace('name="tool0"', 'name="flange"', 1), "two links have the same name"),
        (URDF.replace('type="continuous"', 'type="ball"'), "of type 'ball'"),
        (URDF.replace('axis xyz="0 0.6 0.8"', 'axis xyz="0 0 0"'), "axis of length zero"),
        (URDF.replace('axis xyz="0 0.6 0.8"', 'axis xyz="0 nan 1"'), "three numbers are wanted"),
        (URDF.replace('lower="-2.8"', 'lower="2.9"'), "the smaller one comes first"),
        (URDF.replace('<child link="finger"/>', '<child link="flange"/>'), "must form one tree"),
        (URDF.replace('<child link="finger"/>', ""), "no <child link=…>"),
    ],
)
def test_what_is_no_robot_is_refused_in_one_line(text, message):
    with pytest.raises(SettingsError, match=message) as caught:
        import_urdf(text, "arm6.urdf")
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("arm6.urdf")


def test_a_chain_of_any_length_is_shown_to_its_end(tmp_path):
    """What was wider than the terminal was cut off."""
    path, lengths = tmp_path / "chain.yaml", "tip: [0, 0.1, 0]"
    later = [f"  - {{name: s{s}, parent: s{s - 1}, joint: [0, 0.1, 0], {lengths}}}" for s in range(1, 60)]
    path.write_text(
        "\n".join(["name: chain", "segments:", f"  - {{name: s0, parent: null, {lengths}}}", *later])
    )
    shown = CliRunner().invoke(app, ["body", "show", str(path)])
    assert "s59  100 mm" in shown.output
