"""The truth against finite differences, and against itself along other ways through the chain."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices.emulators.bodies import emulated_body
from devices.emulators.motion.motions import (
    MOTIONS,
    generic_motion,
    peak_rates,
    pendulum_motion,
    robot_arm_motion,
    walking_motion,
)
from devices.emulators.motion.waves import Fade, waves

MOVING = np.array([2.3, 2.9, 3.4, 5.0, 8.17, 20.3])
STEP = 1e-4

BODY_AND_MOTION = [("arm4", "arm"), ("pendulum3", "pendulum"), ("human17", "walking"), ("human17", "generic")]


@pytest.fixture(params=BODY_AND_MOTION, ids="-".join)
def motion(request):
    body, kind = request.param
    return MOTIONS[kind](request.getfixturevalue(body), 7, None)


def central(motion, quantity):
    """Central difference over the times, from quantity(state)."""
    return (quantity(motion.state(MOVING + STEP)) - quantity(motion.state(MOVING - STEP))) / (2 * STEP)


def test_velocity_and_acceleration_are_derivatives_of_position(motion):
    state = motion.state(MOVING)
    np.testing.assert_allclose(central(motion, lambda s: s.joint_position), state.joint_velocity, atol=2e-6)
    np.testing.assert_allclose(
        central(motion, lambda s: s.joint_velocity), state.joint_acceleration, atol=2e-5, rtol=1e-5
    )


def test_angular_rate_is_the_derivative_of_orientation(motion):
    state = motion.state(MOVING)
    skew = np.swapaxes(state.R_wb, -1, -2) @ central(motion, lambda s: s.R_wb)  # Rᵀ Ṙ = [ω]×
    omega = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    np.testing.assert_allclose(omega, state.angular_rate, atol=1e-5)
    np.testing.assert_allclose(
        central(motion, lambda s: s.angular_rate), state.angular_acceleration, atol=1e-4, rtol=1e-4
    )


def test_joint_acceleration_agrees_from_both_neighbours(motion):
    body, state = motion.body, motion.state(MOVING)
    for n in range(1, body.n_segments):
        p, r = body.parents[n], body.offsets[n]
        omega, alpha = state.angular_rate[:, p], state.angular_acceleration[:, p]
        lever = np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))
        from_parent = state.joint_acceleration[:, p] + np.einsum("tij,tj->ti", state.R_wb[:, p], lever)
        np.testing.assert_allclose(state.joint_acceleration[:, n], from_parent, atol=1e-11)
        joint = state.joint_position[:, p] + state.R_wb[:, p] @ r
        np.testing.assert_allclose(state.joint_position[:, n], joint, atol=1e-12)


def test_rests_in_the_reference_posture_then_moves_smoothly(motion):
    rest = motion.state([0.0, 1.0, 2.0])
    np.testing.assert_allclose(
        np.abs(np.sum(rest.q_wb * motion.body.reference_posture, axis=-1)), 1.0, atol=1e-12
    )
    assert not rest.angular_rate.any()
    assert not rest.joint_acceleration.any()
    onset = motion.state([2.01, 2.2, 2.5]).angular_rate
    speed = np.linalg.norm(onset, axis=2).max(axis=1)
    assert speed[0] < 1e-4 < speed[1] < speed[2]


def test_a_quaternion_is_the_rotation_matrix_with_positive_scalar_part(motion):
    state = motion.state(MOVING)
    assert (state.q_wb[..., 0] >= 0).all()
    R = Rotation.from_quat(state.q_wb.reshape(-1, 4), scalar_first=True).as_matrix()
    np.testing.assert_allclose(R.reshape(state.R_wb.shape), state.R_wb, atol=1e-12)


def test_every_module_at_its_own_times_is_the_body_at_those_times(motion):
    segments = np.array([2, 0, 1, 2])
    times = np.random.default_rng(1).uniform(0, 20, (5, 4))
    own = motion.module_state(segments, times)
    for column, segment in enumerate(segments):
        whole = motion.state(times[:, column])
        np.testing.assert_allclose(own.R_wb[:, column], whole.R_wb[:, segment], atol=1e-12)
        np.testing.assert_allclose(
            own.joint_acceleration[:, column], whole.joint_acceleration[:, segment], atol=1e-9
        )


def test_the_arm_reaches_its_peaks(arm4):
    assert peak_rates(robot_arm_motion(arm4, 3)) == pytest.approx((3.0, 20.0), rel=0.02)


@pytest.mark.parametrize("peaks", [(1.0, 5.0), (12.0, 150.0)])
def test_the_generic_motion_reaches_the_peaks_asked_for(human17, peaks):
    rate, acceleration = peaks
    motion = generic_motion(human17, 2, peak_angular_rate=rate, peak_angular_acceleration=acceleration)
    assert peak_rates(motion) == pytest.approx(peaks, rel=0.05)


def test_motions_are_seeded(arm4):
    first, again, other = (robot_arm_motion(arm4, seed).state(MOVING).q_wb for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1


def test_the_pendulum_swings_below_its_fixed_pivot_in_the_plane_east_up(pendulum3):
    state = pendulum_motion(pendulum3, 5).state(np.arange(0, 20, 0.01))
    assert not state.joint_position[:, 0].any()
    tip = state.joint_position[:, 2]
    assert (tip[:, 2] < -0.2).all()
    assert 0.2 < np.ptp(tip[:, 0]) < 1.1
    assert np.ptp(tip[:, 1]) < 0.35 * np.ptp(tip[:, 0])


def joint_angle(state, body, child, parent):
    """ISB flexion about z of a child against its parent, degrees (T,)."""
    names = body.segment_names
    R_pc = np.swapaxes(state.R_wb[:, names.index(parent)], -1, -2) @ state.R_wb[:, names.index(child)]
    return Rotation.from_matrix(R_pc).as_euler("ZXY", degrees=True)[:, 0]


def test_walking_keeps_to_anatomical_ranges(human17):
    motion = walking_motion(human17, 1)
    state = motion.state(np.arange(4, 24, 0.02))
    ranges = {  # degrees, positive: flexion of hip and elbow, extension of the knee
        ("right_thigh", "pelvis"): (-25, 55),
        ("left_thigh", "pelvis"): (-25, 55),
        ("right_shank", "right_thigh"): (-75, 8),
        ("left_shank", "left_thigh"): (-75, 8),
        ("right_foot", "right_shank"): (-30, 30),
        ("right_forearm", "right_upper_arm"): (0, 80),
        ("head", "thorax"): (-20, 20),
    }
    for (child, parent), (low, high) in ranges.items():
        angle = joint_angle(state, human17, child, parent)
        assert low < angle.min() < angle.max() < high, (child, angle.min(), angle.max())
    # Upright: the vertical is never far from the trunk's y.
    assert (state.R_wb[:, 1, 2, 1] > np.cos(np.radians(20))).all()


def test_walking_steps_with_opposite_legs_and_bobs(human17):
    state = walking_motion(human17, 1).state(np.arange(4, 30, 0.02))
    left, right = (joint_angle(state, human17, f"{side}_thigh", "pelvis") for side in ("left", "right"))
    arm = joint_angle(state, human17, "right_upper_arm", "right_shoulder_girdle")
    assert np.corrcoef(left, right)[0, 1] < -0.7
    assert np.corrcoef(right, arm)[0, 1] < -0.7
    pelvis = state.joint_position[:, 0]
    assert 0.03 < np.ptp(pelvis[:, 2]) < 0.08
    assert np.ptp(pelvis[:, 0]) > 1.0
    assert 0.02 < np.ptp(pelvis[:, 1]) < 0.2


def test_fade_is_smooth_and_ends_at_one():
    fade = Fade(rest_s=1.0, ramp_s=0.5)
    t = np.linspace(0.9, 1.6, 2001)
    value, rate, acceleration = fade.evaluate(t)
    np.testing.assert_allclose(np.gradient(value, t), rate, atol=1e-2)
    np.testing.assert_allclose(np.gradient(rate, t), acceleration, atol=0.2)
    assert value[0] == 0.0
    assert value[-1] == 1.0
    assert (np.diff(value) >= 0).all()


def test_waves_hold_what_their_terms_say():
    table = waves(2, [(1, 2, 0.5, 2.0, 0.1), (1, 2, 0.25, 0.0, np.pi / 2), (0, 0, 1.0, 1.0, 0.0)])
    t = np.array([[0.3, 0.3]])
    always = Fade(rest_s=-10.0).evaluate(t)
    x, _, z = table.evaluate(t, always)
    np.testing.assert_allclose(z.value, [[0.0, 0.5 * np.sin(4 * np.pi * 0.3 + 0.1) + 0.25]])
    np.testing.assert_allclose(x.rate, [[2 * np.pi * np.cos(2 * np.pi * 0.3), 0.0]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"parents": [-1, 1]}, "parents must come before"),
        ({"offsets": [[0, 0, 0]]}, "offsets has shape"),
        ({"module_ids": [3, 3]}, "given twice"),
    ],
)
def test_a_wrong_body_is_refused(changes, message):
    given = {"parents": [-1, 0], "offsets": np.zeros((2, 3))} | changes
    with pytest.raises(ValueError, match=message):
        emulated_body(("a", "b"), **given)
