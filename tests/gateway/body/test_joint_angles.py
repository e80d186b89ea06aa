"""Joint angles: exact, signed as named, the same on both sides, continuous through the singularity."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gateway.body.body_file import load_body
from gateway.body.joint_angles import JointAngles, joint_angles, joint_rotation, posture
from gateway.body.joints import Angle, Decomposition, Joint
from gateway.body.skeleton import Skeleton

HUMAN = load_body("human_17")
SEQUENCES = ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx", "xyx", "xzx", "yxy", "yzy", "zxz", "zyz"]
OUTWARD = {"left": -1.0, "right": 1.0}


def pair(joint: Joint) -> Skeleton:
    """Two segments with axes along the world's."""
    return Skeleton(
        "pair", ("a", "b"), np.array([-1, 0]), np.zeros((2, 3)), np.zeros((2, 3)), joints=(joint,)
    )


def cardan_joint(sequence, decomposition=Decomposition.CARDAN, limits=None):
    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    limits = limits or [(-np.inf, np.inf)] * 3
    angles = tuple(Angle(f"angle_{i}", axes[c], limits[i]) for i, c in enumerate(sequence))
    return Joint("j", 0, 1, decomposition, angles, ("angle_0", "angle_1", "angle_2"))


def poses(q_pd):
    """Poses of the pair whose joint is turned so, the proximal segment turned anyhow."""
    q_pd = Rotation.from_quat(q_pd, scalar_first=True)
    base = Rotation.from_rotvec([0.3, -1.1, 0.4])
    both = [
        np.tile(base.as_quat(scalar_first=True), (len(q_pd), 1)),
        (base * q_pd).as_quat(scalar_first=True),
    ]
    return np.stack(both, axis=1)


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_angles_turn_back_into_the_rotation(sequence):
    rotations = Rotation.random(200, rng=np.random.default_rng(1))
    q = poses(rotations.as_quat(scalar_first=True))
    for pose, rotation in zip(q, rotations, strict=True):
        frame = JointAngles(pair(cardan_joint(sequence))).update(pose)
        back = Rotation.from_euler(sequence.upper(), frame.angles[0])
        assert (rotation.inv() * back).magnitude() < 1e-9


def test_angles_agree_with_scipy_where_both_take_the_principal_branch():
    rotations = Rotation.random(100, rng=np.random.default_rng(2))
    stream = JointAngles(
        pair(cardan_joint("zxy", limits=[(-np.pi, np.pi), (-np.pi / 2, np.pi / 2), (-9, 9)]))
    )
    for pose, rotation in zip(poses(rotations.as_quat(scalar_first=True)), rotations, strict=True):
        stream.reset()
        np.testing.assert_allclose(stream.update(pose).angles[0], rotation.as_euler("ZXY"), atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(share=st.lists(st.floats(0.02, 0.98), min_size=48, max_size=48))
def test_a_posture_within_the_limits_reads_back(share):
    share = np.array(share).reshape(16, 3)
    angles = {
        joint.name: [
            low + s * (high - low)
            for (low, high), s in zip((a.limits for a in joint.angles), row, strict=True)
        ]
        for joint, row in zip(HUMAN.joints, share, strict=True)
    }
    for joint in HUMAN.joints:  # away from the shoulder's singularity, and within its unambiguous half
        if joint.sequence == "yxy":
            angles[joint.name][1] = np.clip(angles[joint.name][1], np.radians(10), np.radians(170))
    q_root = Rotation.from_rotvec([0.2, 0.5, 2.0]).as_quat(scalar_first=True)
    found = JointAngles(HUMAN).update(posture(HUMAN, angles, q_root))
    for joint, row in zip(HUMAN.joints, found.angles, strict=True):
        wanted = joint_rotation(joint, angles[joint.name])
        turn = Rotation.from_quat(joint_rotation(joint, row), scalar_first=True).inv()
        assert (turn * Rotation.from_quat(wanted, scalar_first=True)).magnitude() < 1e-7
        np.testing.assert_allclose(row, angles[joint.name], atol=1e-6)
    assert not found.beyond_limits.any()


def moved(joint, angle, degrees, segment, axis):
    """A unit vector of a segment, in ISB axes of the standing person, after one angle has grown."""
    definition = next(j for j in HUMAN.joints if j.name == joint)
    values = [np.radians(degrees) if a.name == angle else 0.0 for a in definition.angles]
    q = posture(HUMAN, {joint: values}, HUMAN.neutral)[HUMAN.index(segment)]
    neutral = Rotation.from_quat(HUMAN.neutral, scalar_first=True)
    return (neutral.inv() * Rotation.from_quat(q, scalar_first=True)).apply(np.eye(3)[:, "xyz".index(axis)])


FORWARD, UP = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
RIGHT = np.array([0, 0, 1.0])
MOVEMENTS = [
    # joint, angle, segment, its axis, where that axis goes (MEDIAL and LATERAL: by side)
    ("hip", "flexion", "thigh", "-y", FORWARD),
    ("hip", "adduction", "thigh", "-y", "medial"),
    ("hip", "internal_rotation", "thigh", "x", "medial"),
    ("knee", "flexion", "shank", "-y", -FORWARD),
    ("knee", "adduction", "shank", "-y", "medial"),
    ("knee", "internal_rotation", "shank", "x", "medial"),
    ("ankle", "dorsiflexion", "foot", "x", UP),
    ("ankle", "inversion", "foot", "-y", "medial"),
    ("ankle", "internal_rotation", "foot", "x", "medial"),
    ("elbow", "flexion", "forearm", "-y", FORWARD),
    ("elbow", "carrying", "forearm", "-y", "lateral"),
    ("elbow", "pronation", "forearm", "x", "medial"),
    ("wrist", "flexion", "hand", "-y", FORWARD),
    ("wrist", "ulnar_deviation", "hand", "-y", "medial"),
    ("shoulder", "elevation", "upper_arm", "-y", "lateral"),
    ("shoulder", "internal_rotation", "upper_arm", "x", "medial"),
    ("sternoclavicular", "elevation", "shoulder_girdle", "lateral", UP),
    ("sternoclavicular", "protraction", "shoulder_girdle", "lateral", FORWARD),
    ("sternoclavicular", "posterior_rotation", "shoulder_girdle", "y", -FORWARD),
]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("joint", "angle", "segment", "axis", "towards"), MOVEMENTS)
def test_an_angle_grows_with_the_movement_it_names(side, joint, angle, segment, axis, towards):
    if isinstance(towards, str):
        towards = OUTWARD[side] * RIGHT * (1 if towards == "lateral" else -1)
    sign = 1.0
    if axis == "lateral":
        axis, sign = "z", OUTWARD[side]
    elif axis.startswith("-"):
        axis, sign = axis[1:], -1.0
    after = sign * moved(f"{side}_{joint}", angle, 20, f"{side}_{segment}", axis)
    assert after @ towards == pytest.approx(np.sin(np.radians(20)), abs=1e-6)


@pytest.mark.parametrize(
    ("joint", "angle", "segment", "axis", "towards"),
    [
        ("spine", "flexion", "thorax", "y", FORWARD),
        ("spine", "right_bending", "thorax", "y", RIGHT),
        ("spine", "left_rotation", "thorax", "x", -RIGHT),
        ("neck", "flexion", "head", "y", FORWARD),
        ("neck", "right_bending", "head", "y", RIGHT),
        ("neck", "left_rotation", "head", "x", -RIGHT),
    ],
)
def test_the_trunk_too(joint, angle, segment, axis, towards):
    assert moved(joint, angle, 20, segment, axis) @ towards == pytest.approx(np.sin(np.radians(20)), abs=1e-6)


def test_an_arm_raised_forward_is_elevated_in_the_plane_of_90_degrees():
    for side in ("left", "right"):
        forward = load_body("human_17", joint_definitions={f"{side}_shoulder": "swing_twist"})
        q = posture(forward, {f"{side}_shoulder": np.radians([60, 0, 0])}, forward.neutral)
        found = JointAngles(HUMAN).update(q)
        row = [j.name for j in HUMAN.joints].index(f"{side}_shoulder")
        np.testing.assert_allclose(np.degrees(found.angles[row]), [90, 60, -90], atol=1e-6)


def arm_swing(noise_deg, seed=0):
    """An arm swinging through the hanging position, 25° to either side, with noise: (T, 4) of the joint."""
    rng = np.random.default_rng(seed)
    t = np.arange(600) / 100
    swing = Rotation.from_rotvec(np.radians(25 * np.sin(2 * np.pi * t))[:, None] * np.array([0.1, 0, 1.0]))
    return (swing * Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(600, 3)))).as_quat(
        scalar_first=True
    )


def test_angles_stay_continuous_through_gimbal_lock_and_say_so():
    stream = JointAngles(pair(cardan_joint("yxy")))
    q = arm_swing(noise_deg=0.3)
    frames = [stream.update(pose) for pose in poses(q)]
    angles = np.stack([frame.angles[0] for frame in frames])
    near = np.array([frame.near_gimbal[0] for frame in frames])
    steps = np.degrees(np.abs(np.diff(angles, axis=0))).max()
    plain = np.degrees(
        np.abs(np.diff(Rotation.from_quat(q, scalar_first=True).as_euler("YXY"), axis=0))
    ).max()
    assert plain > 100
    assert steps < 20
    assert 0.05 < near.mean() < 0.4
    back = Rotation.from_euler("YXY", angles)
    errors = np.degrees((Rotation.from_quat(q, scalar_first=True).inv() * back).magnitude())
    assert errors[~near].max() < 1e-6  # exact outside the zone
    assert errors.max() < 2.0


def test_swing_and_twist_have_no_singularity_at_the_hanging_arm():
    stream = JointAngles(pair(cardan_joint("zxy", Decomposition.SWING_TWIST)))
    frames = [stream.update(pose) for pose in poses(arm_swing(noise_deg=0.3))]
    angles = np.degrees(np.stack([frame.angles[0] for frame in frames]))
    assert not any(frame.near_gimbal[0] for frame in frames)
    assert np.abs(np.diff(angles, axis=0)).max() < 4.0
    assert np.abs(angles[:, 2]).max() < 2.0  # no twist was made, none is found


def test_turns_are_counted_where_there_is_no_limit_and_the_start_forgets():
    joint = Joint("j", 0, 1, Decomposition.HINGE, (Angle("turn", (0.6, 0.0, 0.8)),), ("turn",))
    stream = JointAngles(pair(joint))
    wanted = np.linspace(0, 6 * np.pi, 200)
    q = Rotation.from_rotvec(wanted[:, None] * np.array([0.6, 0.0, 0.8])).as_quat(scalar_first=True)
    found = [stream.update(pose).angles[0, 0] for pose in poses(q)]
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    stream.update(np.full((2, 4), np.nan))
    assert stream.update(poses(q)[-1]).angles[0, 0] == pytest.approx(0.0, abs=1e-9)


def test_unknown_segments_give_unknown_angles_and_no_others():
    q = np.tile(HUMAN.neutral, (HUMAN.n_segments, 1))
    q[HUMAN.index("left_shank")] = np.nan
    found = JointAngles(HUMAN).update(q)
    unknown = {j.name for j, row in zip(HUMAN.joints, found.angles, strict=True) if np.isnan(row).any()}
    assert unknown == {"left_knee", "left_ankle"}


def test_beyond_the_limits_is_said():
    angles = {"right_knee": np.radians([-30, 0, 0]), "left_knee": np.radians([40, 0, 0])}
    found = JointAngles(HUMAN).update(posture(HUMAN, angles, HUMAN.neutral))
    beyond = {j.name for j, flag in zip(HUMAN.joints, found.beyond_limits, strict=True) if flag}
    assert beyond == {"right_knee"}


def test_over_time():
    q = np.stack([posture(HUMAN, {"left_knee": [a, 0, 0]}, HUMAN.neutral) for a in (0.1, 0.5)])
    row = [j.name for j in HUMAN.joints].index("left_knee")
    np.testing.assert_allclose(joint_angles(HUMAN, q)[:, row], [[0.1, 0, 0], [0.5, 0, 0]], atol=1e-9)
