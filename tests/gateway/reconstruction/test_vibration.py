"""What makes rows of accelerations count less: vibration, and inclinations that are hardly known."""

import numpy as np
import pytest

from gateway.reconstruction.inertial.tree.prediction import watch_vibration
from gateway.reconstruction.inertial.tree.start import second_order_variance
from gateway.reconstruction.inertial.tree.state import initial_state
from gateway.reconstruction.inertial.tree.tuning import tuning

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


@pytest.mark.parametrize("sigma", [0.05, 0.2, 0.4])
def test_it_is_the_mean_square_of_the_second_order_of_a_tilt(sigma):
    rng, u = np.random.default_rng(2), np.array([0.0, 0.0, 9.81])
    segment = initial_state(1, 0).segments[0]
    segment.P[0, 0] = segment.P[1, 1] = sigma**2
    tilts = np.zeros((200_000, 3))
    tilts[:, :2] = sigma * rng.standard_normal((200_000, 2))
    second = 0.5 * np.cross(tilts, np.cross(tilts, u))
    assert second_order_variance(segment, u, TUNING, 1.0) == pytest.approx(
        np.mean(second[:, 2] ** 2), rel=0.05
    )


def test_rows_that_come_often_share_it():
    segment = initial_state(1, 0).segments[0]
    segment.P[0, 0] = segment.P[1, 1] = 0.04
    u = np.array([3.0, 4.0, 12.0])
    assert second_order_variance(segment, u, TUNING, 0.01) == pytest.approx(
        100.0 * second_order_variance(segment, u, TUNING, 1.0)
    )
