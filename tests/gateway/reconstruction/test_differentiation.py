"""Derivatives by local least squares: exact for cubics, with the noise and bandwidth that are stated."""

from __future__ import annotations

import numpy as np
import pytest

from gateway.reconstruction.inertial.local_devices import BANDWIDTH, Differentiator


def run(n_derivatives, times_s, values, window_s=0.1, sigma=0.0):
    d = Differentiator(n_derivatives, window_s, 0.25)
    found = [d.add(round(t * 1e9), v, np.full(3, sigma)) for t, v in zip(times_s, values, strict=True)]
    return [f for f in found if f is not None]


@pytest.mark.parametrize("n_derivatives", [1, 2])
def test_exact_where_a_polynomial_is_fitted_at_uneven_instants(n_derivatives):
    times = np.cumsum(np.random.default_rng(1).uniform(0.003, 0.02, 60))
    degree = n_derivatives + 1
    for f in run(n_derivatives, times, times[:, None] ** degree * np.array([1.0, -2.0, 0.5])):
        t = f.time_ns * 1e-9
        expected = (2.0 if n_derivatives == 1 else 6.0) * t * np.array([1.0, -2.0, 0.5])
        np.testing.assert_allclose(f.value, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("n_derivatives", [1, 2])
def test_the_noise_is_what_sigma_says(n_derivatives):
    times = np.arange(4000) * 0.005
    noise = 0.01 * np.random.default_rng(2).standard_normal((4000, 3))
    found = run(n_derivatives, times, noise, sigma=0.01)[40:]
    measured = np.std([f.value for f in found])
    assert measured == pytest.approx(found[-1].sigma[0], rel=0.1)


@pytest.mark.parametrize("n_derivatives", [1, 2])
def test_half_the_power_is_left_at_the_stated_bandwidth(n_derivatives):
    window_s = 0.1
    omega = 2.0 * np.pi * BANDWIDTH[n_derivatives] / window_s
    times = np.arange(2000) * 0.001
    values = np.repeat(np.sin(omega * times)[:, None], 3, axis=1)
    found = run(n_derivatives, times, values, window_s)[200:]
    amplitude = np.max([f.value[0] for f in found]) / omega**n_derivatives
    assert amplitude == pytest.approx(np.sqrt(0.5), abs=0.04)


def test_good_readings_are_not_made_to_wait():
    times = np.arange(40) * 0.005
    for sigma, lag_s in ((0.0, 0.005), (1e-3, 0.05)):
        d = Differentiator(2, 0.1, 0.25, wanted_sigma=1.0)
        found = [d.add(round(t * 1e9), np.zeros(3), np.full(3, sigma)) for t in times]
        assert times[-1] - found[-1].time_ns * 1e-9 == pytest.approx(lag_s, rel=0.35)


def test_begins_anew_after_a_gap():
    d = Differentiator(2, 0.1, 0.25)
    given = [d.add(t * 1_000_000, np.zeros(3), np.zeros(3)) for t in (0, 10, 20, 500, 510)]
    assert [g is not None for g in given] == [False, False, True, False, False]


def test_a_third_derivative_is_refused():
    with pytest.raises(ValueError, match="1 or 2"):
        Differentiator(3, 0.1, 0.25)
