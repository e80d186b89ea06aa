"""What is to happen to one device, in order of time. Sans-I/O."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field

FROM_OUTSIDE = 0
"""In the place of a boot: happens whatever became of the firmware since."""


@dataclass(order=True, frozen=True, slots=True)
class Happening:
    """Something to be done at a true time; at one moment, in the order in which it was foreseen."""

    at_s: float
    order: int
    act: Callable[[], None] = field(compare=False)
    boot: int = field(compare=False)
    """Which run of the firmware means to do it; void when the device has started again since."""


class Timeline:
    """Happenings, taken in order."""

    def __init__(self) -> None:
        self._waiting: list[Happening] = []
        self._order = 0

    def add(self, at_s: float, act: Callable[[], None], boot: int = FROM_OUTSIDE) -> None:
        """Add something that is to happen."""
        heapq.heappush(self._waiting, Happening(at_s, self._order, act, boot))
        self._order += 1

    def next_before(self, to_s: float) -> Happening | None:
        """Take the next one that lies before a true time, s."""
        if not self._waiting or self._waiting[0].at_s >= to_s:
            return None
        return heapq.heappop(self._waiting)
