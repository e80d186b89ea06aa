"""Modules that keep their clocks together are put on one line, whatever their links delay; others are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.clocks import LinkBatching, SynchronisedClocks

BEGUN_NS = 1_800_000_000_000_000_000
PERIOD_US = 10_000


def played(devices, seconds, seed=1):
    """(true ns, found ns) by device, (n, 2), and the clocks. A device: least delay, ms, skew, ppm, start,
    µs, and from which second on it counts otherwise, with its start there.
    """
    rng = np.random.default_rng(seed)
    clocks = SynchronisedClocks()
    found = {name: clocks.clock(LinkBatching()) for name in devices}
    heard = []
    for name, (delay_ms, ppm, start_us, *later) in devices.items():
        for k in range(round(seconds * 1e6 / PERIOD_US)):
            true_us = k * PERIOD_US
            begins_us = start_us
            if later and true_us >= later[0] * 1e6:
                begins_us = later[1]
            stamp = round(begins_us + true_us * (1 + ppm * 1e-6)) % 2**32
            delay_us = delay_ms * 1e3 + rng.exponential(1500.0)
            heard.append((BEGUN_NS + round((true_us + delay_us) * 1e3), name, true_us, stamp))
    instants = {name: [] for name in devices}
    for arrived_ns, name, true_us, stamp in sorted(heard):
        at_ns = found[name].gateway_time(stamp, arrived_ns)
        assert at_ns <= arrived_ns
        instants[name].append((BEGUN_NS + true_us * 1000, at_ns))
    return {name: np.array(each) for name, each in instants.items()}, found


def errors_ms(instants, since_s):
    late = instants[instants[:, 0] > BEGUN_NS + since_s * 1e9]
    return (late[:, 1] - late[:, 0]) * 1e-6


def test_what_links_delay_differently_does_not_come_between_them():
    instants, clocks = played({"a": (2.0, 30.0, 5_000), "b": (9.0, 30.0, 5_000)}, 20.0)
    a, b = (np.median(errors_ms(instants[name], 10.0)) for name in "ab")
    assert abs(a - b) < 0.2  # the least delays are 7 ms apart
    assert clocks["a"].figures() == clocks["b"].figures()
    assert clocks["a"].figures().skew_ppm == pytest.approx(30.0, abs=5.0)


@settings(max_examples=20, deadline=None)
@given(st.integers(10_000_000, 2**32 - 100_000_000), st.floats(-80, 80))
def test_a_module_that_counts_another_time_has_a_line_of_its_own(start_us, ppm):
    instants, clocks = played({"a": (2.0, 30.0, 0), "b": (2.0, 30.0, 0), "own": (2.0, ppm, start_us)}, 12.0)
    assert np.abs(errors_ms(instants["own"], 6.0)).max() < 8.0
    assert clocks["a"].figures() == clocks["b"].figures() != clocks["own"].figures()


def test_one_that_begins_anew_joins_again_once_it_is_synchronised():
    devices = {"a": (2.0, 0.0, 10**8), "b": (3.0, 0.0, 10**8, 8.0, 500)}
    instants, clocks = played(devices, 16.0)
    assert clocks["b"].restarts == 1
    assert clocks["a"].restarts == 0
    assert np.abs(errors_ms(instants["b"], 9.0)).max() < 12.0
    assert clocks["a"].figures() != clocks["b"].figures()


def test_a_single_damaged_stamp_moves_nobody():
    clocks = SynchronisedClocks()
    a, b = clocks.clock(LinkBatching()), clocks.clock(LinkBatching())
    for k in range(400):
        arrived_ns = BEGUN_NS + k * PERIOD_US * 1000 + 2_000_000
        a.gateway_time(k * PERIOD_US, arrived_ns)
        stamp = 3_000_000_000 if k == 200 else k * PERIOD_US
        assert b.gateway_time(stamp, arrived_ns) <= arrived_ns
    assert a.restarts == b.restarts == 0
    assert a.figures() == b.figures()
