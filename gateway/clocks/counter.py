"""A module's 32-bit microsecond counter: unwrapped, and found out when it starts anew."""

from __future__ import annotations

import numpy as np

from gateway.support.rows import Memory, Row, fields_of

COUNTER_BITS = 32
_PERIOD_US = 1 << COUNTER_BITS
_HALF_US = _PERIOD_US >> 1
OVERTAKEN_US = 2_000_000
"""A counter that has gone back by more than a packet can be overtaken by has started anew."""
EARLY_US = 2_000_000
"""So has one that is ahead of its own arrival by more than any error of the estimate."""
LATE_US = 2_000_000
PATIENCE_NS = 10_000_000_000
"""Packets of a stalled link come late, but soon catch up. A counter that goes on being late by more than
``LATE_US`` for so long has started anew, a little above where it was."""
STEADY_PATIENCE_NS = 300_000_000
"""So has one that for so long catches up with nothing: a backlog comes faster than it was made."""
_CATCHING_UP = 0.1


def unwrap(count: int, bits: int, near: int) -> int:
    """Return the full count nearest ``near`` whose low ``bits`` bits are ``count``."""
    period = 1 << bits
    return near + (count - near + period // 2) % period - period // 2


COUNTER32 = np.dtype(
    [
        ("restarts", np.int64),
        ("is_running", np.int64),  # whether it has been heard since the start
        ("newest_us", np.int64),  # largest full time since then
        ("is_late", np.int64),
        ("late_since_ns", np.int64),
        ("late_by_us", np.int64),  # when it began to be late
    ]
)
"""State of a ``Counter32``."""


class Counter32(Row):
    """Full time from 32 bits, by where the counter should be when a packet arrives.

    Transport only delays: a stamp may be behind what is expected at its arrival, never ahead of it.
    """

    layout = COUNTER32
    _fields_ = fields_of(COUNTER32, "restarts")
    restarts: int
    _is_running: int
    _newest_us: int
    _is_late: int
    _late_since_ns: int
    _late_by_us: int

    def __init__(self, *, memory: Memory | None = None) -> None:
        """Begin without a stamp; ``memory`` is a zeroed ``COUNTER32`` if compiled code shares the state."""

    @property
    def newest_us(self) -> int | None:
        """Largest full time since the last start; None before the first."""
        return self._newest_us if self._is_running else None

    def forget(self) -> None:
        """Take the next stamp, whatever it is, as a start."""
        self._is_running = False

    def full_us(self, stamp_us: int, expected_us: int, arrived_ns: int) -> int | None:
        """Return the full count, or None when the counter has (re)started: then it stands at ``stamp_us``."""
        if not self._is_running:
            self._is_running, self._newest_us = True, stamp_us
            return None
        newest_us = self._newest_us
        # Of all counts with these lower 32 bits the one nearest to what is expected.
        ahead_us = (stamp_us - expected_us + _HALF_US) % _PERIOD_US - _HALF_US
        full_us = expected_us + ahead_us
        if full_us > newest_us and -LATE_US <= ahead_us <= EARLY_US and not self._is_late:
            self._newest_us = full_us
            return full_us
        if self._is_anew(full_us, ahead_us, arrived_ns):
            self.restarts += 1
            self._newest_us, self._is_late = stamp_us, False
            return None
        self._newest_us = max(newest_us, full_us)
        return full_us

    def _is_anew(self, full_us: int, ahead_us: int, arrived_ns: int) -> bool:
        if ahead_us > EARLY_US or full_us < self._newest_us - OVERTAKEN_US:
            return True
        if ahead_us >= -LATE_US:
            self._is_late = False
            return False
        if not self._is_late:
            self._is_late, self._late_since_ns, self._late_by_us = True, arrived_ns, -ahead_us
        waited_ns = arrived_ns - self._late_since_ns
        caught_up_ns = (self._late_by_us + ahead_us) * 1000
        is_steady = caught_up_ns < _CATCHING_UP * waited_ns
        return waited_ns > (STEADY_PATIENCE_NS if is_steady else PATIENCE_NS)
