"""Mode 1's streaming interpolation: the data of all modules at the instants of the reference module's.

Module ``m``'s ``x``-th datum, converted to the reference's time, is ``(t_{m,x}, D_{m,x})``. For the
reference's ``i``-th datum, find ``x`` with ``t_{m,x−1} ≤ t_{1,i} ≤ t_{m,x}`` and interpolate between
``D_{m,x−1}`` and ``D_{m,x}``: linearly for vectors, spherically for orientations.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from gateway.frames import FloatArray
from gateway.geometry.quaternion import slerp


@dataclass(frozen=True)
class Datum:
    """What one module sent for one instant."""

    time_us: float
    """In the reference's time."""
    vector: FloatArray | None = None
    """Any length: interpolated linearly."""
    orientation: FloatArray | None = None
    """(4,) unit quaternion: interpolated spherically, the short way round."""
    sequence: int = 0
    """The module's count of its data."""
    span_us: float = 0.0
    """Time between the two data that this one was interpolated from; 0: it is as it came."""
    lost: int = 0
    """Data that were lost between those two."""


def interpolate(before: Datum, after: Datum, time_us: float) -> Datum:
    """Return the datum at a time between two."""
    span_us = after.time_us - before.time_us
    fraction = (time_us - before.time_us) / span_us if span_us > 0 else 0.0
    vector = orientation = None
    if before.vector is not None and after.vector is not None:
        vector = (1.0 - fraction) * before.vector + fraction * after.vector
    if before.orientation is not None and after.orientation is not None:
        orientation = slerp(before.orientation, after.orientation, fraction)
    lost = max(after.sequence - before.sequence - 1, 0)
    return Datum(time_us, vector, orientation, before.sequence, span_us, lost)


class ReferenceInstants:
    """Gathers data; gives a set of all modules for every datum of the reference, in order.

    A set is complete when every module has a datum at or after the instant. At most ``depth`` instants
    wait, and none that is due: a module that keeps one waiting for longer is absent from its set.
    """

    def __init__(
        self,
        reference: int,
        modules: Sequence[int],
        depth: int = 32,
        silent_us: float = math.inf,
        max_gap_us: float = math.inf,
    ) -> None:
        """Begin without data.

        depth: instants of the reference module that are kept waiting at most.
        silent_us: a module of which nothing has come for so long is not waited for, µs.
        max_gap_us: longest time without a datum, when some were lost, that is bridged, µs.
        """
        self._silent_us = silent_us
        self._max_gap_us = max_gap_us
        self._first_us: float | None = None
        self.incomplete = 0
        """Sets that were handed on without some module."""
        self._reference = reference
        self._others = tuple(module for module in modules if module != reference)
        self._depth = depth
        self._instants: deque[Datum] = deque()
        self._data: dict[int, deque[Datum]] = {module: deque(maxlen=4 * depth) for module in self._others}

    def add(self, module: int, datum: Datum, due_us: float = -math.inf) -> list[dict[int, Datum]]:
        """Take a datum (of each module in order of time); the sets that are now complete, by module.

        due_us: sets for instants up to this time are handed on however incomplete.
        """
        if self._first_us is None:
            self._first_us = datum.time_us
        if module == self._reference:
            self._instants.append(datum)
        # Data of modules that are not of the rig are ignored here.
        elif module in self._data:
            self._data[module].append(datum)
        sets = []
        # Whatever comes first: too late to wait, too many waiting, or complete.
        while self._instants and (
            self._instants[0].time_us <= due_us
            or len(self._instants) > self._depth
            or self._is_complete(self._instants[0].time_us)
        ):
            sets.append(self._take(self._instants.popleft()))
        return sets

    def _is_complete(self, instant_us: float) -> bool:
        for data in self._data.values():
            newest_us = data[-1].time_us if data else self._first_us
            assert newest_us is not None
            has_come = bool(data) and newest_us >= instant_us
            if not has_come and instant_us - newest_us <= self._silent_us:
                return False
        return True

    def _take(self, instant: Datum) -> dict[int, Datum]:
        result = {self._reference: instant}
        for module, data in self._data.items():
            # What is left begins with the last one before the instant, or at it.
            while len(data) > 1 and data[1].time_us <= instant.time_us:
                data.popleft()
            if len(data) > 1 and data[0].time_us <= instant.time_us:
                found = interpolate(data[0], data[1], instant.time_us)
                if not found.lost or found.span_us <= self._max_gap_us:
                    result[module] = found
            elif data and data[0].time_us == instant.time_us:
                result[module] = data[0]
        self.incomplete += len(result) <= len(self._others)
        return result
