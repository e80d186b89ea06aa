"""Samples that all wait for the same step of a cycle, and answers that do not: the floor is the answers'."""

import numpy as np
import pytest
from scipy.optimize import minimize

from gateway.clocks import EstimatedClock, floor_filter
from gateway.emulation.clock_simulation import Crystal, relay_errors

CYCLE_S, LATENCY_S = 0.010, 0.002


def errors_ms(phase_s, seed, seconds=12.0, first_late_s=0.0):
    """Published less true instants of samples at 100 Hz, with exchanges at 4 Hz, by time.

    What is sampled ``phase_s`` into the cycle is sent at the cycle's end; answers are sent at once. Whatever
    is sent in the first second comes ``first_late_s`` late.
    """
    rng = np.random.default_rng(seed)
    sampled_s = np.arange(phase_s, seconds, 0.01)
    came_s = sampled_s + CYCLE_S - phase_s + LATENCY_S + rng.exponential(0.0005, len(sampled_s))
    events = [(at, true_s, None) for at, true_s in zip(came_s, sampled_s, strict=True)]
    for sent_s in np.arange(0.05, seconds, 0.25):
        received_s = sent_s + LATENCY_S + rng.exponential(0.0005)
        events.append((received_s + LATENCY_S + rng.exponential(0.0005), received_s, sent_s))
    events = sorted((at if at > 1.0 else at + first_late_s, *rest) for at, *rest in events)
    clock, errors = EstimatedClock(), []
    for at, true_s, sent_s in events:
        stamp, arrived_ns = round(true_s * 1e6), round(at * 1e9)
        if sent_s is None:
            errors.append((true_s, clock.gateway_time(stamp, arrived_ns) * 1e-6 - true_s * 1e3))
        else:
            clock.add_exchange(round(sent_s * 1e9), stamp, stamp, arrived_ns)
    return np.array(errors)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("phase_s", [0.0005, 0.003, 0.006, 0.009])
def test_answers_that_come_at_once_tell_the_offset_of_samples_that_wait(phase_s, seed):
    errors = errors_ms(phase_s, seed)
    assert np.abs(errors[errors[:, 0] > 5.0, 1]).max() < 2.5
    assert np.abs(errors[errors[:, 0] > 9.0, 1]).max() < 1.0


@pytest.mark.parametrize("seed", range(3))
def test_a_start_that_comes_late_as_a_whole_is_seen_through(seed):
    errors = errors_ms(0.003, seed, first_late_s=0.3)
    assert np.abs(errors[errors[:, 0] > 8.0, 1]).max() < 2.5


@pytest.mark.parametrize("ppm", [45.0, -40.0, 100.0])
def test_behind_a_relay_the_ticks_are_not_taken_for_the_module_s_clock(ppm):
    """Samples drift through the relay's ticks and all come at a tick: by themselves they tell its clock."""
    rng = np.random.default_rng(7)
    errors = relay_errors(rng, Crystal(rng, 130.0, ppm), np.arange(15.0, 120.0), 100.0)
    assert np.abs(errors).max() < 2000.0
    assert np.sqrt(np.mean(errors**2)) < 1000.0


@pytest.mark.parametrize("seed", range(20))
def test_the_most_likely_line_is_found_however_far_the_packets_are_from_it(seed):
    rng = np.random.default_rng(seed)
    n, mean_us = int(rng.integers(5, 120)), 10 ** rng.uniform(2, 4)
    t = np.sort(rng.uniform(-1.0, 0.0, n))
    d = rng.uniform(-1e4, 1e4) + rng.normal(0, 500) * t + rng.exponential(mean_us, n)
    x = np.array([d.min() - rng.choice([0.0, 3.0, 30.0]) * mean_us, rng.normal(0, 300)])
    P = np.diag([10 ** rng.uniform(2, 6), 10 ** rng.uniform(1, 3.4)]) ** 2
    A, weight, corner = np.linalg.inv(P), np.full(n, 0.5), 10.0
    c = x[0] + min(0.0, (d - x[0] - x[1] * t).min())
    prior, packets = floor_filter.Prior(x, A), floor_filter.Packets(t, d, weight, mean_us, 40.0, corner)
    found, _ = floor_filter._most_likely(c, x[1], prior, packets)

    def loss(step):
        state = found + step * np.array([mean_us, 1000.0]) / n
        return -floor_filter._log_posterior(*state, prior, packets)

    best = minimize(loss, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-6})
    assert loss(np.zeros(2)) - best.fun < 0.05
