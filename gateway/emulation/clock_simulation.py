"""Stamps and arrivals of a suit as arrays: crystals that drift, a link that delays and batches.

Behind a relay unit that sends every tick what came, samples show the tick, and answers the clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gateway.clocks import EstimatedClock, LinkBatching
from gateway.frames import FloatArray, IntArray

LATENCY_US = 500.0
JITTER_US = 1000.0
LOSS = 0.02
DRIFT_PPM_PER_S = 1.0 / 60.0
TURN_S = 600.0
"""Rates rise for so long at 1 ppm/min, then fall for as long: a module that warms up and cools down."""
SKEW_PPM = 100.0
TICK_US = 10_000.0
CABLE_US = 200.0
"""Mean of the delay between relay and host, exponential, the same for all that is in a batch."""
ASKED_EVERY_US = (225_000.0, 275_000.0)
"""As the gateway asks: in step with nothing."""


@dataclass(frozen=True)
class ModuleTraffic:
    """Packets of one module that were not lost."""

    counter: IntArray  # (n,)
    stamps_us: IntArray  # (n,) 32-bit
    true_us: FloatArray  # (n,) gateway time of sampling
    arrived_ns: IntArray  # (n,)
    latency_us: float
    interval_us: float


class Crystal:
    """True time of a module's own time."""

    def __init__(self, rng: np.random.Generator, seconds: float, skew_ppm: float) -> None:
        self._knots_s = np.arange(0.0, seconds * 1.01 + 10.0)
        turns = (self._knots_s + rng.uniform(0, 2 * TURN_S)) % (2 * TURN_S)
        rate_ppm = skew_ppm + DRIFT_PPM_PER_S * (TURN_S / 2 - np.abs(turns - TURN_S))
        steps = 0.5 * (rate_ppm[1:] + rate_ppm[:-1])
        self._slower_us = np.concatenate([[0.0], np.cumsum(steps)])
        self.rate_ppm = rate_ppm
        self.start_us = int(rng.integers(2**32))
        self.phase_us = rng.uniform(0, 10_000)

    def true_us(self, elapsed_us: FloatArray) -> FloatArray:
        """Return the gateway time, µs, at which the module has counted so much since its start."""
        slower_us = np.interp(elapsed_us * 1e-6, self._knots_s, self._slower_us)
        return np.asarray(elapsed_us + self.phase_us + slower_us, dtype=np.float64)


def module_traffic(
    rng: np.random.Generator,
    crystal: Crystal,
    seconds: float,
    rate_hz: float,
    slot_us: float,
    latency_us: float,
) -> ModuleTraffic:
    """Return one module's packets: exponential delay over the latency, order kept, handed over in slots."""
    counter = np.arange(int(seconds * rate_hz))
    elapsed_us: FloatArray = np.asarray(counter * (1e6 / rate_hz), dtype=np.float64)
    true_us = crystal.true_us(elapsed_us)
    arrived_us = true_us + latency_us + rng.exponential(JITTER_US, len(counter))
    # A packet cannot overtake the one before it on the same line.
    arrived_us = np.maximum.accumulate(arrived_us)
    if slot_us:
        # Handed over with the next slot, as by a USB frame or a radio's connection event.
        arrived_us = np.ceil(arrived_us / slot_us) * slot_us
    kept = rng.random(len(counter)) >= LOSS
    stamps = (np.round(elapsed_us).astype(np.int64) + crystal.start_us) % 2**32
    arrived_ns = np.round(arrived_us * 1e3).astype(np.int64)
    return ModuleTraffic(
        counter[kept], stamps[kept], true_us[kept], arrived_ns[kept], latency_us, 1e6 / rate_hz
    )


def transport_limit_us(slot_us: float, interval_us: float, seconds: float) -> float:
    """Return what no unbiased estimate beats at p99, µs: the rate known, so many seconds of packets.

    The Cramér–Rao bound of the offset for exponential delays seen in slots, averaged over the phase between
    sampling and slots.
    """
    n = seconds * 1e6 / interval_us * (1.0 - LOSS)
    phases = np.linspace(0.0, slot_us, 400, endpoint=False) + slot_us / 800
    spacing = np.gcd(int(slot_us), int(interval_us))
    lattice = (phases[:, None] + np.arange(0, slot_us, spacing)[None, :]) % slot_us
    x = lattice / JITTER_US  # from ready to the next hand-over, in mean delays
    information = (1.0 / np.expm1(x)).mean(axis=1) / JITTER_US**2
    return float(2.576 * np.sqrt(np.mean(1.0 / (n * information))))


class _Sent(NamedTuple):
    """What a module has sent, in its order: samples and answers."""

    true_us: FloatArray  # (n,) gateway time of the stamps
    stamps_us: FloatArray  # (n,) module's clock
    asked_us: FloatArray  # (n,) gateway time of the question; NaN: a sample
    ready_us: FloatArray  # (n,) at the relay


def relay_errors(
    rng: np.random.Generator, crystal: Crystal, seconds: FloatArray, rate_hz: float
) -> FloatArray:
    """Return published minus true instants (m,) of samples, µs. seconds: (m,) when they are, s, rising."""
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
    found_us: FloatArray = error_us[np.searchsorted(at_us, seconds * 1e6)]
    return found_us


def _sent(rng: np.random.Generator, crystal: Crystal, seconds: float, rate_hz: float) -> _Sent:
    elapsed_us = np.arange(0.0, seconds * 1e6, 1e6 / rate_hz)
    elapsed_us = elapsed_us[rng.random(len(elapsed_us)) >= LOSS]
    true_us = crystal.true_us(elapsed_us)
    asked_us = np.cumsum(rng.uniform(*ASKED_EVERY_US, int(seconds / 0.2)))
    asked_us = asked_us[asked_us < true_us[-1]]
    received_us = asked_us + LATENCY_US + rng.exponential(JITTER_US, len(asked_us))
    all_true_us = np.concatenate([true_us, received_us])
    stamps_us = np.concatenate([elapsed_us, np.interp(received_us, true_us, elapsed_us)])
    return _Sent(
        all_true_us,
        stamps_us + crystal.start_us,
        np.concatenate([np.full(len(true_us), np.nan), asked_us]),
        all_true_us + LATENCY_US + rng.exponential(JITTER_US, len(all_true_us)),
    )
