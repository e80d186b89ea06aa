"""How soon a module's instants are right again after what goes wrong, and how wrong they are until then."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.figures import Figure, table
from gateway.clocks import EstimatedClock, LinkBatching
from gateway.emulation.clock_simulation import JITTER_US, LATENCY_US
from gateway.frames import FloatArray, IntArray

SEEDS = 10
RATE_HZ = 100.0
SKEW_PPM = 40.0
RIGHT_US = 300.0
FAULT_S, END_S = 60.0, 90.0
FRAME_AGE_US = 1e6
"""Instants older than this reach no frame: its time has long gone by (a gateway waits for tens of ms)."""


class Packets(NamedTuple):
    """One module's packets in order of arrival."""

    stamps_us: IntArray  # 32-bit
    arrived_ns: IntArray
    true_us: FloatArray


class Outcome(NamedTuple):
    """What a fault led to."""

    recovery_s: float
    """From the first packet after it until instants stay within ``RIGHT_US``."""
    worst_us: float
    """Largest error of an instant that can reach a frame."""


def packets(
    from_s: float, to_s: float, start_us: int, rng: np.random.Generator, slot_us: float = 0.0
) -> Packets:
    """A module that counts from ``start_us`` at ``from_s``."""
    own_us = np.arange((to_s - from_s) * RATE_HZ) * 1e6 / RATE_HZ
    true_us = from_s * 1e6 + own_us / (1 + SKEW_PPM * 1e-6)
    arrived_us = np.maximum.accumulate(true_us + LATENCY_US + rng.exponential(JITTER_US, len(true_us)))
    if slot_us:
        arrived_us = np.ceil(arrived_us / slot_us) * slot_us
    stamps = (np.round(own_us).astype(np.int64) + start_us) % 2**32
    return Packets(stamps, np.round(arrived_us * 1e3).astype(np.int64), true_us)


def joined(before: Packets, after: Packets) -> Packets:
    return Packets(*(np.concatenate(pair) for pair in zip(before, after, strict=True)))


def start(rng: np.random.Generator) -> Packets:
    """A module that is switched on."""
    return packets(FAULT_S, END_S, int(rng.integers(2**31)), rng)


def start_in_slots(rng: np.random.Generator) -> Packets:
    """The same over a link that hands over every 16 ms."""
    return packets(FAULT_S, END_S, int(rng.integers(2**31)), rng, 16_000.0)


def reset(rng: np.random.Generator) -> Packets:
    """A module that starts again, its counter at 0."""
    return joined(packets(0, FAULT_S, 2**30, rng), packets(FAULT_S + 0.5, END_S, 0, rng))


def reset_near(rng: np.random.Generator) -> Packets:
    """A module that is off for 8 s; its counter comes back 0.1 s above its last."""
    last_us = round(FAULT_S * 1e6)
    return joined(packets(0, FAULT_S, 0, rng), packets(FAULT_S + 8, END_S + 8, last_us + 100_000, rng))


def wrap(rng: np.random.Generator) -> Packets:
    """The 32-bit counter wraps."""
    return packets(0, END_S, 2**32 - round(FAULT_S * 1e6), rng)


def gap(rng: np.random.Generator) -> Packets:
    """Nothing comes for 5 s."""
    whole = packets(0, END_S, 7, rng)
    kept = (whole.true_us < FAULT_S * 1e6) | (whole.true_us > (FAULT_S + 5) * 1e6)
    return Packets(*(column[kept] for column in whole))


def stall(rng: np.random.Generator) -> Packets:
    """The link keeps everything back for 4 s, then hands it over at once."""
    whole = packets(0, END_S, 7, rng)
    held = (whole.true_us > FAULT_S * 1e6) & (whole.true_us < (FAULT_S + 4) * 1e6)
    arrived = np.where(held, round((FAULT_S + 4.001) * 1e9), whole.arrived_ns)
    return whole._replace(arrived_ns=np.maximum.accumulate(arrived))


FAULTS: dict[str, tuple[str, Callable[[np.random.Generator], Packets]]] = {
    "start": ("start", start),
    "start_16ms": ("start, 16 ms batching", start_in_slots),
    "reset": ("reset, counter at 0", reset),
    "reset_near": ("reset, counter 0.1 s above its last after 8 s", reset_near),
    "wrap": ("wrap of the counter", wrap),
    "gap": ("gap of 5 s", gap),
    "stall": ("link stalls for 4 s, then catches up", stall),
}


def outcome(sent: Packets) -> Outcome:
    """Of one module's packets through the estimate."""
    batching = LinkBatching()
    clock = EstimatedClock(batching)
    instants = []
    for stamp, at in zip(sent.stamps_us.tolist(), sent.arrived_ns.tolist(), strict=True):
        batching.observe(at)
        instants.append(clock.gateway_time(stamp, at))
    own_us = np.array(instants) * 1e-3 - sent.true_us
    after = sent.true_us >= FAULT_S * 1e6
    error_us = np.abs(own_us - LATENCY_US)[after]
    true_us = sent.true_us[after]
    wrong = np.flatnonzero(error_us > RIGHT_US)
    recovery_s = (true_us[wrong[-1]] - true_us[0]) * 1e-6 + 1 / RATE_HZ if len(wrong) else 0.0
    reaches = error_us < FRAME_AGE_US
    return Outcome(recovery_s, float(error_us[reaches].max()))


def recoveries() -> tuple[list[Figure], str]:
    """Figures of all faults, worst of some seeds, and their table."""
    figures, rows = [], []
    for name, (title, make) in FAULTS.items():
        outcomes = [outcome(make(np.random.default_rng([seed, 9]))) for seed in range(SEEDS)]
        recovery_s = max(o.recovery_s for o in outcomes)
        worst_us = max(o.worst_us for o in outcomes)
        note = f"until instants stay within {RIGHT_US:g} µs after: {title}; worst of {SEEDS} draws"
        figures.append(
            Figure(f"recover_{name}_s", recovery_s, "s", "<=2" if "16ms" not in name else "", note)
        )
        rows.append([title, f"{recovery_s:.2f}", f"{worst_us * 1e-3:.2f}"])
    text = (
        "## Faults\n\n"
        f"One module at {RATE_HZ:g} Hz, {SKEW_PPM:g} ppm, exponential delays of mean 1 ms; worst of {SEEDS} "
        "draws. *recovery*: from the first packet after the fault until every instant is within "
        f"{RIGHT_US:g} µs. *worst*: the largest error meanwhile of an instant that can reach a frame. A host "
        "clock set by an hour moves nothing: gateway time is monotonic, and a test holds the poses to it.\n\n"
    )
    return figures, text + table(["fault", "recovery s", "worst ms"], rows)
