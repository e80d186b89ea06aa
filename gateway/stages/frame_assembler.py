"""Samples of many modules, each at its own instants, to ``ImuFrame``s: all modules at one instant.

Frames lie on a regular grid of gateway time that begins when every module has been heard (or after
``start_wait_ns``). A frame is emitted as soon as every live module has a reading at or after its
instant, and at the latest ``max_wait_ns`` after it; where everything comes later than that, in a burst after
a stall, once the rest of the burst must have come. Values between two readings are interpolated
linearly, each sensor by itself, since a magnetometer often runs slower than its neighbours.

Nothing here looks at a clock: waiting is judged by the arrival times of what comes, so that a
replay of the same chunks gives the same frames, bit for bit.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum
from operator import attrgetter
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gateway.frames import INERTIAL_SAMPLE, ImuFrame, LightReading, LocalReading
from gateway.geometry.compiled import for_types_of
from gateway.stages.frame_grid import GRID, MODULE, PASSED, new_block, new_rings, take

_BLOCK = 64
"""Frames that room is made for at once."""
_PASSED_AT_FIRST = 64
MOST_WAITING = 1024
"""Readings of local devices, and of photoelectric cells, kept for the next frame while none is completed."""
_Dated = TypeVar("_Dated", LocalReading, LightReading)


class Lost(Enum):
    """Why a reading, or an instant, never reached a frame."""

    LATE = "reading older than the last frame"
    DUPLICATE = "second reading for the same time"
    UNKNOWN_MODULE = "module that the rig does not name"
    NO_FRAME = "local or light reading that gave way to newer ones, since no frame came for it"
    SKIPPED_INSTANT = "instants without any data, left out"


_COUNTED = (Lost.LATE, Lost.DUPLICATE, Lost.UNKNOWN_MODULE, Lost.SKIPPED_INSTANT)
"""What the kernel counts, each in the field of ``GRID`` of its name."""


@dataclass(frozen=True)
class AssemblyParams:
    """How frames are put together."""

    frame_interval_ns: float
    max_wait_ns: int
    """Latency budget: how long after its instant a frame waits for a reading that is on its way."""
    max_gap_ns: int
    """Longest gap between two readings that is bridged by interpolation."""
    hold_ns: int
    """How long the last reading stands in for missing ones; after that a module is not waited for."""
    start_wait_ns: int = 1_000_000_000
    """How long the first frame waits for modules that have not been heard yet."""


class FrameAssembler:
    """Gathers readings; gives frames. One call of ``add`` a batch."""

    def __init__(self, module_ids: tuple[int, ...], params: AssemblyParams) -> None:
        n = len(module_ids)
        self.lost: Counter[Lost] = Counter()
        self.late: Counter[int] = Counter()
        """Readings that came after their frame, by module id; those of ``lost`` one by one."""
        self.taken = 0
        """Readings that a frame can be made from."""
        self._module_ids = module_ids
        self._grid, self._modules, self._rings = _new_grid(params), _new_modules(module_ids), new_rings(n)
        self._passed = np.zeros(_PASSED_AT_FIRST, PASSED)
        self._block, self._used = new_block(_BLOCK, n), 0
        """Frames are views of it; when it is full another takes its place."""
        self._sequence = 0
        self._local: deque[LocalReading] = deque()
        self._light: deque[LightReading] = deque()
        state = self._grid, self._modules, self._rings, self._passed
        self._take = for_types_of(take, *state, np.zeros(0, INERTIAL_SAMPLE), 0, 0, 0, *self._block)

    @property
    def frames(self) -> int:
        """Frames given out."""
        return self._sequence

    @property
    def instants(self) -> int:
        """Grid points passed, with a frame or without."""
        return int(self._grid["count"][0])

    def add_local(self, reading: LocalReading) -> None:
        """Keep a local measurement for the frame that comes next at or after its time."""
        self._keep_waiting(self._local, reading)

    def add_light(self, reading: LightReading) -> None:
        """Likewise a reading of a module's photoelectric cells."""
        if reading.module not in self._module_ids:
            self.lost[Lost.UNKNOWN_MODULE] += 1
            return
        self._keep_waiting(self._light, reading)

    def _keep_waiting(self, waiting: deque[_Dated], reading: _Dated) -> None:
        """Keep a reading for the next frame; of too many the oldest gives way."""
        self.taken += 1
        waiting.append(reading)
        if len(waiting) > MOST_WAITING:
            waiting.popleft()
            self.taken -= 1
            self.lost[Lost.NO_FRAME] += 1

    def add(self, samples: NDArray[np.void], arrived_ns: int) -> list[ImuFrame]:
        """Take samples (n,) ``INERTIAL_SAMPLE``; return the frames that they, or the time they arrived,
        complete."""
        if not samples.flags.carray:
            samples = samples.copy()  # or the kernel is compiled once more
        frames: list[ImuFrame] = []
        index = 0
        while True:
            begin = self._used
            index, self._used, taken, lost = self._take(
                self._grid, self._modules, self._rings, self._passed, samples, index, arrived_ns, begin,
                *self._block,
            )  # fmt: skip
            self.taken += taken
            if lost:
                self._count_lost()
            if self._used > begin:
                frames += self._frames(begin)
            if index == len(samples):
                return frames
            self._make_room()

    def _make_room(self) -> None:
        """Allocate what was full: another block of frames, or a longer queue of arrivals."""
        if self._used == _BLOCK:
            self._block, self._used = new_block(_BLOCK, len(self._module_ids)), 0
        if self._grid["n_passed"][0] == len(self._passed):
            in_order = np.roll(self._passed, -int(self._grid["passed_begin"][0]))
            self._passed = np.concatenate((in_order, np.zeros_like(in_order)))
            self._grid["passed_begin"] = 0

    def _count_lost(self) -> None:
        """Add to the counters what the kernel has counted since the last time."""
        for reason in _COUNTED:
            count = int(self._grid[reason.name.lower()][0])
            if count:
                self.lost[reason] += count
                self._grid[reason.name.lower()] = 0
        for row in np.flatnonzero(self._modules["late"]):
            self.late[self._module_ids[row]] += int(self._modules["late"][row])
        self._modules["late"] = 0

    def _frames(self, begin: int) -> list[ImuFrame]:
        """Return the frames of the block from one on."""
        block, frames = self._block, []
        for k in range(begin, self._used):
            time_ns, is_clipped = block.instants.item(k)
            frames.append(
                ImuFrame(
                    self._sequence,
                    time_ns,
                    block.specific_force[k],
                    block.angular_rate[k],
                    block.magnetic_field[k],
                    block.status[k],
                    block.gap_ns[k],
                    local=_take_due(self._local, time_ns) if self._local else (),
                    light=_take_due(self._light, time_ns) if self._light else (),
                    clipped=block.clipped[k] if is_clipped else None,
                )
            )
            self._sequence += 1
        return frames


def _new_grid(params: AssemblyParams) -> NDArray[np.void]:
    """Return the (1,) ``GRID`` of an assembler that has taken nothing."""
    grid = np.zeros(1, GRID)
    for name in ("max_wait_ns", "max_gap_ns", "hold_ns", "start_wait_ns"):
        grid[name] = getattr(params, name)
    grid["interval_ns"] = params.frame_interval_ns
    grid["newest_ns"] = grid["instant_ns"] = grid["last_instant_ns"] = -1
    return grid


def _new_modules(module_ids: tuple[int, ...]) -> NDArray[np.void]:
    """Return the (n,) ``MODULE`` of modules that nothing has been heard of."""
    modules = np.zeros(len(module_ids), MODULE)
    modules["id"], modules["newest_ns"] = module_ids, -1
    return modules


def _take_due(waiting: deque[_Dated], instant_ns: int) -> tuple[_Dated, ...]:
    """Take out those up to an instant, in time order."""
    if len(waiting) == 1:
        return (waiting.pop(),) if waiting[0].time_ns <= instant_ns else ()
    due = sorted((r for r in waiting if r.time_ns <= instant_ns), key=attrgetter("time_ns"))
    later = [reading for reading in waiting if reading.time_ns > instant_ns]
    waiting.clear()
    waiting.extend(later)
    return tuple(due)
