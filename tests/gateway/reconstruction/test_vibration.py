"""What makes rows of accelerations count less: vibration, and inclinations that are hardly known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.reconstruction.inertial.tree.prediction import _shock_density, average
from gateway.reconstruction.inertial.tree.start import second_order_variance
from gateway.reconstruction.inertial.tree.state import Started, Validity, initial_state, work_space
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.inertial.tree.vibration import shock_variance, watch_vibration

DT, TUNING = 0.01, tuning()


def watched(forces, dt=DT, gaps=()):
    seen = initial_state(1, 0).segments[0].vibration
    for k, force in enumerate(forces):
        is_fresh = k == 0 or k in gaps
        watch_vibration(seen, force, is_fresh, TUNING.vibration_floor, TUNING.vibration_shock, TUNING, dt)
    return seen.square


def swing(seconds, dt, amplitude=40.0, hz=2.0):
    """Specific force of a fast arm, m/s²."""
    t = np.arange(0.0, seconds, dt)[:, None]
    return [0.0, 0.0, 9.81] + amplitude * np.sin(2 * np.pi * hz * t + [0.0, 1.0, 2.0])


@pytest.mark.parametrize("noise", [0.3, 1.5, 5.0])
@pytest.mark.parametrize("dt", [0.01, 0.025])
def test_noise_is_found_beneath_a_fast_motion(noise, dt):
    forces = swing(6.0, dt)
    shaken = forces + noise * np.random.default_rng(1).standard_normal(forces.shape)
    assert watched(shaken, dt) == pytest.approx(noise**2, rel=0.35)


@pytest.mark.parametrize("dt", [0.01, 0.025])
def test_a_fast_motion_alone_is_no_vibration(dt):
    assert watched(swing(6.0, dt), dt) < 0.1**2


def test_heels_that_strike_twice_a_second_are_none():
    forces = swing(6.0, DT, amplitude=5.0)
    forces[::50] += 60.0
    assert watched(forces) < 0.5**2


def test_nothing_is_made_of_what_lies_on_two_sides_of_a_gap():
    forces = np.concatenate((swing(1.0, DT), swing(1.0, DT)[::-1] + 100.0))
    assert watched(forces, gaps={100}) < 0.1**2


def uncertain(child, parent):
    """Two segments whose tilts have these standard deviations, rad."""
    both = initial_state(2, 0).segments
    for segment, sigma in zip(both, (child, parent), strict=True):
        segment.P[0, 0] = segment.P[1, 1] = sigma**2
    return both[0], both[1]


@pytest.mark.parametrize("sigmas", [(0.05, 0.05), (0.2, 0.05), (0.1, 0.3), (0.3, 0.3)])
def test_it_covers_what_a_row_about_the_mean_of_both_sides_leaves_out(sigmas):
    rng, y = np.random.default_rng(2), np.array([6.0, 0.0, 9.81])
    tilts = np.array(sigmas)[:, None, None] * rng.standard_normal((2, 100_000, 3)) * [1.0, 1.0, 0.0]
    angles = np.linalg.norm(tilts, axis=2, keepdims=True)
    gibbs = tilts * 2.0 * np.tan(0.5 * angles) / angles
    u, u_p = (Rotation.from_rotvec(-tilt).apply(y) for tilt in tilts)
    left = u - u_p - np.cross(0.5 * (u + u_p), gibbs[0] - gibbs[1])
    assert np.mean(np.sum(left**2, axis=1)) < second_order_variance(*uncertain(*sigmas), y, TUNING, 1.0)


def test_where_one_side_is_known_nothing_is_left_out():
    y, tilt = np.array([6.0, -2.0, 9.81]), np.array([1.1, -0.5, 0.7])
    u = Rotation.from_rotvec(-tilt).apply(y)
    gibbs = tilt / np.linalg.norm(tilt) * 2.0 * np.tan(0.5 * np.linalg.norm(tilt))
    np.testing.assert_allclose(np.cross(0.5 * (u + y), gibbs), u - y, atol=1e-12)
    assert second_order_variance(*uncertain(1.0, 0.0), y, TUNING, 1.0) == 0.0


def test_rows_that_come_often_share_it():
    both, u = uncertain(0.2, 0.2), np.array([3.0, 4.0, 12.0])
    assert second_order_variance(*both, u, TUNING, 0.01) == pytest.approx(
        100.0 * second_order_variance(*both, u, TUNING, 1.0)
    )


def calm(n, rng):
    """Readings of n frames of a module that hangs still, and what its accelerometer and gyroscope miss."""
    noise = 0.03 * rng.standard_normal((n, 3)), 0.002 * rng.standard_normal((n, 3))
    return [0.0, 0.0, 9.81] + noise[0], noise[1]


def felt(forces, rates, arm):
    """Averaged specific force at the arm, (T, 3), and what (12b) adds to its variance at once, (T,)."""
    state, work = initial_state(1, 0), work_space(1)
    segment, now, u, v = state.segments[0], work.segments[0], [], []
    segment.R[...], segment.started, now.validity = np.eye(3), Started.YES.value, Validity.FORCE.value
    for force, rate in zip(forces, rates, strict=True):
        now.specific_force[...], now.angular_rate[...] = force, rate
        _shock_density(segment, now, TUNING, DT)
        average(state, TUNING, work, DT)
        u.append(segment.averages.force + now.K @ arm)
        v.append(shock_variance(segment, arm, TUNING, DT) * DT / TUNING.smoothing_s)
    return np.array(u), np.array(v)


@pytest.mark.parametrize(("force", "rate"), [(5.0, 0.0), (40.0, 0.0), (0.0, 3.0), (0.0, 20.0)])
def test_what_a_spoilt_reading_leaves_in_a_row_is_covered_as_long_as_it_lasts(force, rate):
    rng, arm = np.random.default_rng(3), np.array([0.1, 0.2, -0.15])
    forces, rates = calm(200, rng)
    clean, nothing = felt(forces, rates, arm)
    forces[120] += force * np.array([0.6, 0.0, -0.8])
    rates[120] += rate * np.array([0.0, 0.8, 0.6])
    spoilt, variance = felt(forces, rates, arm)
    off = np.sum((spoilt - clean) ** 2, axis=1)
    lasting = off > 0.05**2
    assert lasting.sum() > 10
    assert not nothing.any()
    assert (off[lasting] <= 3.0 * variance[lasting] * 1.001).all()
    after = np.flatnonzero(lasting)[2:]  # once the reading and the next one are over, it is as much
    assert (off[after] > 0.75 * 3.0 * variance[after]).all()
    assert variance[-1] < 1e-3


def test_a_fast_motion_is_no_shock():
    forces = swing(6.0, DT)
    rates = 10.0 * np.sin(2 * np.pi * 2.0 * np.arange(len(forces))[:, None] * DT + [0.0, 1.0, 2.0])
    assert not felt(forces, rates, np.array([0.3, 0.0, 0.0]))[1][10:].any()
