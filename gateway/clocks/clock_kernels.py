"""The usual packet of a module's clock, in compiled code: what ``Counter32``, ``EstimatedClock`` and
``SharedClock`` do where nothing begins anew, nothing is late and no block ends.

All work on the same rows (``CLOCK``). What is not usual is left to the classes, with the row untouched.
"""

from __future__ import annotations

from typing import Any

from gateway.clocks.counter import COUNTER_BITS, EARLY_US, LATE_US, OVERTAKEN_US
from gateway.clocks.module_clock import ESTIMATED, MICROSECOND_NS, MOST_PACKETS, SHARED
from gateway.geometry.compiled import compiled

Clock = Any
"""A ``CLOCK``, whose fields are attributes in compiled code."""

UNUSUAL = -(2**63)
"""Instead of a full count or an instant."""
_HALF_US, _MASK = 1 << (COUNTER_BITS - 1), (1 << COUNTER_BITS) - 1


@compiled
def full_count(clock: Clock, stamp_us: int, arrived_ns: int) -> int:
    """Return the full count of a stamp, µs, or ``UNUSUAL``; nothing is changed.

    stamp_us: 32 bits of its count; arrived_ns: gateway time, ns.
    """
    # Whatever is unusual is left to Python, which has the same rules and the rarer cases.
    counter = clock.counter
    if counter.is_running == 0 or counter.is_late != 0:
        return UNUSUAL
    if clock.kind == ESTIMATED:
        expected_us = clock.expected_us + (arrived_ns - clock.start_ns) // MICROSECOND_NS
    elif clock.kind == SHARED:
        expected_us = counter.newest_us + (arrived_ns - clock.received_ns) // MICROSECOND_NS
    else:
        return UNUSUAL
    # The counter has 32 bits: the nearest full count to the expected one is meant.
    ahead_us = ((stamp_us - expected_us + _HALF_US) & _MASK) - _HALF_US
    full_us: int = expected_us + ahead_us
    if ahead_us > EARLY_US or ahead_us < -LATE_US or full_us < counter.newest_us - OVERTAKEN_US:
        return UNUSUAL
    ends_block = full_us - clock.start_us >= clock.block_end_us or clock.packets >= MOST_PACKETS
    return UNUSUAL if clock.kind == ESTIMATED and ends_block else full_us


@compiled
def follow_clock(clock: Clock, full_us: int, arrived_ns: int) -> int:
    """Take in a full count that is not ``UNUSUAL``, µs; return its gateway time, ns.

    arrived_ns: gateway time, ns.
    """
    counter = clock.counter
    if clock.kind == SHARED:
        if full_us > counter.newest_us:
            counter.newest_us, clock.received_ns = full_us, arrived_ns
        return int(full_us * MICROSECOND_NS + clock.start_ns)
    counter.newest_us = max(counter.newest_us, full_us)
    elapsed_us = full_us - clock.start_us
    clock.elapsed_us[clock.packets] = elapsed_us
    clock.delays_us[clock.packets] = (arrived_ns - clock.start_ns) * 1e-3 - elapsed_us
    clock.packets += 1
    since_fit_us = elapsed_us - clock.fit_us
    offset_us = clock.offset_us + clock.rate * since_fit_us
    if clock.correction_us != 0.0 and since_fit_us < clock.fade_us:
        offset_us += clock.correction_us * (1.0 - since_fit_us / clock.fade_us)
    time_ns: int = clock.start_ns + elapsed_us * MICROSECOND_NS + int(offset_us * 1000.0)
    if time_ns <= arrived_ns:
        return time_ns
    # Nothing arrives before it was sent; yet later stamps get later instants.
    if elapsed_us <= clock.clamped_us:
        return arrived_ns
    clock.clamped_us, clock.clamped_ns = elapsed_us, max(arrived_ns, clock.clamped_ns + 1)
    return int(clock.clamped_ns)


@compiled
def follow_usual(clocks: Clock, stamp_us: int, arrived_ns: int) -> int:
    """Return the gateway time of a stamp, ns, or ``UNUSUAL``; then nothing is changed. clocks: (1,) CLOCK."""
    full_us = full_count(clocks[0], stamp_us, arrived_ns)
    return UNUSUAL if full_us == UNUSUAL else follow_clock(clocks[0], full_us, arrived_ns)
