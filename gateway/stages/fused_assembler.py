"""Orientations fused on board to ``ImuFrame``s: all modules at the instants of the reference module.

Distributed compensation as published: no grid of the gateway's own, but one frame for every datum of the
reference. How long a frame waits is judged by the arrival times of what comes, as in ``assembly``.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from gateway.clocks import Datum, ReferenceInstants
from gateway.frames import FusedReading, ImuFrame, Status
from gateway.geometry.quaternion import slerp
from gateway.stages.frame_assembler import AssemblyParams, Lost

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
