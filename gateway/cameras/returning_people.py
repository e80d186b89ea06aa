"""Whether somebody who comes is one of those who have just left, or were lost behind something.

Whoever stands about where somebody was lost is taken for them when half of the body's parts are as long: the
others may have been measured while they were hidden. Of whoever comes from elsewhere, most parts must be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gateway.frames import FloatArray
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.proportions import standard_lengths

_LONGEST_AWAY_NS = 5_000_000_000
"""Since somebody was last seen, for them to be known again."""
_BESIDE, _STROLL = 0.5, 0.5
"""m and m/s: how far from where they were last seen somebody stands where they were lost."""
_HALF_ALIKE = 0.06
"""Median ratio, less 1, between the lengths of those half of the parts that agree best, of two bodies that
may be one person's, half hidden."""
_STRIDE, _FASTEST = 1.0, 3.0
"""m and m/s: how far somebody may be from where they were last seen."""
_ALIKE = 0.04
"""Median ratio, less 1, between the lengths of the parts of two bodies that may be one person's."""
_APART = 2.0
"""Times by which everybody else who is away must be farther, or their lengths differ more."""


@dataclass(frozen=True, eq=False)
class Somebody:
    """A person where they were last seen."""

    person: KeypointSet
    """Of the lengths that were measured."""
    hips: FloatArray
    """(3,) m."""
    seen_ns: int

    def seconds_since(self, other: Somebody) -> float:
        """Return the time from when another was seen."""
        return 1e-9 * (self.seen_ns - other.seen_ns)

    def distance_to(self, other: Somebody) -> float:
        """Return the distance of the hips, m."""
        return float(np.linalg.norm(self.hips - other.hips))

    def is_where_lost(self, other: Somebody) -> bool:
        """Return whether this is about where another one was last seen, and in half of its parts alike."""
        is_beside = self.distance_to(other) <= _BESIDE + _STROLL * self.seconds_since(other)
        return is_beside and float(np.quantile(_unlike(self, other), 0.25)) <= _HALF_ALIKE


class ReturningPeople:
    """Those who left a moment ago, by number."""

    def __init__(self) -> None:
        self._away: dict[int, Somebody] = {}

    def add(self, number: int, somebody: Somebody) -> None:
        """Keep somebody who has left."""
        self._away[number] = somebody

    def known_again(self, newcomer: Somebody) -> tuple[int, KeypointSet] | None:
        """Return the number and the lengths of who is back, and keep them no longer; None: it is somebody
        new, or may be either of two."""
        self._away = {
            number: away
            for number, away in self._away.items()
            if 1e9 * newcomer.seconds_since(away) <= _LONGEST_AWAY_NS
        }
        number = self._where_lost(newcomer)
        if number is None:
            number = self._alike(newcomer)
        return None if number is None else (number, self._away.pop(number).person)

    def _where_lost(self, newcomer: Somebody) -> int | None:
        distances = {
            number: newcomer.distance_to(away)
            for number, away in self._away.items()
            if newcomer.is_where_lost(away)
        }
        return _surely_least(distances)

    def _alike(self, newcomer: Somebody) -> int | None:
        unlike = {
            number: float(np.median(_unlike(newcomer, away)))
            for number, away in self._away.items()
            if newcomer.distance_to(away) <= _STRIDE + _FASTEST * newcomer.seconds_since(away)
        }
        number = _surely_least(unlike)
        return number if number is not None and unlike[number] <= _ALIKE else None


def _surely_least(values: dict[int, float]) -> int | None:
    """Return whose value is the least by far; None: nobody's."""
    least, *others = [*sorted(values.values()), np.inf]
    if not values or others[0] <= _APART * least:
        return None
    return min(values, key=lambda number: values[number])


def _unlike(one: Somebody, other: Somebody) -> FloatArray:
    """Return (n,) by how much the parts of two bodies differ in length, where both are known: logarithms."""
    ratios = np.log(standard_lengths(one.person) / standard_lengths(other.person))
    known: FloatArray = np.abs(ratios[np.isfinite(ratios)])
    return known
