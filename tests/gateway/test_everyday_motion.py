"""The person of the demo walks as people do: published angles, feet that stand, and exact derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from devices.emulators.motion.everyday import GRID_HZ, STRIDE_HZ, Lap
from devices.emulators.motion.motions import everyday_motion
from devices.emulators.motion.stride import STRIDE
from devices.normal_gait import normal_gait
from gateway.body.joint_angles import joint_angles
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, perform

REST_S = 2.0
SPEED = STRIDE.length * STRIDE_HZ
LONG = Lap(straight_m=12.0)
"""Straight long enough for strides that are neither a beginning nor an end."""
STEP_S = 1e-4


@pytest.fixture(scope="module")
def suit():
    return load_rig("suit_17")


@pytest.fixture(scope="module")
def motion(suit):
    return perform(dress(suit), suit.skeleton.name, 1)


def angle_over_strides(suit, side, joint, angle):
    """(strides, 101) degrees by percent of the stride, of steady walking straight on."""
    motion = everyday_motion(dress(suit), 1, lap=LONG)
    begin = REST_S + LONG.walks(SPEED)[0][0]
    first = begin + (0.5 + (0.0 if side == "right" else 0.5) + 3) / STRIDE_HZ
    phases = np.arange(0, 101) / 100
    times = first + (np.arange(3)[:, None] + phases) / STRIDE_HZ
    angles = joint_angles(suit.skeleton, motion.state(times.ravel()).q_wb)
    names = [joint.name for joint in suit.skeleton.joints]
    j = names.index(f"{side}_{joint}")
    k = [one.name for one in suit.skeleton.joints[j].angles].index(angle)
    return np.degrees(angles[:, j, k]).reshape(3, 101)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("published", "joint", "angle"),
    [
        ("hip_flexion", "hip", "flexion"),
        ("knee_flexion", "knee", "flexion"),
        ("ankle_dorsiflexion", "ankle", "dorsiflexion"),
    ],
)
def test_joints_stay_within_one_standard_deviation_of_published_gait(suit, side, published, joint, angle):
    percent, mean, sd = normal_gait()[published].T
    walked = angle_over_strides(suit, side, joint, angle)
    at = np.arange(101)
    off = (walked - np.interp(at, percent, mean)) / np.interp(at, percent, sd)
    assert np.abs(off).max() < 1.0
    assert np.ptp(walked) == pytest.approx(np.ptp(mean), abs=8.0), "and go as far"


def sole(suit, state, side, place):
    """Position and speed of a point of a foot."""
    foot = suit.skeleton.segment_names.index(f"{side}_foot")
    arm = np.array([*place, 0.0])
    swept = np.cross(state.angular_rate[:, foot], arm)
    position = state.joint_position[:, foot] + state.R_wb[:, foot] @ arm
    velocity = state.joint_velocity[:, foot] + np.einsum("tij,tj->ti", state.R_wb[:, foot], swept)
    return position, np.linalg.norm(velocity, axis=1)


HEEL, BALL = (-0.05, -0.068), (0.15, -0.068)


def test_feet_stand_on_the_floor_and_never_go_through_it(suit, motion):
    state = motion.state(np.arange(0.0, 45.0, 0.005))
    floor = sole(suit, state, "left", HEEL)[0][0, 2]
    stands = np.zeros(len(state.R_wb), bool)
    for side in ("left", "right"):
        for place in (HEEL, BALL):
            position, speed = sole(suit, state, side, place)
            assert position[:, 2].min() > floor - 1e-3
            is_still = speed < 5e-3
            assert np.abs(position[is_still, 2] - floor).max() < 5e-3
            stands |= is_still
    assert np.mean(stands) > 0.99, "somebody who walks always stands on one foot"


def test_heel_strikes_first_and_the_ball_leaves_last(suit):
    motion = everyday_motion(dress(suit), 1, lap=LONG)
    begin = REST_S + LONG.walks(SPEED)[0][0] + 3.5 / STRIDE_HZ
    times = begin + np.arange(0.0, 1.0, 0.002) / STRIDE_HZ
    state = motion.state(times)
    heel, ball = (sole(suit, state, "right", place)[1] < 2e-2 for place in (HEEL, BALL))
    phase = (times - begin) * STRIDE_HZ
    assert heel[phase < 0.05].all()
    assert not ball[phase < 0.05].any()
    assert phase[heel & (phase < 0.9)].max() < 0.5
    assert 0.55 < phase[ball].max() < 0.63


def test_arms_swing_against_the_legs(suit):
    motion = everyday_motion(dress(suit), 1, lap=LONG)
    begin = REST_S + LONG.walks(SPEED)[0][0] + 3.5 / STRIDE_HZ
    q_wb = motion.state(begin + np.arange(0.0, 2.0, 0.01) / STRIDE_HZ).R_wb
    names = suit.skeleton.segment_names
    forward = {name: -q_wb[:, names.index(name), 0, 1] for name in names}  # of what hangs down, along x
    for side, other in (("left", "right"), ("right", "left")):
        arm, leg = forward[f"{side}_upper_arm"], forward[f"{side}_thigh"]
        assert np.corrcoef(arm, leg)[0, 1] < -0.7
        assert np.corrcoef(arm, forward[f"{other}_thigh"])[0, 1] > 0.7


def test_turns_reaches_and_squats_near_the_place_for_an_hour(suit, motion):
    state = motion.state(np.arange(0.0, 3600.0, 0.37))
    assert np.abs(state.joint_position[..., :2]).max() < 7.0
    one = motion.state(np.arange(0.0, 40.0, 0.05))
    names = suit.skeleton.segment_names
    height = one.joint_position[:, :, 2]
    floor = height[0].min()
    hand = names.index("right_hand")
    assert height[:, hand].max() - floor > 1.2, "reaches up"
    assert height[:, 0].min() < height[0, 0] - 0.3, "squats"
    heading = np.unwrap(np.arctan2(one.R_wb[:, 0, 1, 0], one.R_wb[:, 0, 0, 0]))
    assert np.ptp(heading) > 1.9 * np.pi, "turns all the way round"


MOVING = REST_S + np.array([0.9, 3.31, 7.77, 13.3, 17.05, 19.5, 24.4, 35.5, 40.0])


def test_rates_and_accelerations_are_derivatives_of_the_pose(motion):
    before, state, after = (motion.state(MOVING + d) for d in (-STEP_S, 0.0, STEP_S))
    for value, rate, atol in (
        ("joint_position", "joint_velocity", 1e-4),
        ("joint_velocity", "joint_acceleration", 1e-2),
        ("angular_rate", "angular_acceleration", 1e-2),
    ):
        slope = (getattr(after, value) - getattr(before, value)) / (2 * STEP_S)
        np.testing.assert_allclose(slope, getattr(state, rate), atol=atol, rtol=1e-3)
    skew = np.swapaxes(state.R_wb, -1, -2) @ ((after.R_wb - before.R_wb) / (2 * STEP_S))
    omega = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    np.testing.assert_allclose(omega, state.angular_rate, atol=1e-3)


def test_nothing_jumps_from_knot_to_knot(motion):
    state = motion.state(np.arange(0.0, 75.0, 0.25 / GRID_HZ))
    assert np.linalg.norm(state.joint_acceleration, axis=2).max() < 150.0
    assert np.linalg.norm(np.diff(state.joint_position, axis=0), axis=2).max() < 0.03


def test_rests_in_the_reference_posture_first(suit, motion):
    rest = motion.state([0.0, 1.0, REST_S])
    np.testing.assert_allclose(np.abs(rest.q_wb @ suit.skeleton.neutral), 1.0, atol=1e-7)
    assert np.abs(rest.angular_rate).max() < 1e-6


@pytest.mark.parametrize("rig", ["suit_17", "suit_23_from_17", "suit_lower_7", "robot_arm_4"])
def test_every_body_has_something_to_do(rig):
    worn = load_rig(rig)
    state = perform(dress(worn), worn.skeleton.name, 1).state(np.arange(0.0, 20.0, 0.1))
    assert np.linalg.norm(state.angular_rate, axis=2).max() > 0.5
