"""Bodies as avatars of Unity, against geometry done by hand."""

from __future__ import annotations

import numpy as np
import pytest
from pythonosc.osc_packet import OscPacket
from scipy.spatial.transform import Rotation

from gateway.body.kinematics import joint_positions
from gateway.body.rig import load_rig
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.unity import AvatarPoses, VmcEncoder, bones_of, t_pose, unity_rotation, unity_vector

SKELETON = load_rig("suit_17").skeleton
EXCHANGE = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])


def frame_of(q_wb, root=(0.0, 0.0, 0.0), time_ns=0):
    n = SKELETON.n_segments
    p_w = joint_positions(SKELETON.parents, SKELETON.offsets, q_wb, np.array(root))
    return SkeletonFrame(
        sequence=0, time_ns=time_ns, q_wb=q_wb, angular_rate=np.zeros((n, 3)),
        joint_acceleration=np.zeros((n, 3)), p_w=p_w, sigma=np.zeros(n),
        status=np.zeros(n, np.uint8), root=0,
    )  # fmt: skip


def unity_matrix(q_xyzw):
    """By Unity's left-handed rule a quaternion makes the same matrix as in a right-handed world."""
    return Rotation.from_quat(q_xyzw).as_matrix()


def test_rotations_are_conjugated_with_the_exchange_of_axes():
    q_wb = Rotation.random(200, random_state=7).as_quat()[:, [3, 0, 1, 2]]
    v = np.random.default_rng(1).normal(size=(200, 3))
    turned = Rotation.from_quat(q_wb[:, [1, 2, 3, 0]]).apply(v)
    in_unity = np.einsum("nij,nj->ni", unity_matrix(unity_rotation(q_wb)), unity_vector(v))
    np.testing.assert_allclose(in_unity, unity_vector(turned), atol=1e-12)
    np.testing.assert_allclose(unity_vector(v), v @ EXCHANGE.T)


def test_the_t_pose_is_no_rotation_and_has_arms_to_the_sides():
    q_tb = t_pose(SKELETON)
    _, rotations = AvatarPoses(SKELETON).update(frame_of(q_tb))
    np.testing.assert_allclose(rotations, np.tile([0, 0, 0, 1.0], (len(rotations), 1)), atol=1e-12)
    p_w = frame_of(q_tb).p_w
    left, shoulder = p_w[SKELETON.index("left_hand")], p_w[SKELETON.index("left_upper_arm")]
    assert left[0] < shoulder[0] - 0.5  # faces north, so left is west
    assert left[2] == pytest.approx(shoulder[2])


def test_bones_form_a_humanoid():
    bones = bones_of(SKELETON)
    assert len(bones) == 17
    parents = {bone.name: bones[bone.parent].name for bone in bones if bone.parent >= 0}
    assert bones[0].name == "Hips"
    assert parents["Spine"] == "Hips"  # a thorax that hangs from the pelvis
    assert parents["LeftUpperArm"] == "LeftShoulder"
    assert parents["RightLowerLeg"] == "RightUpperLeg"


def test_an_avatar_built_from_bones_has_its_joints_where_the_body_has_them():
    """Forward kinematics as Unity does it, in Unity's axes, from nothing but what is sent."""
    rng = np.random.default_rng(3)
    q_wb = Rotation.random(SKELETON.n_segments, random_state=rng).as_quat()[:, [3, 0, 1, 2]]
    frame = frame_of(q_wb, root=(0.3, -0.2, 0.9))
    avatar = AvatarPoses(SKELETON)
    positions, rotations = avatar.update(frame)
    world: list[tuple[np.ndarray, np.ndarray]] = []
    for bone, p, q in zip(avatar.bones, positions, rotations, strict=True):
        origin, turn = world[bone.parent] if bone.parent >= 0 else (np.zeros(3), np.eye(3))
        world.append((origin + turn @ p, turn @ unity_matrix(q)))
        np.testing.assert_allclose(world[-1][0], unity_vector(frame.p_w[bone.segment]), atol=1e-9)


def test_unknown_segments_keep_their_last_rotation_and_a_body_without_place_stands():
    avatar = AvatarPoses(SKELETON)
    q_wb = np.tile([0.5, 0.5, 0.5, 0.5], (SKELETON.n_segments, 1))  # neutral, facing north
    before = avatar.update(frame_of(q_wb))
    lost = q_wb.copy()
    lost[3] = np.nan
    after = avatar.update(frame_of(lost))
    np.testing.assert_allclose(after[1], before[1])
    assert before[0][0][1] == pytest.approx(0.928, abs=0.01)  # hip height 0.53 of 1.75 m


def test_vmc_bundles_are_osc_with_finite_numbers():
    encoder = VmcEncoder(SKELETON)
    encoder.encode(frame_of(t_pose(SKELETON), time_ns=0))
    datagrams = encoder.encode(frame_of(t_pose(SKELETON), time_ns=1_500_000_000))
    assert all(len(datagram) < 1500 for datagram in datagrams)
    messages = [timed.message for datagram in datagrams for timed in OscPacket(datagram).messages]
    by_address = {message.address: message.params for message in messages}
    assert by_address["/VMC/Ext/OK"] == [1]
    assert by_address["/VMC/Ext/T"] == [1.5]
    assert by_address["/VMC/Ext/Root/Pos"] == ["root", 0, 0, 0, 0, 0, 0, 1]
    bones = [m.params for m in messages if m.address == "/VMC/Ext/Bone/Pos"]
    assert len({params[0] for params in bones}) == 17
    assert all(len(params) == 8 and np.isfinite(params[1:]).all() for params in bones)


def test_a_robot_is_no_avatar():
    with pytest.raises(OutputError, match="is not a person's"):
        VmcEncoder(load_rig("robot_arm_4").skeleton)
