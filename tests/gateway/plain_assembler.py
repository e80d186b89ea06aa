"""Frame assembly one sample after another, without a compiler: what ``FrameAssembler`` is held against."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
from numpy.typing import NDArray

from gateway.frames import (
    ANGULAR_RATE,
    INERTIAL_SAMPLE,
    MAGNETIC_FIELD,
    SPECIFIC_FORCE,
    FloatArray,
    ImuFrame,
    IntArray,
    Status,
    StatusArray,
)
from gateway.stages.frame_assembler import AssemblyParams, Lost

_LONGEST_CATCH_UP_NS = 1_000_000_000
_REST_OF_BURST_NS = 5_000_000
_DEPTH = 64
_MEASURED, _INTERPOLATED = int(Status.MEASURED), int(Status.INTERPOLATED)
_HELD, _MISSING = int(Status.HELD), int(Status.MISSING)
_NEVER = np.iinfo(np.int64).min


class PlainAssembler:
    """Gathers samples; gives frames."""

    def __init__(self, module_ids: tuple[int, ...], params: AssemblyParams) -> None:
        n = len(module_ids)
        self.lost: Counter[Lost] = Counter()
        self.late: Counter[int] = Counter()
        """Readings that came after their frame, by module id; those of ``lost`` one by one."""
        self.taken = 0
        """Readings that a frame can be made from."""
        self._params = params
        self._row = {module: row for row, module in enumerate(module_ids)}
        self._ring = np.zeros((n, _DEPTH), INERTIAL_SAMPLE).view(np.recarray)
        self._ring["time_ns"], self._ring["measured"] = _NEVER, np.nan
        self._heads = np.zeros(n, dtype=np.int64)  # ring position of the newest sample
        self._newest = [-1] * n  # plain integers: compared once a reading
        self._newest_of_all = -1
        self._passed: deque[tuple[int, int]] = deque()
        """Instants up to which any module had been heard, and when that arrived; from the next frame's on.
        Older ones are dropped when that frame becomes the next: with one live module no frame ever waits."""
        self._awaited: set[int] = set()
        self._instant_ns = -1
        self._heard = 0
        self._first_arrival_ns: int | None = None
        self._grid_start_ns: int | None = None
        self._count = 0  # frames since the grid's start, skipped instants included
        self._sequence = 0
        self._last_instant_ns = -1

    @property
    def frames(self) -> int:
        """Frames given out."""
        return self._sequence

    @property
    def instants(self) -> int:
        """Grid points passed, with a frame or without."""
        return self._count

    def add(self, samples: NDArray[np.void], arrived_ns: int) -> list[ImuFrame]:
        """Take samples (n,) ``INERTIAL_SAMPLE``; return the frames that they, or the time they arrived,
        complete."""
        frames: list[ImuFrame] = []
        modules, times_ns = samples["module"].tolist(), samples["time_ns"].tolist()
        for index, (module, time_ns) in enumerate(zip(modules, times_ns, strict=True)):
            row = self._row.get(module)
            if row is None:
                self.lost[Lost.UNKNOWN_MODULE] += 1
            elif self._store(row, time_ns, samples[index]):
                self.taken += 1
                reached_ns = self._passed[-1][0] if self._passed else self._instant_ns - 1
                if self._newest_of_all > reached_ns:
                    self._passed.append((self._newest_of_all, arrived_ns))
                if self._first_arrival_ns is None:
                    self._first_arrival_ns = arrived_ns
                frames += self._emit(arrived_ns)
        return frames

    def _store(self, row: int, time_ns: int, sample: np.void) -> bool:
        newest = self._newest[row]
        if newest < 0:
            self._heard += 1
        elif time_ns <= newest:
            return self._insert_late(row, time_ns, sample)
        head = (int(self._heads[row]) + 1) % _DEPTH
        self._ring[row, head] = sample
        self._heads[row] = head
        self._newest[row] = time_ns
        self._newest_of_all = max(self._newest_of_all, time_ns)
        if time_ns >= self._instant_ns:
            self._awaited.discard(row)
        return True

    def _insert_late(self, row: int, time_ns: int, sample: np.void) -> bool:
        """A sample overtaken by newer ones on its way: still useful if its instant is yet to come."""
        ring = self._ring[row]
        order = (int(self._heads[row]) - np.arange(_DEPTH)) % _DEPTH  # newest first
        times = ring["time_ns"][order]
        if time_ns in times:
            self.lost[Lost.DUPLICATE] += 1
            return False
        newer = int(np.count_nonzero(times > time_ns))
        if time_ns <= self._last_instant_ns or newer == _DEPTH:  # there would be no place for it
            self.lost[Lost.LATE] += 1
            self.late[int(sample["module"])] += 1
            return False
        head = (int(self._heads[row]) + 1) % _DEPTH
        target = (head - np.arange(newer)) % _DEPTH
        ring[target] = ring[order[:newer]]
        ring[(head - newer) % _DEPTH] = sample
        self._heads[row] = head
        return True

    def _emit(self, arrived_ns: int) -> list[ImuFrame]:
        if self._grid_start_ns is None and not self._start(arrived_ns):
            return []
        if self._newest_of_all - self._instant_ns > self._params.hold_ns + _LONGEST_CATCH_UP_NS:
            self._skip_silence()
        frames = []
        while self._is_due(arrived_ns):
            frames.append(self._frame(self._instant_ns))
            self._last_instant_ns = self._instant_ns
            self._advance(self._count + 1)
        return frames

    def _start(self, arrived_ns: int) -> bool:
        """Begin the grid at the instant from which all modules (heard so far) have readings."""
        assert self._first_arrival_ns is not None
        all_heard = self._heard == len(self._newest)
        if not all_heard and arrived_ns - self._first_arrival_ns < self._params.start_wait_ns:
            return False
        self._grid_start_ns = self._newest_of_all
        self._advance(0)
        return True

    def _advance(self, count: int) -> None:
        """Make grid point ``count`` the next instant, and note which modules it has to wait for."""
        assert self._grid_start_ns is not None
        self._count = count
        self._instant_ns = self._grid_start_ns + round(count * self._params.frame_interval_ns)
        while self._passed and self._passed[0][0] < self._instant_ns:
            self._passed.popleft()
        live_since = self._newest_of_all - self._params.hold_ns
        self._awaited = {
            row for row, time_ns in enumerate(self._newest) if live_since <= time_ns < self._instant_ns
        }

    def _is_due(self, arrived_ns: int) -> bool:
        """Whether the next instant has all that it may wait for."""
        if self._newest_of_all < self._instant_ns:
            return False
        if not self._awaited or arrived_ns >= self._latest_ns():
            return True
        if self._newest_of_all - self._instant_ns > self._params.hold_ns:
            self._advance(self._count)  # who has been silent for so long is not waited for
        return not self._awaited

    def _latest_ns(self) -> int:
        """When the next frame waits no more. A burst that comes late as a whole is read to its end first."""
        reached_ns = self._passed[0][1]
        return max(self._instant_ns + self._params.max_wait_ns, reached_ns + _REST_OF_BURST_NS)

    def _skip_silence(self) -> None:
        """After silence of the whole suit, go on at the present instead of filling in the past."""
        assert self._grid_start_ns is not None
        count = int((self._newest_of_all - self._grid_start_ns) // self._params.frame_interval_ns)
        self.lost[Lost.SKIPPED_INSTANT] += count - self._count
        self._advance(count)

    def _frame(self, instant_ns: int) -> ImuFrame:
        values, status, gap_ns, clipped = self._interpolate(instant_ns)
        frame = ImuFrame(
            sequence=self._sequence,
            time_ns=instant_ns,
            specific_force=values[:, SPECIFIC_FORCE],
            angular_rate=values[:, ANGULAR_RATE],
            magnetic_field=values[:, MAGNETIC_FIELD],
            status=status,
            gap_ns=gap_ns,
            clipped=clipped if clipped.any() else None,
        )
        self._sequence += 1
        return frame

    def _interpolate(self, instant_ns: int) -> tuple[FloatArray, StatusArray, IntArray, StatusArray]:
        params = self._params
        return _interpolate_modules(instant_ns, self._ring, self._heads, params.max_gap_ns, params.hold_ns)


def _bracket(ring: NDArray[np.void], head: int, sensor: int, instant_ns: int) -> tuple[int, int]:
    """Return the slots of the sensor's samples just before (or at) and just after the instant; -1: none."""
    depth = ring.shape[0]
    after = -1
    for back in range(depth):
        slot = (head - back) % depth
        if ring[slot].time_ns == _NEVER:
            break
        if np.isnan(ring[slot].measured[sensor, 0]):
            continue
        if ring[slot].time_ns <= instant_ns:
            return slot, after
        after = slot
    return -1, after


def _interpolate_modules(
    instant_ns: int, ring: NDArray[np.void], heads: IntArray, max_gap_ns: int, hold_ns: int
) -> tuple[FloatArray, StatusArray, IntArray, StatusArray]:
    """Return all modules at one instant: values (n, 3, 3), status, gap and ``Clipped`` sensors (n,).

    ring: (n, depth) ``INERTIAL_SAMPLE``; heads: (n,) place of the newest in it. A module's status is that of
    the first sensor that it has, in the order of the rows.
    """
    n = heads.shape[0]
    out = np.full((n, 3, 3), np.nan)
    status = np.full(n, _MISSING, dtype=np.uint8)
    gap_ns = np.zeros(n, dtype=np.int64)
    at_end = np.zeros(n, dtype=np.uint8)
    for m in range(n):
        judged = False
        for sensor in range(3):
            slot, slot_after = _bracket(ring[m], heads[m], sensor, instant_ns)
            if slot < 0:
                continue
            before, after = ring[m, slot], ring[m, slot_after]  # the latter of no use where there is none
            is_next = slot_after >= 0 and after.sequence - before.sequence == 1
            age_ns = instant_ns - before.time_ns
            span_ns = after.time_ns - before.time_ns if slot_after >= 0 else age_ns
            at_end[m] |= before.clipped
            if age_ns == 0:
                out[m, sensor] = before.measured[sensor]
                kind = _MEASURED
                span_ns = 0
            elif slot_after >= 0 and (span_ns <= max_gap_ns or is_next):
                weight = age_ns / span_ns
                at_end[m] |= after.clipped
                for axis in range(3):
                    out[m, sensor, axis] = (1.0 - weight) * before.measured[
                        sensor, axis
                    ] + weight * after.measured[sensor, axis]
                kind = _MEASURED if is_next else _INTERPOLATED
            elif age_ns <= hold_ns:
                out[m, sensor] = before.measured[sensor]
                kind = _HELD
            else:
                kind = _MISSING
            if not judged:
                status[m] = kind
                gap_ns[m] = span_ns
                judged = True
    return out, status, gap_ns, at_end
