"""Mode 2, unified control: the gateway's timer says when all modules sample. Sans-I/O.

Start a timer; when a sampling time comes, broadcast a number; every module samples at once and answers
with that number (``trigger_answers``). The instant of the samples is the moment the trigger left: no module's
clock is asked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

NUMBERS = 1 << 16


class Trigger(NamedTuple):
    """What is to be broadcast now."""

    number: int
    """Counts triggers, modulo 2^16."""
    planned_ns: int
    """Sampling time that it stands for."""


@dataclass
class TimerFigures:
    """How well the timer kept time."""

    sent: int = 0
    """Broadcasts, each link's counted."""
    unsent: int = 0
    """Broadcasts that a link did not take, or not at once."""
    skipped: int = 0
    """Sampling times left out because the gateway was busy past the next one."""
    worst_jitter_us: float = 0.0
    """Longest time from the sampling time to the broadcast."""
    jitter_square_us2: float = 0.0
    """Sum of the squares of those times."""

    @property
    def jitter_rms_us(self) -> float:
        """Root mean square of the time from the sampling time to the broadcast."""
        return math.sqrt(self.jitter_square_us2 / self.sent) if self.sent else 0.0

    def summary(self) -> dict[str, object]:
        """Return counters and jitter, µs, for the health message."""
        return {
            "sent": self.sent,
            "unsent": self.unsent,
            "skipped": self.skipped,
            "jitter_rms_us": round(self.jitter_rms_us, 1),
            "worst_jitter_us": round(self.worst_jitter_us, 1),
        }


class TriggerTimer:
    """When to broadcast which number."""

    def __init__(self, interval_ns: float) -> None:
        """Trigger every ``interval_ns``. Raises ``ValueError`` for an interval that is not positive."""
        if interval_ns <= 0:
            raise ValueError(f"triggers every {interval_ns} ns: the interval must be positive")
        self.figures = TimerFigures()
        self._interval_ns = interval_ns
        self._start_ns: int | None = None
        self._times = 0  # sampling times gone by
        self._triggers = 0

    def start(self, now_ns: int) -> None:
        """Make ``now_ns`` the first sampling time."""
        self._start_ns, self._times = now_ns, 0

    @property
    def next_ns(self) -> int | None:
        """The next sampling time; None before the start. They never drift from the timer's grid."""
        return None if self._start_ns is None else self._start_ns + round(self._times * self._interval_ns)

    def due(self, now_ns: int) -> Trigger | None:
        """Take the trigger to broadcast now; None if it is not time yet. Times gone by are skipped."""
        next_ns = self.next_ns
        if next_ns is None or now_ns < next_ns:
            return None
        # Overdue triggers are skipped: a burst of them would sample nothing of use.
        behind = int((now_ns - next_ns) / self._interval_ns)
        self.figures.skipped += behind
        self._times += behind
        planned_ns, number = self.next_ns, self._triggers % NUMBERS
        assert planned_ns is not None
        self._times += 1
        self._triggers += 1
        return Trigger(number, planned_ns)

    def sent(self, trigger: Trigger, sent_ns: int) -> None:
        """Note when a trigger left over a link, for the figures of jitter."""
        figures, late_us = self.figures, (sent_ns - trigger.planned_ns) * 1e-3
        figures.sent += 1
        figures.jitter_square_us2 += late_us * late_us
        figures.worst_jitter_us = max(figures.worst_jitter_us, abs(late_us))
