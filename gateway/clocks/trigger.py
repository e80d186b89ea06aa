"""Mode 2, unified control: the gateway's timer says when all modules sample. Sans-I/O, deterministic.

Start a timer; when a sampling time comes, broadcast a number; every module samples at once and answers
with that number. The instant of the samples is the moment the trigger left: no module's clock is asked.

A trigger leaves over every link at a moment of its own; samples that come over a link belong to the moment
of that link. Numbers have 16 bits: an answer is good only while its trigger is outstanding.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
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


_SLOW_LINK = 1024
"""So many triggers may a link lag behind another one."""


class TriggerAnswer(NamedTuple):
    """What a triggered sample belongs to."""

    full: int
    """The trigger's number, unwrapped: never the same for two triggers."""
    sent_ns: int
    """Gateway time at which it left over the link that the sample came by."""


@dataclass
class AnswerFigures:
    """What became of the triggers that left."""

    answered: Counter[int] = field(default_factory=Counter)
    """By module."""
    missed: Counter[int] = field(default_factory=Counter)
    """Triggers without an answer in time, by module."""
    repeated: int = 0
    """Answers that came more than once."""
    unexpected: int = 0
    """Answers to no outstanding trigger (too late, or of another gateway): dropped."""
    untriggered: Counter[int] = field(default_factory=Counter)
    """Samples that a module took on its own timer, by module; their instants are estimated."""

    def summary(self) -> dict[str, object]:
        """Return the counters, by module where they differ, for the health message."""
        return {
            "answered": _by_module(self.answered),
            "missed": _by_module(self.missed),
            "repeated": self.repeated,
            "unexpected": self.unexpected,
            "untriggered": _by_module(self.untriggered),
        }


@dataclass
class _Outstanding:
    full: int
    sent_ns: int
    awaited: tuple[int, ...]
    answered: set[int] = field(default_factory=set)


class TriggerAnswers:
    """Takes note of every trigger that left and of every sample that came, in order."""

    def __init__(self, module_ids: Sequence[int], patience_ns: int) -> None:
        """Begin without triggers.

        module_ids: those whose missing answers are counted, once they have been heard.
        patience_ns: how long after a trigger its answers are still accepted.
        """
        self.figures = AnswerFigures()
        self._module_ids = frozenset(module_ids)
        self._patience_ns = patience_ns
        self._newest: int | None = None
        self._outstanding: dict[str, dict[int, _Outstanding]] = {}  # by link and number, in order of sending
        self._link_of: dict[int, str] = {}
        self._on_own_timer: set[int] = set()

    def note_link(self, module: int, link: str) -> None:
        """Note that a module is reached over this link: something came from it there."""
        self._link_of[module] = link

    def sent(self, number: int, link: str, sent_ns: int) -> None:
        """Note that a trigger has left on a link, and which modules are to answer it."""
        self.expire(sent_ns)
        newest = number if self._newest is None else self._newest
        # Numbers wrap; a link slower than the others may send a trigger a little older than the newest.
        ahead = (number - newest) % NUMBERS
        full = newest + (ahead if ahead < NUMBERS - _SLOW_LINK else ahead - NUMBERS)
        self._newest = max(newest, full)
        awaited = tuple(
            module
            for module in sorted(self._module_ids - self._on_own_timer)
            if self._link_of.get(module) == link
        )
        self._outstanding.setdefault(link, {})[number] = _Outstanding(full, sent_ns, awaited)

    def answered(self, module: int, number: int, link: str, arrived_ns: int) -> TriggerAnswer | None:
        """Return the trigger that a sample answers; None if nothing asked for it.

        One that came before belongs to the same trigger as then.
        """
        self.expire(arrived_ns)
        self._on_own_timer.discard(module)
        trigger = self._outstanding.get(link, {}).get(number)
        # Nothing comes back before it left; the number is then that of another gateway's trigger.
        if trigger is None or not 0 <= arrived_ns - trigger.sent_ns <= self._patience_ns:
            self.figures.unexpected += 1
            return None
        if module in trigger.answered:
            self.figures.repeated += 1
        else:
            trigger.answered.add(module)
            self.figures.answered[module] += 1
        return TriggerAnswer(trigger.full, trigger.sent_ns)

    def sampled_alone(self, module: int) -> None:
        """Note a sample that a module took on its own timer: no answer is awaited until one comes."""
        self._on_own_timer.add(module)
        self.figures.untriggered[module] += 1

    def expire(self, now_ns: int) -> None:
        """Count the answers that have not come in time."""
        for outstanding in self._outstanding.values():
            while outstanding:
                number, oldest = next(iter(outstanding.items()))
                if now_ns - oldest.sent_ns <= self._patience_ns:
                    break
                del outstanding[number]
                self.figures.missed.update(m for m in oldest.awaited if m not in oldest.answered)


def _by_module(counts: Counter[int]) -> dict[str, int]:
    return {str(module): count for module, count in sorted(counts.items())}
