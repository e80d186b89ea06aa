"""The truth itself, held against scipy and finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_body import FIELD, GRAVITY, arm, instants, simulate

from gateway.body.skeleton import LocalDevice
from gateway.frames import Quantity

DEVICE = LocalDevice(Quantity.POSITION, 2, np.array([0.1, 0.02, -0.03]), device=5)


def test_orientations_agree_with_scipy():
    body, times = arm(on_joint=True), instants(50, 1.0)
    truth = simulate(body, times)
    R = Rotation.identity(len(times))
    for segment, turns in enumerate(body.turns):
        angles = np.stack([turn.angle.derivatives(times * 1e-9)[0] for turn in turns], axis=1)
        R = R * Rotation.from_euler("ZYX", angles.astype(float))
        np.testing.assert_allclose(truth.R[:, segment], R.as_matrix(), atol=1e-14)


@pytest.mark.parametrize("from_rest", [False, True])
def test_rates_are_the_derivatives_of_the_orientations(from_rest):
    h, body = 10_000, arm(on_joint=True, from_rest=from_rest)  # ns
    now = instants(7, 3.0) + 10**8
    before, truth, after = (simulate(body, now + shift) for shift in (-h, 0, h))
    for segment in range(4):
        turn = Rotation.from_matrix(before.R[:, segment]).inv() * Rotation.from_matrix(after.R[:, segment])
        np.testing.assert_allclose(truth.angular_rate[:, segment], turn.as_rotvec() / (2e-9 * h), atol=1e-7)
    slope = (after.angular_rate - before.angular_rate) / (2e-9 * h)
    np.testing.assert_allclose(truth.rate_derivative, slope, atol=1e-6)


def test_accelerations_are_second_derivatives_of_positions_and_modules_feel_them():
    h, body = 1_000_000, arm(on_joint=False, local_devices=(DEVICE,))
    now = instants(7, 2.0) + 10**8
    before, truth, after = (simulate(body, now + shift) for shift in (-h, 0, h))
    dt = h * 1e-9

    def at(moment, arms):
        return moment.p_w + np.einsum("tsij,sj->tsi", moment.R, arms)

    for arms, found in (
        (np.zeros((4, 3)), truth.joint_acceleration),
        (body.lever_arms, np.einsum("tsij,tsj->tsi", truth.R, truth.specific_force) + GRAVITY),
    ):
        second = (at(after, arms) - 2.0 * at(truth, arms) + at(before, arms)) / dt**2
        np.testing.assert_allclose(found, second, atol=2e-3)
    first = (after.point["position"] - before.point["position"]) / (2.0 * dt)
    np.testing.assert_allclose(truth.point["velocity"], first, atol=1e-4)
    second = (after.point["velocity"] - before.point["velocity"]) / (2.0 * dt)
    np.testing.assert_allclose(truth.point["acceleration"], second, atol=2e-3)


def test_the_arm_moves_as_fast_as_it_says():
    truth = simulate(arm(on_joint=True), instants(200, 4.0))
    assert 2.5 < np.linalg.norm(truth.angular_rate, axis=-1).max() < 3.5
    assert 16.0 < np.linalg.norm(truth.rate_derivative, axis=-1).max() < 22.0
    known = truth.joint_acceleration - GRAVITY
    across = np.linalg.norm(np.cross(known, FIELD / np.linalg.norm(FIELD)), axis=-1)
    assert across.min() > 3.0  # m/s²: the two vectors never come near to each other


def test_before_zero_the_body_rests():
    truth = simulate(arm(on_joint=False, from_rest=True), instants(100, 0.5, start_s=-0.5))
    np.testing.assert_allclose(np.linalg.norm(truth.specific_force, axis=-1), 9.81, rtol=1e-14)
    assert (truth.angular_rate[:-1] == 0.0).all()
