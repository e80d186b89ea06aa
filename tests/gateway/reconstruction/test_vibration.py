"""What makes rows of accelerations count less: vibration, and inclinations that are hardly known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.reconstruction.inertial.tree.start import second_order_variance
from gateway.reconstruction.inertial.tree.state import initial_state
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.inertial.tree.vibration import watch_vibration

DT, TUNING = 0.01, tuning()


def watched(forces, dt=DT, gaps=()):
    seen = initial_state(1, 0).segments[0].vibration
    for k, force in enumerate(forces):
        watch_vibration(seen, force, k == 0 or k in gaps, TUNING, dt)
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
