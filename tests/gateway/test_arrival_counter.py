"""Samples with neither count nor stamp are numbered by their arrivals."""

from __future__ import annotations

import itertools
from random import Random

import pytest

from gateway.sources.arrival_counter import ArrivalCounter

RATES = (10, 20, 50, 100, 125, 200)
SECOND_NS = 1_000_000_000


def offsets(counter, rate_hz, lost, *, jitter_ms=1.0, slot_ms=0.0, bits=None, seconds=40, seed=1):
    """True minus told number of each sample, from the first told on. lost: of a number, whether it is."""
    rng, arrived_ns, found = Random(seed), 0.0, []
    for k in range(round(seconds * rate_hz)):
        ready_ns = k * SECOND_NS / rate_hz + rng.expovariate(1 / (jitter_ms * 1e6))
        arrived_ns = max(arrived_ns, ready_ns)
        if slot_ms:
            arrived_ns = -(-arrived_ns // (slot_ms * 1e6)) * slot_ms * 1e6
        if lost(k, rng):
            continue
        told = counter.stamp(round(arrived_ns), None if bits is None else (k + 7) % 2**bits)
        if told is not None:
            found.append(k - told[0])
    return [each - found[0] for each in found]


@pytest.mark.parametrize(("jitter_ms", "slot_ms"), [(0.2, 0), (1, 1), (3, 0), (1, 16)])
def test_with_nothing_lost_numbers_go_on_by_one_whatever_the_link_does(jitter_ms, slot_ms):
    counter = ArrivalCounter(RATES)
    assert set(offsets(counter, 100, lambda k, _: False, jitter_ms=jitter_ms, slot_ms=slot_ms)) == {0}
    assert counter.interval_ns == 1e7


def test_a_loss_is_noticed_within_a_fifth_of_a_second():
    found = offsets(ArrivalCounter(RATES), 100, lambda k, _: 1000 <= k < 1003)
    assert set(found[:900]) == {0}
    assert set(found[1003 - 72 + 25 :]) == {0}


@pytest.mark.parametrize("true_hz", [99.3, 100.0, 100.7])
def test_many_losses_and_a_crystal_that_is_off_leave_no_error_that_grows(true_hz):
    found = offsets(
        ArrivalCounter(RATES), true_hz, lambda k, rng: k > 200 and rng.random() < 0.03, seconds=120
    )
    assert max(map(abs, found)) <= 8
    assert sum(found) / len(found) < 1.5


def test_a_stall_with_nothing_lost_is_no_loss():
    counter, found = ArrivalCounter(RATES), []
    for k in range(600):
        ready_ns = k * SECOND_NS // 100
        held_ns = 4 * SECOND_NS if 300 <= k < 400 else 0
        told = counter.stamp(max(ready_ns, min(held_ns, 4 * SECOND_NS)))
        found += [] if told is None else [k - told[0]]
    assert set(found) == {found[0]}


@pytest.mark.parametrize("rates", [RATES, ()])
@pytest.mark.parametrize("stalled", [(0, 20), (0, 40), (0, 400), (10, 40), (24, 100), (40, 60)])
def test_a_stall_while_the_rate_is_learnt_spoils_it_not(rates, stalled):
    counter, (first, last) = ArrivalCounter(rates), stalled
    for k in range(last + 200):
        counter.stamp(max(k, last if first <= k < last else 0) * SECOND_NS // 200)
    assert counter.interval_ns == pytest.approx(SECOND_NS / 200)


@pytest.mark.parametrize("catching_up_hz", [125, 160, 200])
@pytest.mark.parametrize("true_hz", [50, 100, 125])
def test_a_late_start_that_is_made_up_for_evenly_is_not_taken_for_the_rate(true_hz, catching_up_hz):
    """What had waited comes evenly too, where a slow line or a busy reader makes up for it."""
    for n_waited in range(2, 50):
        counter = ArrivalCounter(RATES)
        waited_ns = n_waited * (SECOND_NS // true_hz - SECOND_NS // catching_up_hz)
        for k in range(n_waited + 200):
            ready_ns, passed_ns = k * SECOND_NS // true_hz, waited_ns + k * SECOND_NS // catching_up_hz
            counter.stamp(max(ready_ns, passed_ns))
            assert counter.interval_ns in (None, SECOND_NS / true_hz), n_waited


def test_counts_tell_losses_at_once_up_to_half_a_period():
    found = offsets(
        ArrivalCounter((100,), counter_bits=8),
        100,
        lambda k, rng: 500 <= k < 600 or rng.random() < 0.1,
        bits=8,
    )
    assert set(found) == {0}


def test_a_device_that_counts_from_anew_goes_on():
    counter = ArrivalCounter((), rate_hz=100, counter_bits=8)
    counts = [*range(100, 140), *range(40)]
    told = [counter.stamp(k * SECOND_NS // 100, count)[0] for k, count in enumerate(counts)]
    assert [b - a for a, b in itertools.pairwise(told)] == [1] * 79


def test_stamps_are_numbers_by_the_interval_and_wrap():
    counter = ArrivalCounter((), rate_hz=200)
    told = [counter.stamp(k * SECOND_NS // 200) for k in range(10)]
    assert told == [(k, 5000 * k) for k in range(10)]


@pytest.mark.parametrize("then_hz", [50, 200])
def test_a_device_that_is_set_to_another_rate_is_followed_within_a_few_seconds(then_hz):
    counter, at_ns, told = ArrivalCounter(RATES), 0, []
    for k in range(3000):
        at_ns += SECOND_NS // (100 if k < 1000 else then_hz)
        told += [(counter.stamp(at_ns), at_ns)]
    assert counter.interval_ns == SECOND_NS / then_hz
    told = [(found, arrived_ns) for found, arrived_ns in told if found is not None]
    late_us = [arrived_ns // 1000 - stamp_us for (_, stamp_us), arrived_ns in told]
    assert abs(late_us[-1] - late_us[0]) < 20_000
    assert told[-1][0][0] < 3000
