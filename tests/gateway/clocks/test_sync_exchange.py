"""Two-way exchanges: the arithmetic, tokens, and what they do for the estimate."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.clocks import EstimatedClock, Exchange, SyncExchanges


@given(st.integers(0, 2**32 - 1), st.integers(0, 50_000), st.integers(0, 50_000), st.integers(0, 2_000_000))
def test_the_offset_lies_within_the_bound_whatever_the_delays(stamp_us, there_us, back_us, held_us):
    sent_ns = 10**15
    received_true_ns = sent_ns + there_us * 1000
    exchange = Exchange(
        sent_ns, stamp_us, (stamp_us + held_us) % 2**32, received_true_ns + (held_us + back_us) * 1000
    )
    true_offset_us = received_true_ns * 1e-3 - stamp_us
    assert exchange.round_trip_us == pytest.approx(there_us + back_us, abs=0.3)
    assert abs(exchange.offset_us - true_offset_us) <= exchange.bound_us + 0.3
    if there_us == back_us:
        assert exchange.offset_us == pytest.approx(true_offset_us, abs=0.3)


def test_answers_are_matched_by_token_and_counted():
    sync = SyncExchanges()
    for token in range(4):
        sync.sent(token, token * 10**9)
    assert sync.unanswered == 1  # token 0, 3 s old
    assert sync.answered(0, 5, 6, 3 * 10**9 + 500) is None
    assert sync.answered(3, 1000, 1200, 3 * 10**9 + 1_000_000) == Exchange(
        3 * 10**9, 1000, 1200, 3_001_000_000
    )
    assert sync.answered(3, 1000, 1200, 3 * 10**9 + 1_000_000) is None  # only once
    assert sync.answered(2, 1000, 900_000, 2 * 10**9 + 1000) is None  # answered later than it arrived
    assert (sync.completed, sync.unexpected) == (1, 3)


def test_requests_are_not_remembered_for_ever():
    sync = SyncExchanges()
    for token in range(1000):
        sync.sent(token, token)
    assert sync.unanswered == 1000 - 64


@pytest.mark.parametrize("latency_us", [300.0, 4000.0])
def test_exchanges_take_the_latency_out_of_the_offset_and_give_a_bound(latency_us):
    rng = np.random.default_rng(6)
    clock, n, ppm = EstimatedClock(), 12_000, -70.0
    true_us = np.arange(n) * 1e4
    stamps = np.round(true_us * (1 + ppm * 1e-6)).astype(np.int64) + 2**32 - 30_000_000
    arrived = true_us + latency_us + rng.exponential(1000, n)
    sent = true_us - latency_us - rng.exponential(1000, n)
    errors = []
    for k in range(n):
        stamp, at = int(stamps[k]) % 2**32, round(arrived[k] * 1e3)
        if k % 25 == 0:
            clock.add_exchange(round(sent[k] * 1e3), stamp, stamp, at)
        instant = clock.gateway_time(stamp, at)
        errors.append(instant * 1e-3 - true_us[k])
    figures = clock.figures()
    assert np.abs(errors[6000:]).max() < 60
    assert figures.skew_ppm == pytest.approx(ppm, abs=1)
    assert figures.bound_us is not None
    assert latency_us < figures.bound_us < latency_us + 300
    assert np.abs(np.diff(errors[100:])).max() < 210  # slewed: 2 % of a sampling interval at the most
