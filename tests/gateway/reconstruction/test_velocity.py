"""Speeds are bounded: what the velocity that a lone module feels says of its tilt."""

import numpy as np
import pytest

from gateway.body.rig import load_rig
from gateway.frames import FloatArray, ImuFrame
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings, JointReconstructor
from gateway.reconstruction.inertial.tree.state import initial_state
from gateway.reconstruction.inertial.tree.velocity import learn_velocity

HZ, GRAVITY = 100, 9.81


def test_the_velocity_is_that_of_a_kalman_filter_of_tilt_and_velocity() -> None:
    """One axis: a velocity that owes T g times the tilt's error to it, and is else independent of it."""
    velocity = initial_state(1, 0).segments[0].velocity
    velocity.felt[...], velocity.tilted_s, velocity.variance = (0.8, 0.0, 0.0), 1.5, 0.04
    tilt_square, look = 0.02**2, 0.3
    slope = GRAVITY * velocity.tilted_s
    prior = np.array([[tilt_square, slope * tilt_square], [0.0, velocity.variance + slope**2 * tilt_square]])
    prior[1, 0] = prior[0, 1]
    gain = prior[:, 1] / (prior[1, 1] + look)
    mean, after = np.array([0.0, 0.8]) - gain * 0.8, prior - np.outer(gain, prior[1])
    learn_velocity(velocity, look)
    slope_after = GRAVITY * velocity.tilted_s
    assert velocity.felt[0] + slope_after * mean[0] == pytest.approx(mean[1])
    assert slope_after == pytest.approx(after[0, 1] / after[0, 0])
    assert velocity.variance == pytest.approx(after[1, 1] - after[0, 1] ** 2 / after[0, 0])


def tilts_deg(acceleration: FloatArray) -> FloatArray:
    """Inclinations of a module that is carried along x without turning; acceleration (T,), m/s²."""
    rng, n = np.random.default_rng(3), len(acceleration)
    force = np.stack([acceleration, np.zeros(n), np.full(n, GRAVITY)], axis=1) + rng.normal(0.0, 0.03, (n, 3))
    rate = np.array([0.003, -0.002, 0.004]) + rng.normal(0.0, 0.002, (n, 3))
    measured, no_gap, no_field = np.zeros(1, np.uint8), np.zeros(1, np.int64), np.full((1, 3), np.nan)
    frames = [
        ImuFrame(k, k * 10_000_000, force[k : k + 1], rate[k : k + 1], no_field, measured, no_gap)
        for k in range(n)
    ]
    filter_ = JointReconstructor(load_rig("single"), 1.0 / HZ, ChainSettings(uses_field=False))
    q_wb = np.stack([pose.q_wb[0] for pose in filter_.update_many(frames)])
    up = 1.0 - 2.0 * (q_wb[:, 1] ** 2 + q_wb[:, 2] ** 2)
    return np.asarray(np.degrees(np.arccos(np.clip(up, -1.0, 1.0))))


def test_whoever_swings_on_the_spot_stays_level() -> None:
    """A metre to and fro each second, at up to 3 m/s and 20 m/s²."""
    times_s = np.arange(60 * HZ) / HZ
    swung = 20.0 * np.cos(2.0 * np.pi * times_s) * (times_s > 5.0)
    tilt = tilts_deg(swung)
    assert tilt[8 * HZ :].max() < 1.5
    assert np.sqrt(np.mean(tilt[20 * HZ :] ** 2)) < 0.5


def test_a_body_that_stays_fast_is_level_again_within_half_a_minute() -> None:
    """To 10 m/s within five seconds, as on a scooter: thirty times the speed that is taken for usual."""
    times_s = np.arange(60 * HZ) / HZ
    tilt = tilts_deg(np.where((times_s > 10.0) & (times_s < 15.0), 2.0, 0.0))
    assert 1.0 < tilt.max() < 8.0
    assert tilt[45 * HZ :].max() < 0.5
