"""By how much a magnetometer is late: found from force, field and place of a body that turns and shakes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.reconstruction.inertial import rate_free

RATE_HZ = 200.0
GRAVITY = np.array([0.0, 0.0, -9.81])
FIELD = np.array([0.0, 21.0, -45.0])


def turning(times):
    """Orientation at up to 5 rad/s about changing axes."""
    angles = np.stack(
        [np.sin(3.1 * times), 1.2 * np.sin(2.3 * times + 1.0), 1.5 * np.sin(1.7 * times)], axis=1
    )
    return Rotation.from_rotvec(angles)


def found_lag_s(lag_s, seconds=30.0, late_places=0, has_magnet=False):
    rng = np.random.default_rng(8)
    times = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    swing = np.array([4.0, 5.0, 6.0])
    place = 0.2 * np.sin(times[:, None] * swing)
    velocity = 0.2 * swing * np.cos(times[:, None] * swing)
    acceleration = -0.2 * swing**2 * np.sin(times[:, None] * swing)
    f = turning(times).inv().apply(acceleration - GRAVITY) + 0.03 * rng.standard_normal((len(times), 3))
    seen_field = FIELD + np.array([30.0, 20.0, -10.0]) * has_magnet
    m = turning(times - lag_s).inv().apply(seen_field) + 0.3 * rng.standard_normal((len(times), 3))
    finder = rate_free.lag_finder(1.0 / RATE_HZ, GRAVITY)
    for k, time in enumerate(times):
        rate_free.see_module(finder, time, f[k], m[k])
        j = k - late_places
        if j >= 0:
            noisy = place[j] + 3e-4 * rng.standard_normal(3)
            rate_free.see_place(finder, times[j], noisy, velocity[j], 5e-4, FIELD)
    return rate_free.lag_s(finder)


@pytest.mark.parametrize("lag_s", [0.0, 0.006, 0.015])
def test_the_lag_is_found_to_two_milliseconds(lag_s):
    assert found_lag_s(lag_s) == pytest.approx(lag_s, abs=0.002)


def test_places_that_come_later_than_the_frames_belong_to_their_own_instants():
    assert found_lag_s(0.012, late_places=2) == pytest.approx(0.012, abs=0.002)


def test_a_magnet_teaches_nothing():
    assert found_lag_s(0.015, has_magnet=True) == 0.0


def test_places_too_old_for_the_window_are_passed_over():
    assert found_lag_s(0.015, seconds=5.0, late_places=40) == 0.0
