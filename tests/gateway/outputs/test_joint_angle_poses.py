"""Poses that carry joint angles."""

import math

import numpy as np
import orjson
import pytest

from gateway.body.body_file import load_body
from gateway.body.joint_angles import JointAngles, posture
from gateway.contract.messages import BodyMessage, PoseMessage, describe_body
from gateway.frames import SkeletonFrame
from gateway.outputs.pose_encoding import PoseEncoder
from gateway.outputs.settings import PoseMap
from gateway.viewer.pose_table import joint_table

BODY = load_body("lower_body_7")


def frame(q_wb):
    n = len(q_wb)
    return SkeletonFrame(
        sequence=0,
        time_ns=0,
        q_wb=q_wb,
        angular_rate=np.zeros((n, 3)),
        joint_acceleration=np.zeros((n, 3)),
        p_w=np.zeros((n, 3)),
        sigma=np.zeros(n),
        status=np.zeros(n, dtype=np.uint8),
        root=0,
    )


def encoder(include=(PoseMap.JOINT_ANGLES,)):
    return PoseEncoder(BODY.segment_names, 6, include, JointAngles(BODY))


def test_angles_are_degrees_by_joint_and_name():
    angles = {"left_knee": np.radians([43.1, 2.0, -3.0]), "right_hip": np.radians([20, -5, 7])}
    q_wb = posture(BODY, angles, BODY.neutral)
    pose = orjson.loads(encoder().encode(frame(q_wb)))
    found = pose["joint_angles"]
    assert found["left_knee"] == pytest.approx({"flexion": 43.1, "adduction": 2.0, "internal_rotation": -3.0})
    assert found["right_hip"] == pytest.approx({"flexion": 20, "adduction": -5, "internal_rotation": 7})
    assert pose["joint_warnings"] == {}
    PoseMessage.model_validate(pose)


def test_what_is_not_known_is_null_and_what_needs_care_is_named():
    q_wb = posture(BODY, {"right_knee": [math.radians(-40), 0, 0]}, BODY.neutral)
    q_wb[BODY.index("left_foot")] = np.nan
    pose = PoseMessage.model_validate_json(encoder().encode(frame(q_wb)))
    assert pose.joint_angles is not None
    assert pose.joint_angles["left_ankle"] is None
    assert pose.joint_angles["left_knee"] is not None
    assert pose.joint_warnings == {"right_knee": ("beyond_limits",)}


def test_they_come_on_request_only():
    q_wb = np.tile(BODY.neutral, (BODY.n_segments, 1))
    assert "joint_angles" not in orjson.loads(encoder(()).encode(frame(q_wb)))


def test_the_body_message_describes_the_joints():
    message = BodyMessage.model_validate_json(describe_body(load_body("human_17")).payload())
    knee = next(joint for joint in message.joints if joint.name == "left_knee")
    assert (knee.proximal, knee.distal, knee.kind, knee.sequence) == (
        "left_thigh",
        "left_shank",
        "hinge",
        "zxy",
    )
    assert knee.angles["flexion"] == (-10, 155)
    swing = describe_body(load_body("pendulum_3")).joints[0]
    assert swing.proximal is None
    assert swing.angles == {"swing": (None, None)}


def test_the_table_of_joints_shows_them():
    q_wb = posture(BODY, {"right_knee": [math.radians(-40), 0, 0]}, BODY.neutral)
    table = joint_table(PoseMessage.model_validate_json(encoder().encode(frame(q_wb))))
    assert table is not None
    assert table.row_count == len(BODY.joints)
    without = PoseMessage.model_validate_json(encoder(()).encode(frame(q_wb)))
    assert joint_table(without) is None
