"""Backward differences against motions whose derivatives are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.geometry import derivatives


def turning(t):
    """A turn that speeds up about one axis: rate (1 + 4 t) about ``AXIS``."""
    return Rotation.from_rotvec((t + 2.0 * t * t) * AXIS).as_matrix()


AXIS = np.array([0.48, 0.6, -0.64])


@pytest.mark.parametrize("dt", [0.01, 0.001])
def test_rate_is_the_mean_over_the_step_in_segment_axes(dt):
    start = Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix()
    before, now = start @ turning(0.5), start @ turning(0.5 + dt)
    expected = (1.0 + 4.0 * (0.5 + dt / 2)) * AXIS
    np.testing.assert_allclose(derivatives.angular_rate(before, now, dt), expected, rtol=1e-11)


@pytest.mark.parametrize(("dt_before", "dt"), [(0.01, 0.01), (0.01, 0.02), (0.03, 0.01)])
def test_difference_of_means_is_exact_for_a_constant_derivative_at_any_steps(dt_before, dt):
    times = np.array([0.2, 0.2 + dt_before, 0.2 + dt_before + dt])
    R = [turning(t) for t in times]
    first = derivatives.angular_rate(R[0], R[1], dt_before)
    second = derivatives.angular_rate(R[1], R[2], dt)
    found = derivatives.difference_of_means(first, second, dt_before, dt)
    np.testing.assert_allclose(found, 4.0 * AXIS, rtol=1e-9)


def test_point_acceleration_is_the_second_derivative_of_the_point():
    arm, h, t = np.array([0.3, -0.1, 0.2]), 1e-4, 0.7
    turn = np.array([1.1, 0.4, -0.5])

    def point(t):
        return turning(t) @ Rotation.from_rotvec(t * turn).as_matrix() @ arm

    second = (point(t + h) - 2.0 * point(t) + point(t - h)) / (h * h)
    R = turning(t) @ Rotation.from_rotvec(t * turn).as_matrix()
    inner = Rotation.from_rotvec(t * turn).as_matrix()
    carried = inner.T @ ((1.0 + 4.0 * t) * AXIS)
    rate = carried + turn
    rate_derivative = inner.T @ (4.0 * AXIS) + np.cross(carried, turn)
    np.testing.assert_allclose(
        R @ derivatives.point_acceleration(rate_derivative, rate, arm), second, rtol=2e-6
    )


def test_difference_of_a_measured_rate():
    found = derivatives.difference(np.array([1.0, 2.0, 3.0]), np.array([1.5, 2.0, 2.0]), 0.25)
    np.testing.assert_array_equal(found, [2.0, 0.0, -4.0])
