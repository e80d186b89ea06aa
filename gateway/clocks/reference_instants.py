"""Mode 1's streaming interpolation: the data of all modules at the instants of the reference module's.

Module ``m``'s ``x``-th datum, converted to the reference's time, is ``(t_{m,x}, D_{m,x})``. For the
reference's ``i``-th datum, find ``x`` with ``t_{m,x−1} ≤ t_{1,i} ≤ t_{m,x}`` and interpolate between
``D_{m,x−1}`` and ``D_{m,x}``: linearly for vectors, spherically for orientations.
"""

from __future__ import annotations

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


def interpolate(before: Datum, after: Datum, time_us: float) -> Datum:
    """The datum at a time between two."""
    span_us = after.time_us - before.time_us
    fraction = (time_us - before.time_us) / span_us if span_us > 0 else 0.0
    vector = orientation = None
    if before.vector is not None and after.vector is not None:
        vector = (1.0 - fraction) * before.vector + fraction * after.vector
    if before.orientation is not None and after.orientation is not None:
        orientation = slerp(before.orientation, after.orientation, fraction)
    return Datum(time_us, vector, orientation)


class ReferenceInstants:
    """Gathers data; gives a set of all modules for every datum of the reference, in order.

    A set is complete when every module has a datum at or after the instant. At most ``depth`` instants
    wait: a module that keeps the oldest waiting for longer is absent from its set.
    """

    def __init__(self, reference: int, modules: Sequence[int], depth: int = 32) -> None:
        self.incomplete = 0
        """Sets that were handed on without some module."""
        self._reference = reference
        self._others = tuple(module for module in modules if module != reference)
        self._depth = depth
        self._instants: deque[Datum] = deque()
        self._data: dict[int, deque[Datum]] = {module: deque(maxlen=4 * depth) for module in self._others}

    def add(self, module: int, datum: Datum) -> list[dict[int, Datum]]:
        """Take a datum (of each module in order of time); the sets that are now complete, by module."""
        if module == self._reference:
            self._instants.append(datum)
        elif module in self._data:
            self._data[module].append(datum)
        sets = []
        while self._instants and (self._is_complete() or len(self._instants) > self._depth):
            sets.append(self._take(self._instants.popleft()))
        return sets

    def _is_complete(self) -> bool:
        instant_us = self._instants[0].time_us
        return all(data and data[-1].time_us >= instant_us for data in self._data.values())

    def _take(self, instant: Datum) -> dict[int, Datum]:
        result = {self._reference: instant}
        for module, data in self._data.items():
            while len(data) > 1 and data[1].time_us <= instant.time_us:
                data.popleft()
            if len(data) > 1 and data[0].time_us <= instant.time_us:
                result[module] = interpolate(data[0], data[1], instant.time_us)
            elif data and data[0].time_us == instant.time_us:
                result[module] = data[0]
        self.incomplete += len(result) <= len(self._others)
        return result
