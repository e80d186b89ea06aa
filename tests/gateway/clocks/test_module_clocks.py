"""Clocks: wrap, restart, skew under jitter, shared offset."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.clocks import EstimatedClock, SharedClock, SharedOffset, unwrap

SECOND_NS = 1_000_000_000


@given(st.integers(-(10**12), 10**15), st.integers(-(2**31) + 1, 2**31 - 1))
def test_unwrap_finds_the_full_count_nearest(full, error):
    assert unwrap(full % 2**32, 32, full + error) == full


def stamps(n, ppm=0.0, start_us=0, interval_s=0.01, delays_s=None, first_s=0.0):
    """(stamp, arrival ns, true ns) of a module whose clock is ``ppm`` fast."""
    for k in range(n):
        true_s = first_s + k * interval_s
        stamp = int(start_us + true_s * 1e6 * (1 + ppm * 1e-6)) % 2**32
        delay_s = 0.0005 if delays_s is None else delays_s[k]
        yield stamp, round((true_s + delay_s) * 1e9), round(true_s * 1e9)


@pytest.mark.parametrize("ppm", [-3000.0, -80.0, 0.0, 100.0])
@pytest.mark.parametrize("start_us", [0, 2**32 - 5_000_000])
def test_skew_and_instants_are_found_under_jitter(ppm, start_us):
    delays = 0.0005 + np.random.default_rng(1).exponential(0.001, 6000)
    clock = EstimatedClock()
    errors_us = [
        (clock.gateway_time(stamp, arrived) - true) / 1000
        for stamp, arrived, true in stamps(6000, ppm, start_us, delays_s=delays)
    ]
    assert clock.figures().skew_ppm == pytest.approx(ppm, abs=2)
    settled = np.array(errors_us[3000:])
    assert abs(np.median(settled) - 500) < 100  # the least delay cannot be told from an offset
    assert np.ptp(settled) < 150


def test_instants_never_run_backwards_while_stamps_advance():
    delays = np.random.default_rng(2).exponential(0.003, 3000)
    clock = EstimatedClock()
    times = [clock.gateway_time(s, a) for s, a, _ in stamps(3000, 60, delays_s=delays)]
    assert np.min(np.diff(times[300:])) > 0.009 * SECOND_NS


def test_a_restarted_module_is_recognised():
    clock = EstimatedClock()
    for stamp, arrived, _ in stamps(500, start_us=900_000_000):
        clock.gateway_time(stamp, arrived)
    for stamp, arrived, true in stamps(500, start_us=-5_000_000, first_s=5.0):
        time_ns = clock.gateway_time(stamp, arrived)
        assert abs(time_ns - true) < 1_000_000
    assert clock.restarts == 1


def test_shared_clocks_have_one_offset_whatever_the_delays():
    shared = SharedOffset()
    first, second = SharedClock(shared), SharedClock(shared)
    assert first.gateway_time(1_000, 5_000_000) == 5_000_000
    assert second.gateway_time(1_000, 9_000_000) == 5_000_000
    assert second.gateway_time(2_500, 90_000_000) == 6_500_000
    assert first.figures().offset_ns == second.figures().offset_ns == 4_000_000


def test_shared_clock_wraps():
    clock = SharedClock(SharedOffset())
    start = clock.gateway_time(2**32 - 1000, 0)
    assert clock.gateway_time(1000, 3_000_000) - start == 2_000_000


@pytest.mark.parametrize("arrived_s", [0, 1000, 1_795_324_000, 1_795_326_000, 1_795_328_000])
def test_a_shared_clock_may_begin_at_nought(arrived_s):
    """Whatever the time of day: half of each 72 minutes, poses were decades ahead."""
    clock, arrived_ns = SharedClock(SharedOffset()), arrived_s * 10**9
    assert clock.gateway_time(0, arrived_ns) == arrived_ns
    for stamp_us in range(10_000, 100_000, 10_000):
        at_ns = arrived_ns + stamp_us * 1000
        assert clock.gateway_time(stamp_us, at_ns) == at_ns
    assert clock.restarts == 0
