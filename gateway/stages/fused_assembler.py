"""Orientations fused on board to ``ImuFrame``s: all modules at the instants of the reference module.

Distributed compensation as published (mode 1's streaming interpolation): no grid of the gateway's own,
but one frame for every datum of the reference. Module ``m``'s ``x``-th datum, converted to the
reference's time, is ``(t_{m,x}, D_{m,x})``. For the reference's ``i``-th datum, find ``x`` with
``t_{m,x−1} ≤ t_{1,i} ≤ t_{m,x}`` and interpolate between ``D_{m,x−1}`` and ``D_{m,x}``: linearly for
vectors, spherically for orientations. How long a frame waits is judged by the arrival times of what
comes, as in ``frame_assembler``.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.frames import FloatArray, FusedReading, ImuFrame, Status
from gateway.geometry.quaternion import slerp
from gateway.stages.frame_assembler import AssemblyParams, Lost


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


_AT_REST = (1.0, 0.0, 0.0, 0.0)


class FusedAssembler:
    """Gathers orientations; gives frames. One call of ``add`` a reading.

    While the reference is silent for longer than ``hold_ns``, another module takes its place: one that has
    spoken since. After a pause of all of them the reference is about to go on.
    """

    def __init__(self, module_ids: tuple[int, ...], params: AssemblyParams, reference: int) -> None:
        """Assemble at the instants of ``reference``; the slowest module by the clock table is the best
        choice.
        """
        self.lost: Counter[Lost] = Counter()
        self.late: Counter[int] = Counter()
        """Readings no later than one before, by module id; those of ``lost`` one by one."""
        self.taken = 0
        """Readings that a frame can be made from."""
        self.reference = reference
        self._module_ids = module_ids
        self._params = params
        self._newest: dict[int, Datum] = {}
        self._shown: dict[int, Datum] = {}  # what each module last gave to a frame
        self._start_ns: int | None = None
        self._sequence = 0
        self._last_us = -np.inf
        self._gather = self._begin()
        slerp(np.array(_AT_REST), np.array(_AT_REST), 0.5)  # compile now, not when the first reading waits

    @property
    def frames(self) -> int:
        """Frames given out."""
        return self._sequence

    def add(self, reading: FusedReading, arrived_ns: int) -> list[ImuFrame]:
        """Take a reading; the frames that it, or the time it arrived, completes."""
        module, params = reading.module, self._params
        if module not in self._module_ids:
            self.lost[Lost.UNKNOWN_MODULE] += 1
            return []
        if self._start_ns is None:
            self._start_ns = reading.time_ns
        datum = Datum(
            (reading.time_ns - self._start_ns) * 1e-3, None, np.array(reading.orientation), reading.sequence
        )
        newest = self._newest.get(module)
        if newest is not None and datum.time_us <= newest.time_us:
            self.lost[Lost.LATE] += 1
            self.late[module] += 1
            return []
        self.taken += 1
        # The reference's instants are the frames': without it another module takes its place.
        if newest is not None and self._is_reference_silent(newest.time_us):
            self.reference = module
            self._gather = self._begin()
        self._newest[module] = datum
        due_us = (arrived_ns - params.max_wait_ns - self._start_ns) * 1e-3
        sets = self._gather.add(module, datum, due_us)
        return [self._frame(found) for found in sets if found[self.reference].time_us > self._last_us]

    def _begin(self) -> ReferenceInstants:
        """Gather for the reference, beginning with what every other module sent last."""
        params = self._params
        gather = ReferenceInstants(
            self.reference,
            self._module_ids,
            silent_us=params.hold_ns * 1e-3,
            max_gap_us=params.max_gap_ns * 1e-3,
        )
        for module, datum in self._newest.items():
            if module != self.reference:
                gather.add(module, datum)
        return gather

    def _is_reference_silent(self, now_us: float) -> bool:
        """Return whether it has said nothing for so long, at an instant when another module spoke."""
        newest = self._newest.get(self.reference)
        if newest is None:
            return now_us * 1e3 > self._params.start_wait_ns
        return (now_us - newest.time_us) * 1e3 > self._params.hold_ns

    def _frame(self, found: dict[int, Datum]) -> ImuFrame:
        assert self._start_ns is not None
        instant_us, n = found[self.reference].time_us, len(self._module_ids)
        orientation = np.full((n, 4), np.nan)
        status, gap_ns = np.full(n, Status.MISSING, np.uint8), np.zeros(n, np.int64)
        for row, module in enumerate(self._module_ids):
            datum = found.get(module)
            if datum is not None:
                self._shown[module] = datum
                status[row] = Status.INTERPOLATED if datum.lost else Status.MEASURED
                gap_ns[row] = round(datum.span_us * 1e3)
            elif (datum := self._shown.get(module)) is not None:
                gap_ns[row] = round((instant_us - datum.time_us) * 1e3)
                status[row] = Status.HELD if gap_ns[row] <= self._params.hold_ns else Status.MISSING
            if datum is not None and status[row] != Status.MISSING:
                orientation[row] = datum.orientation
        self._last_us = instant_us
        sequence, self._sequence = self._sequence, self._sequence + 1
        nothing = np.full((n, 3), np.nan)
        time_ns = self._start_ns + round(instant_us * 1e3)
        return ImuFrame(sequence, time_ns, nothing, nothing, nothing, status, gap_ns, orientation=orientation)
