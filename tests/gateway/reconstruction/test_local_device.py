"""Local measuring devices: every kind, at its own rate."""

import numpy as np
import pytest

from gateway.body.skeleton import LocalDevice
from gateway.frames import LocalReading, Quantity
from gateway.reconstruction.inertial.local_devices import RootMotion

JERK = np.array([0.3, -0.2, 1.0])
START = np.array([1.0, 2.0, -0.5])


def motion(quantity, t):
    """A point with constant jerk."""
    return {
        Quantity.POSITION: START * t * t / 2 + JERK * t**3 / 6,
        Quantity.VELOCITY: START * t + JERK * t * t / 2,
        Quantity.ACCELERATION: START + JERK * t,
    }[quantity]


def reading(quantity, time_ns, device=7):
    return LocalReading(device, time_ns, quantity, motion(quantity, time_ns * 1e-9), np.zeros(3))


def device(quantity):
    return LocalDevice(quantity, 0, np.zeros(3), device=7)


MS = 1_000_000


@pytest.mark.parametrize("quantity", [Quantity.ACCELERATION, Quantity.VELOCITY, Quantity.POSITION])
def test_known_after_as_many_more_readings_as_derivatives(quantity):
    n_derivatives = [Quantity.ACCELERATION, Quantity.VELOCITY, Quantity.POSITION].index(quantity)
    root = RootMotion(device(quantity), longest_hold_s=0.25)
    for k in range(n_derivatives + 1):
        assert np.isnan(root.acceleration(k * 10 * MS)).all()
        root.add([reading(quantity, k * 10 * MS)])
    assert np.isfinite(root.acceleration(n_derivatives * 10 * MS)).all()


@pytest.mark.parametrize(
    ("quantity", "lag"), [(Quantity.ACCELERATION, 0.0), (Quantity.VELOCITY, 0.5), (Quantity.POSITION, 1.0)]
)
@pytest.mark.parametrize("step_ms", [1, 10])
def test_lags_by_half_a_step_a_derivative_and_no_more(quantity, lag, step_ms):
    root = RootMotion(device(quantity), longest_hold_s=0.25)
    root.add(reading(quantity, k * step_ms * MS) for k in range(10))
    now = 9 * step_ms * MS
    expected = motion(Quantity.ACCELERATION, now * 1e-9 - lag * step_ms * 1e-3)
    np.testing.assert_allclose(root.acceleration(now), expected, rtol=1e-9)


def test_uneven_steps_count_with_their_true_length():
    root = RootMotion(device(Quantity.POSITION), longest_hold_s=0.25)
    times = [0, 10, 40]
    root.add(reading(Quantity.POSITION, t * MS) for t in times)
    # the third divided difference of a cubic: the acceleration at the mean of the three instants
    expected = motion(Quantity.ACCELERATION, np.mean(times) * 1e-3)
    np.testing.assert_allclose(root.acceleration(40 * MS), expected, rtol=1e-9)


def test_interpolated_between_readings_and_held_after_the_last():
    root = RootMotion(device(Quantity.ACCELERATION), longest_hold_s=0.25)
    root.add([reading(Quantity.ACCELERATION, 0), reading(Quantity.ACCELERATION, 100 * MS)])
    np.testing.assert_allclose(root.acceleration(30 * MS), motion(Quantity.ACCELERATION, 0.03), rtol=1e-12)
    np.testing.assert_array_equal(root.acceleration(120 * MS), motion(Quantity.ACCELERATION, 0.1))
    assert np.isnan(root.acceleration(400 * MS)).all()
    assert np.isnan(root.acceleration(-1)).all()


def test_differences_begin_anew_after_a_gap():
    root = RootMotion(device(Quantity.VELOCITY), longest_hold_s=0.25)
    root.add(reading(Quantity.VELOCITY, t * MS) for t in (0, 10, 500))
    assert np.isnan(root.acceleration(500 * MS)).all()
    root.add([reading(Quantity.VELOCITY, 510 * MS)])
    np.testing.assert_allclose(root.acceleration(510 * MS), motion(Quantity.ACCELERATION, 0.505), rtol=1e-9)


def test_other_devices_other_quantities_repeats_and_nan_are_passed_over():
    root = RootMotion(device(Quantity.ACCELERATION), longest_hold_s=0.25)
    good = reading(Quantity.ACCELERATION, 10 * MS)
    nan = LocalReading(7, 20 * MS, Quantity.ACCELERATION, np.full(3, np.nan), np.zeros(3))
    other = reading(Quantity.ACCELERATION, 30 * MS, device=8)
    root.add([good, good, reading(Quantity.VELOCITY, 20 * MS), nan, other])
    np.testing.assert_array_equal(root.acceleration(40 * MS), good.value)


@pytest.mark.parametrize("fixed", [None, LocalDevice(Quantity.FIXED_POINT, 0, np.zeros(3))])
def test_a_fixed_point_has_no_acceleration(fixed):
    root = RootMotion(fixed, longest_hold_s=0.25)
    root.add([reading(Quantity.ACCELERATION, 0)])
    np.testing.assert_array_equal(root.acceleration(5), np.zeros(3))
    np.testing.assert_array_equal(root.position(5), np.zeros(3))


def test_only_a_position_device_places_the_root():
    for quantity in (Quantity.ACCELERATION, Quantity.POSITION):
        root = RootMotion(device(quantity), longest_hold_s=0.25)
        root.add(reading(quantity, t * MS) for t in (0, 10, 20))
        placed = quantity is Quantity.POSITION
        expected = motion(Quantity.POSITION, 0.02) if placed else np.zeros(3)
        np.testing.assert_array_equal(root.position(20 * MS), expected)
