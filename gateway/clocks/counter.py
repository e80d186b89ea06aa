"""A module's 32-bit microsecond counter: unwrapped, and found out when it starts anew."""

from __future__ import annotations

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
    """The full count nearest ``near`` whose low ``bits`` bits are ``count``."""
    period = 1 << bits
    return near + (count - near + period // 2) % period - period // 2


class Counter32:
    """Full time from 32 bits, by where the counter should be when a packet arrives.

    Transport only delays: a stamp may be behind what is expected at its arrival, never ahead of it.
    """

    __slots__ = ("_late_by_us", "_late_since_ns", "newest_us", "restarts")

    def __init__(self) -> None:
        self.restarts = 0
        self.newest_us: int | None = None
        """Largest full time since the last start; None before the first."""
        self._late_since_ns: int | None = None
        self._late_by_us = 0  # when it began to be late

    def full_us(self, stamp_us: int, expected_us: int, arrived_ns: int) -> int | None:
        """The full count, or None when the counter has (re)started: then it stands at ``stamp_us``."""
        newest_us = self.newest_us
        if newest_us is None:
            self.newest_us = stamp_us
            return None
        ahead_us = (stamp_us - expected_us + _HALF_US) % _PERIOD_US - _HALF_US
        full_us = expected_us + ahead_us
        if full_us > newest_us and -LATE_US <= ahead_us <= EARLY_US and self._late_since_ns is None:
            self.newest_us = full_us
            return full_us
        if self._is_anew(full_us, ahead_us, arrived_ns):
            self.restarts += 1
            self.newest_us, self._late_since_ns = stamp_us, None
            return None
        self.newest_us = max(newest_us, full_us)
        return full_us

    def _is_anew(self, full_us: int, ahead_us: int, arrived_ns: int) -> bool:
        assert self.newest_us is not None
        if ahead_us > EARLY_US or full_us < self.newest_us - OVERTAKEN_US:
            return True
        if ahead_us >= -LATE_US:
            self._late_since_ns = None
            return False
        if self._late_since_ns is None:
            self._late_since_ns, self._late_by_us = arrived_ns, -ahead_us
        waited_ns = arrived_ns - self._late_since_ns
        caught_up_ns = (self._late_by_us + ahead_us) * 1000
        is_steady = caught_up_ns < _CATCHING_UP * waited_ns
        return waited_ns > (STEADY_PATIENCE_NS if is_steady else PATIENCE_NS)
