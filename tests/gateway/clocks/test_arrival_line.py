"""Instants without stamps: against samples whose instants are known."""

from __future__ import annotations

import numpy as np
import pytest

from gateway.clocks import ArrivalLine

INTERVAL_NS = 10_017_000
LEAST_DELAY_NS = 2_000_000


def followed(times_ns, arrived_ns, steps):
    line = ArrivalLine()
    return np.array([line.instant(int(s), int(a)) for s, a in zip(steps, arrived_ns, strict=True)]), line


def test_wireless_jitter_is_taken_out_and_no_instant_is_after_its_arrival():
    rng = np.random.default_rng(1)
    times = np.arange(6000) * INTERVAL_NS
    arrived = np.maximum.accumulate(times + LEAST_DELAY_NS + rng.exponential(5e6, len(times)).astype(int))
    instants, line = followed(times, arrived, np.ones(len(times)))
    errors = (instants - times - LEAST_DELAY_NS)[1000:] * 1e-6
    assert line.interval_ns == pytest.approx(INTERVAL_NS, rel=1e-3)
    assert (instants <= arrived).all()
    assert np.abs(errors).max() < 3.0
    assert np.std(arrived[1000:] - times[1000:]) * 1e-6 > 4.0 > 4 * np.std(errors)


def test_lost_samples_leave_their_place():
    times = np.delete(np.arange(4000), np.arange(500, 4000, 50)) * INTERVAL_NS
    steps = np.diff(times, prepend=-INTERVAL_NS) // INTERVAL_NS
    instants, line = followed(times, times + LEAST_DELAY_NS, steps)
    assert np.abs(instants - times - LEAST_DELAY_NS)[100:].max() < 10_000
    assert line.intervals_since(int(times[-1]) + LEAST_DELAY_NS + 3 * INTERVAL_NS) == 3


def test_a_burst_after_a_stall_is_spread_over_its_instants():
    times = np.arange(3000) * INTERVAL_NS
    arrived = times + LEAST_DELAY_NS
    arrived[2000:2008] = arrived[2008]  # eighty milliseconds of nothing, then all at once
    instants, _ = followed(times, arrived, np.ones(len(times)))
    assert np.abs(instants - times - LEAST_DELAY_NS)[1999:].max() < 8_000_000


def test_a_device_that_pauses_is_followed_and_a_long_silence_begins_anew():
    times = np.arange(3000) * INTERVAL_NS
    times[1500:] += 60_000_000
    times[2500:] += 5_000_000_000
    instants, _ = followed(times, times + LEAST_DELAY_NS, np.ones(len(times)))
    errors = np.abs(instants - times - LEAST_DELAY_NS) * 1e-6
    assert errors[1560:2400].max() < 3.0
    assert errors[2501:].max() < 1.0


def known_after(arrived_ns):
    """Return how many samples come until the interval is known, and what it is then."""
    line = ArrivalLine()
    for k, arrival in enumerate(arrived_ns):
        line.instant(1, int(arrival))
        if line.interval_ns:
            return k + 1, line.interval_ns
    raise AssertionError("never known")


@pytest.mark.parametrize("jitter_ns", [1e6, 3e6])
def test_the_first_instants_are_as_good_as_later_ones_a_tenth_of_a_second_after_the_start(jitter_ns):
    known, early, late = [], [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        times = np.arange(500) * INTERVAL_NS
        delays = LEAST_DELAY_NS + rng.exponential(jitter_ns, len(times)).astype(int)
        arrived = np.maximum.accumulate(times + delays)
        known.append(known_after(arrived)[0])
        instants, _ = followed(times, arrived, np.ones(len(times)))
        errors = np.abs(instants - times - LEAST_DELAY_NS)
        early.append(errors[known[-1] : 100].mean())
        late.append(errors[100:].mean())
    assert np.median(known) <= 10
    assert max(known) <= 32
    assert np.mean(early) < jitter_ns / 2
    assert np.mean(late) < jitter_ns / 3


def test_a_burst_at_the_start_is_no_interval():
    times = np.arange(300) * INTERVAL_NS
    arrived = times + LEAST_DELAY_NS
    arrived[:20] = arrived[20]  # the gateway was busy, then all at once
    known, interval_ns = known_after(arrived)
    assert known <= 32
    assert interval_ns == pytest.approx(INTERVAL_NS, rel=0.01)


def test_a_device_that_sends_in_bursts_is_followed_too():
    times = np.arange(3000) * INTERVAL_NS
    arrived = times // (10 * INTERVAL_NS) * 10 * INTERVAL_NS + 10 * INTERVAL_NS  # ten at a time
    instants, line = followed(times, arrived, np.ones(len(times)))
    assert line.interval_ns == pytest.approx(INTERVAL_NS, rel=0.01)
    steps = np.diff(instants[1000:])
    assert steps.min() > 0.5 * INTERVAL_NS
    assert steps.max() < 1.5 * INTERVAL_NS
