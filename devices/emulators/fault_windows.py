"""Which of many faults are on at an instant, without asking every one of them.

A schedule of an hour has a thousand faults of which one is on: asking all of them at every transmission took
most of the time of a simulated suit.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

from devices.emulators.fault_plan import Fault

AnyOf = TypeVar("AnyOf", bound=Fault)
_ROUNDING_S = 1e-6
"""Stretches are so much longer at both ends: ``is_on`` itself decides at the edges."""


class FaultWindows(Generic[AnyOf]):
    """Faults by time. Instants may be asked for in any order."""

    def __init__(self, faults: Iterable[AnyOf], after_s: float = 0.0) -> None:
        """Index the faults; they are ``near`` until ``after_s`` after their end."""
        every = list(faults)
        self._edges: list[float] = [-float("inf")]
        self._near: list[tuple[int, ...]] = [()]
        """By stretch between two edges: places of the faults that come once."""
        self._faults = every
        self._after_s = after_s
        self._recurring = tuple(place for place, fault in enumerate(every) if fault.every is not None)
        self._starts = sorted((fault.at, place) for place, fault in enumerate(every) if fault.every is None)
        self._walk()

    def on(self, at_s: float) -> list[AnyOf]:
        """Return those that last at a time, s, in the order in which they were given."""
        return [fault for fault in self._candidates(at_s) if fault.is_on(at_s)]

    def starting(self, from_s: float, to_s: float) -> Iterator[tuple[float, AnyOf]]:
        """Yield when a fault begins, s, and which: all within [from_s, to_s), in the order given."""
        first, end = (bisect_left(self._starts, (edge_s, -1)) for edge_s in (from_s, to_s))
        places = sorted((*(place for _, place in self._starts[first:end]), *self._recurring))
        for place in places:
            fault = self._faults[place]
            for start_s in fault.starts(from_s, to_s):
                yield start_s, fault

    def near(self, at_s: float) -> bool:
        """Return whether any is on, or ended not longer ago than ``after_s``."""
        return any(_since(fault, at_s) <= fault.lasts + self._after_s for fault in self._candidates(at_s))

    def _candidates(self, at_s: float) -> Iterable[AnyOf]:
        places = self._near[bisect_right(self._edges, at_s) - 1]
        if self._recurring:
            places = tuple(sorted((*places, *self._recurring)))
        return (self._faults[place] for place in places)

    def _walk(self) -> None:
        """List, from edge to edge, those begun and not yet over."""
        changes: list[tuple[float, int]] = []
        for place, fault in enumerate(self._faults):
            if fault.every is None:
                changes.append((fault.at - _ROUNDING_S, place))
                changes.append((fault.at + fault.lasts + self._after_s + _ROUNDING_S, place))
        begun: set[int] = set()
        for edge_s, place in sorted(changes):
            # A fault has two edges: at the first it comes in, at the second it goes out.
            begun ^= {place}
            self._edges.append(edge_s)
            self._near.append(tuple(sorted(begun)))


def _since(fault: Fault, at_s: float) -> float:
    """Since it began last, s; infinite before it did."""
    since = at_s - fault.at
    if since < 0.0:
        return float("inf")
    return since if fault.every is None else since % fault.every
