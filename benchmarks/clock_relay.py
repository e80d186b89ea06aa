"""Modules behind a relay unit that sends every tick what came: samples tell the tick, answers the clock."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.clock_simulation import JITTER_US, LATENCY_US, LOSS, Crystal
from gateway.clocks import EstimatedClock, LinkBatching
from gateway.frames import FloatArray

TICK_US = 10_000.0
CABLE_US = 200.0
"""Mean of the delay between relay and host, exponential, the same for all that is in a batch."""
ASKED_EVERY_US = (225_000.0, 275_000.0)
"""As the gateway asks: in step with nothing."""


class _Sent(NamedTuple):
    """What a module has sent, in its order: samples and answers."""

    true_us: FloatArray  # (n,) gateway time of the stamps
    stamps_us: FloatArray  # (n,) module's clock
    asked_us: FloatArray  # (n,) gateway time of the question; NaN: a sample
    ready_us: FloatArray  # (n,) at the relay


def relay_errors(
    rng: np.random.Generator, crystal: Crystal, seconds: FloatArray, rate_hz: float
) -> FloatArray:
    """Published minus true instants of samples at some times, µs; both (m,). seconds: rising, s."""
    sent = _sent(rng, crystal, float(seconds[-1]) + 2.0, rate_hz)
    ticks = np.ceil(sent.ready_us / TICK_US).astype(np.int64)
    cable_us = LATENCY_US + rng.exponential(CABLE_US, ticks.max() + 1)
    arrived_us = ticks * TICK_US + cable_us[ticks]
    batching = LinkBatching()
    batching.slot_us = TICK_US  # found from the relay's stamps within a second
    clock, errors = EstimatedClock(batching), []
    for k in np.argsort(arrived_us, kind="stable").tolist():
        stamp, arrived_ns = round(sent.stamps_us[k]), round(arrived_us[k] * 1e3)
        if sent.asked_us[k] > 0.0:
            clock.add_exchange(round(sent.asked_us[k] * 1e3), stamp % 2**32, stamp % 2**32, arrived_ns)
        else:
            published_us = clock.gateway_time(stamp % 2**32, arrived_ns) * 1e-3
            errors.append((sent.true_us[k], published_us - sent.true_us[k]))
    at_us, error_us = np.array(sorted(errors)).T
    return error_us[np.searchsorted(at_us, seconds * 1e6)]


def _sent(rng: np.random.Generator, crystal: Crystal, seconds: float, rate_hz: float) -> _Sent:
    elapsed_us = np.arange(0.0, seconds * 1e6, 1e6 / rate_hz)
    elapsed_us = elapsed_us[rng.random(len(elapsed_us)) >= LOSS]
    true_us = crystal.true_us(elapsed_us)
    asked_us = np.cumsum(rng.uniform(*ASKED_EVERY_US, int(seconds / 0.2)))
    asked_us = asked_us[asked_us < true_us[-1]]
    heard_us = asked_us + LATENCY_US + rng.exponential(JITTER_US, len(asked_us))
    all_true_us = np.concatenate([true_us, heard_us])
    stamps_us = np.concatenate([elapsed_us, np.interp(heard_us, true_us, elapsed_us)])
    return _Sent(
        all_true_us,
        stamps_us + crystal.start_us,
        np.concatenate([np.full(len(true_us), np.nan), asked_us]),
        all_true_us + LATENCY_US + rng.exponential(JITTER_US, len(all_true_us)),
    )
