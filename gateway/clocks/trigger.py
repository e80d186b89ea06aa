"""Mode 2, unified control: the gateway's timer says when all modules sample. Sans-I/O.

Start a timer; when a sampling time comes, broadcast its number; every module samples at once and answers
with that number. The instant of the samples is the moment the trigger left: no module's clock is asked.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

NUMBERS = 1 << 16


@dataclass
class TriggerFigures:
    """What became of the triggers."""

    sent: int = 0
    skipped: int = 0
    """Sampling times left out because the gateway was busy past the next one."""
    answered: Counter[int] = field(default_factory=Counter)
    """By module."""
    missed: Counter[int] = field(default_factory=Counter)
    """Triggers without an answer in time, by module."""
    unexpected: int = 0
    """Answers to no outstanding trigger (late, repeated, or of another gateway)."""
    worst_jitter_us: float = 0.0
    """Longest time from the sampling time to the broadcast."""
    jitter_square_us2: float = 0.0
    """Sum of the squares of those times."""

    @property
    def jitter_rms_us(self) -> float:
        """Root mean square of the time from the sampling time to the broadcast."""
        return math.sqrt(self.jitter_square_us2 / self.sent) if self.sent else 0.0

    def summary(self) -> dict[str, object]:
        """For the health message."""
        return {
            "sent": self.sent,
            "skipped": self.skipped,
            "unexpected": self.unexpected,
            "missed": {str(module): count for module, count in sorted(self.missed.items())},
            "jitter_rms_us": round(self.jitter_rms_us, 1),
            "worst_jitter_us": round(self.worst_jitter_us, 1),
        }


@dataclass
class _Outstanding:
    number: int
    sent_ns: int
    awaited: set[int]


class TriggerScheduler:
    """When to broadcast which number, and which sample belongs to which instant."""

    def __init__(self, module_ids: Sequence[int], interval_ns: float, patience_ns: int) -> None:
        if interval_ns <= 0 or patience_ns / interval_ns > NUMBERS / 2:
            raise ValueError(
                f"triggers every {interval_ns} ns with answers awaited for {patience_ns} ns: "
                f"the interval must be positive, and at most {NUMBERS // 2} triggers may be outstanding"
            )
        self.figures = TriggerFigures()
        self._module_ids = tuple(module_ids)
        self._interval_ns = interval_ns
        self._patience_ns = patience_ns
        self._start_ns: int | None = None
        self._count = 0
        self._outstanding: deque[_Outstanding] = deque()

    def start(self, now_ns: int) -> None:
        """The first sampling time is now."""
        self._start_ns, self._count = now_ns, 0

    @property
    def next_ns(self) -> int | None:
        """The next sampling time; None before the start. They never drift from the timer's grid."""
        return None if self._start_ns is None else self._start_ns + round(self._count * self._interval_ns)

    def due(self, now_ns: int) -> int | None:
        """The number to broadcast now; None if it is not yet time. Times gone by are not made up for."""
        next_ns = self.next_ns
        if next_ns is None or now_ns < next_ns:
            return None
        behind = int((now_ns - next_ns) / self._interval_ns)
        self.figures.skipped += behind
        self._count += behind
        return self._count % NUMBERS

    def sent(self, number: int, sent_ns: int) -> None:
        """The trigger that was due has left."""
        planned_ns = self.next_ns
        assert planned_ns is not None
        figures, late_us = self.figures, (sent_ns - planned_ns) * 1e-3
        figures.sent += 1
        figures.jitter_square_us2 += late_us * late_us
        figures.worst_jitter_us = max(figures.worst_jitter_us, abs(late_us))
        self._outstanding.append(_Outstanding(number, sent_ns, set(self._module_ids)))
        self._count += 1
        self.expire(sent_ns)

    def answered(self, module: int, number: int, arrived_ns: int) -> int | None:
        """A triggered sample came: gateway time of its instant, or None if nothing asked for it."""
        self.expire(arrived_ns)
        for trigger in reversed(self._outstanding):
            if trigger.number == number % NUMBERS and module in trigger.awaited:
                trigger.awaited.discard(module)
                self.figures.answered[module] += 1
                return trigger.sent_ns
        self.figures.unexpected += 1
        return None

    def expire(self, now_ns: int) -> None:
        """Count the answers that have not come in time."""
        while self._outstanding and now_ns - self._outstanding[0].sent_ns > self._patience_ns:
            self.figures.missed.update(self._outstanding.popleft().awaited)
