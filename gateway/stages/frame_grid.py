"""Samples into rings, and instants of the grid out of them, a batch in one call. Compiled.

``FrameAssembler`` says what is asked of it; ``tests/gateway/plain_assembler.py`` is the same without a
compiler, and both are held against each other. State has names: one ``GRID``, a ``MODULE`` for each module of
the rig, a ring of the last samples of each. ``take`` goes through a batch and stops early where a block
of instants is full, or ``passed``; called again with the sample that it names, it goes on.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.frames import INERTIAL_SAMPLE, FloatArray, IntArray, Status, StatusArray
from gateway.geometry.compiled import compiled

DEPTH = 64  # samples kept of each module; at 1000 Hz 64 ms, more than any sensible wait
NEVER = int(np.iinfo(np.int64).min)
_LONGEST_CATCH_UP_NS = 1_000_000_000
_REST_OF_BURST_NS = 5_000_000
"""So long after a module's sample those of the others come, however late they all are."""
_MEASURED, _INTERPOLATED = int(Status.MEASURED), int(Status.INTERPOLATED)
_HELD, _MISSING = int(Status.HELD), int(Status.MISSING)

GRID = np.dtype(
    [
        ("interval_ns", np.float64),
        ("max_wait_ns", np.int64),
        ("max_gap_ns", np.int64),
        ("hold_ns", np.int64),
        ("start_wait_ns", np.int64),
        ("newest_ns", np.int64),  # of all modules; -1: none yet
        ("n_reporting", np.int64),  # modules that have been heard
        ("n_awaited", np.int64),  # modules that the next instant waits for
        ("row", np.int64),  # of the module whose sample came last
        ("first_arrival_ns", np.int64),
        ("start_ns", np.int64),  # grid point 0
        ("count", np.int64),  # grid points passed, skipped ones included
        ("instant_ns", np.int64),  # the next one; -1: the grid has not begun
        ("last_instant_ns", np.int64),  # of the last frame
        ("passed_begin", np.int64),  # of the queue ``passed``: its first entry
        ("n_passed", np.int64),  # and how many there are
        ("late", np.int64),  # what was lost since this was last read
        ("duplicate", np.int64),
        ("unknown_module", np.int64),
        ("skipped_instant", np.int64),
        ("has_arrival", np.bool_),
        ("has_begun", np.bool_),
        ("is_interrupted", np.bool_),  # while it gave the instants that a sample completes
    ],
    align=True,
)
"""Parameters and state of one assembler."""
MODULE = np.dtype(
    [
        ("id", np.int64),
        ("newest_ns", np.int64),  # -1: never heard
        ("head", np.int64),  # place of the newest sample in its ring
        ("late", np.int64),  # samples lost as such since this was last read
        ("is_awaited", np.bool_),  # the next instant waits for it
    ],
    align=True,
)
"""What is known of one module."""
PASSED = np.dtype([("reached_ns", np.int64), ("arrived_ns", np.int64)])
"""Up to which instant any module had been heard, and when that arrived. The queue of them begins with the
next frame's: older ones are dropped when that frame becomes the next. Of one arrival there is one entry."""
INSTANT = np.dtype([("time_ns", np.int64), ("is_clipped", np.bool_)], align=True)
"""A frame; is_clipped: a sensor of any module was at the end of its range."""


class Assembly(NamedTuple):
    """What an assembler of n modules knows."""

    grids: NDArray[np.void]  # (1,) GRID
    modules: NDArray[np.void]  # (n,) MODULE
    rings: NDArray[np.void]  # (n, DEPTH) INERTIAL_SAMPLE
    passed: NDArray[np.void]  # a queue of PASSED


class InstantBlock(NamedTuple):
    """Room for T instants of n modules."""

    instants: NDArray[np.void]  # (T,) INSTANT
    specific_force: FloatArray  # (T, n, 3)
    angular_rate: FloatArray  # (T, n, 3)
    magnetic_field: FloatArray  # (T, n, 3)
    status: StatusArray  # (T, n)
    gap_ns: IntArray  # (T, n)
    clipped: StatusArray  # (T, n)


def new_block(size: int, n: int) -> InstantBlock:
    """Return room for so many instants of n modules."""
    force, rate, field = (np.empty((size, n, 3)) for _ in range(3))
    status, clipped = (np.empty((size, n), np.uint8) for _ in range(2))
    return InstantBlock(
        np.zeros(size, INSTANT), force, rate, field, status, np.empty((size, n), np.int64), clipped
    )


def new_rings(n: int) -> NDArray[np.void]:
    """Return rings (n, DEPTH) ``INERTIAL_SAMPLE`` of modules never heard."""
    rings = np.zeros((n, DEPTH), INERTIAL_SAMPLE)
    rings["time_ns"], rings["measured"] = NEVER, np.nan
    return rings


@compiled
def take(
    assembly: Assembly, samples: NDArray[np.void], first: int, arrived_ns: int, used: int, block: InstantBlock
) -> tuple[int, int, int, int]:
    """Take samples (k,) from ``first`` on, and write the instants that they complete after ``used`` others.

    Returns the sample to go on with (k: all are taken), how many of the block are used now, how many samples
    were kept, and how many samples and instants were lost.
    """
    modules, rings, passed, instants = assembly.modules, assembly.rings, assembly.passed, block.instants
    grid, taken, lost = assembly.grids[0], 0, 0
    for index in range(first, len(samples)):
        if not grid.is_interrupted:
            if grid.n_passed == len(passed):
                return index, used, taken, lost
            row = _row_of(grid, modules, samples[index].module)
            if row < 0:
                grid.unknown_module += 1
                lost += 1
                continue
            if not _store(grid, modules, rings[row], row, samples[index]):
                lost += 1
                continue
            taken += 1
            lost += _note_arrival(grid, modules, passed, arrived_ns)
        if not grid.has_begun:
            continue
        while used < len(instants) and _is_due(grid, modules, passed, arrived_ns):
            instants[used].time_ns = grid.instant_ns
            instants[used].is_clipped = _interpolate(grid, modules, rings, block, used)
            used += 1
            grid.last_instant_ns = grid.instant_ns
            _advance(grid, modules, passed, grid.count + 1)
        grid.is_interrupted = used == len(instants)
        if grid.is_interrupted:
            return index, used, taken, lost
    return len(samples), used, taken, lost


@compiled
def _row_of(grid: Any, modules: NDArray[np.void], module: int) -> int:
    """Return the row of a module, -1: the rig does not name it. They come mostly in the order of the rig."""
    n = len(modules)
    for k in range(1, n + 1):
        row = int(grid.row) + k
        if row >= n:
            row -= n
        if modules[row].id == module:
            grid.row = row
            return row
    return -1


@compiled
def _store(grid: Any, modules: NDArray[np.void], ring: NDArray[np.void], row: int, sample: Any) -> bool:
    """Keep a sample of a module in its ring (DEPTH,); returns whether it was of use."""
    module = modules[row]
    if module.newest_ns < 0:
        grid.n_reporting += 1
    elif sample.time_ns <= module.newest_ns:
        return _insert_late(grid, module, ring, sample)
    module.head = (module.head + 1) % DEPTH
    ring[module.head] = sample
    module.newest_ns = sample.time_ns
    grid.newest_ns = max(grid.newest_ns, sample.time_ns)
    if module.is_awaited and sample.time_ns >= grid.instant_ns:
        module.is_awaited = False
        grid.n_awaited -= 1
    return True


@compiled
def _insert_late(grid: Any, module: Any, ring: NDArray[np.void], sample: Any) -> bool:
    """Insert a sample that newer ones overtook; return False if its instant has passed, or it is a
    repetition.
    """
    newer = 0
    for slot in range(DEPTH):
        if ring[slot].time_ns == sample.time_ns:
            grid.duplicate += 1
            return False
        if ring[slot].time_ns > sample.time_ns:
            newer += 1
    if sample.time_ns <= grid.last_instant_ns or newer == DEPTH:
        grid.late += 1
        module.late += 1
        return False
    module.head = (module.head + 1) % DEPTH
    for back in range(newer):  # each a slot on, the newest first
        ring[(module.head - back) % DEPTH] = ring[(module.head - back - 1) % DEPTH]
    ring[(module.head - newer) % DEPTH] = sample
    return True


@compiled
def _note_arrival(grid: Any, modules: NDArray[np.void], passed: NDArray[np.void], arrived_ns: int) -> int:
    """Update the grid after a sample that was kept; return how many instants were skipped.

    Notes how far the modules have come, begins the grid, and goes on after silence.
    """
    last = (grid.passed_begin + grid.n_passed - 1) % len(passed)
    reached_ns = passed[last].reached_ns if grid.n_passed > 0 else grid.instant_ns - 1
    if grid.newest_ns > reached_ns:
        if grid.n_passed == 0 or passed[last].arrived_ns != arrived_ns:
            last = (last + 1) % len(passed)
            grid.n_passed += 1
            passed[last].arrived_ns = arrived_ns
        passed[last].reached_ns = grid.newest_ns
    if not grid.has_arrival:
        grid.has_arrival, grid.first_arrival_ns = True, arrived_ns
    if not grid.has_begun and not _begin(grid, modules, passed, arrived_ns):
        return 0
    if grid.newest_ns - grid.instant_ns > grid.hold_ns + _LONGEST_CATCH_UP_NS:
        return _skip_silence(grid, modules, passed)
    return 0


@compiled
def _begin(grid: Any, modules: NDArray[np.void], passed: NDArray[np.void], arrived_ns: int) -> bool:
    """Begin the grid at the instant from which all modules (heard so far) have samples."""
    is_patient = arrived_ns - grid.first_arrival_ns < grid.start_wait_ns
    if grid.n_reporting != len(modules) and is_patient:
        return False
    grid.start_ns, grid.has_begun = grid.newest_ns, True
    _advance(grid, modules, passed, 0)
    return True


@compiled
def _advance(grid: Any, modules: NDArray[np.void], passed: NDArray[np.void], count: int) -> None:
    """Make grid point ``count`` the next instant, and note which modules it has to wait for."""
    grid.count = count
    grid.instant_ns = grid.start_ns + round(count * grid.interval_ns)
    while grid.n_passed > 0 and passed[grid.passed_begin].reached_ns < grid.instant_ns:
        grid.passed_begin = (grid.passed_begin + 1) % len(passed)
        grid.n_passed -= 1
    live_since, n_awaited = grid.newest_ns - grid.hold_ns, 0
    for row in range(len(modules)):
        module = modules[row]
        # Modules that have been silent for the hold time are not waited for.
        module.is_awaited = live_since <= module.newest_ns < grid.instant_ns
        n_awaited += module.is_awaited
    grid.n_awaited = n_awaited


@compiled
def _is_due(grid: Any, modules: NDArray[np.void], passed: NDArray[np.void], arrived_ns: int) -> bool:
    """Return whether the next instant has all that it may wait for."""
    if grid.newest_ns < grid.instant_ns:
        return False
    if grid.n_awaited == 0:
        return True
    # a burst that comes late as a whole is read to its end first
    rest_ns = passed[grid.passed_begin].arrived_ns + _REST_OF_BURST_NS
    if arrived_ns >= max(grid.instant_ns + grid.max_wait_ns, rest_ns):
        return True
    if grid.newest_ns - grid.instant_ns > grid.hold_ns:
        _advance(grid, modules, passed, grid.count)  # who has been silent for so long is not waited for
    return bool(grid.n_awaited == 0)


@compiled
def _skip_silence(grid: Any, modules: NDArray[np.void], passed: NDArray[np.void]) -> int:
    """Move the grid to the present after silence of the whole suit; return how many instants were skipped."""
    count = int((grid.newest_ns - grid.start_ns) // grid.interval_ns)
    skipped = count - int(grid.count)
    grid.skipped_instant += skipped
    _advance(grid, modules, passed, count)
    return skipped


@compiled
def _bracket(ring: NDArray[np.void], head: int, sensor: int, instant_ns: int) -> tuple[int, int]:
    """Return the slots of the sensor's samples just before (or at) and just after the instant; -1: none."""
    after = -1
    for back in range(DEPTH):
        slot = (head - back) % DEPTH
        if ring[slot].time_ns == NEVER:
            break
        # Sensors of a module may have different rates: this sample has none of this sensor.
        if np.isnan(ring[slot].measured[sensor, 0]):
            continue
        if ring[slot].time_ns <= instant_ns:
            return slot, after
        after = slot
    return -1, after


@compiled
def _interpolate(
    grid: Any, modules: NDArray[np.void], rings: NDArray[np.void], block: InstantBlock, used: int
) -> bool:
    """Write all modules at the next instant as the instant ``used`` of the block; return whether a sensor was
    clipped.

    A module's status is that of the first sensor that it has, in the order of a sample's rows.
    """
    measured = block.specific_force[used], block.angular_rate[used], block.magnetic_field[used]
    status, gap_ns, clipped, is_clipped = block.status[used], block.gap_ns[used], block.clipped[used], False
    for m in range(len(modules)):
        ring, head = rings[m], modules[m].head
        status[m], gap_ns[m], clipped[m], judged = _MISSING, 0, 0, False
        for sensor in range(3):
            kind, span_ns = _value_at(grid, ring, head, sensor, measured[sensor][m], clipped[m : m + 1])
            if kind >= 0 and not judged:
                status[m], gap_ns[m], judged = kind, span_ns, True
        is_clipped |= clipped[m] != 0
    return is_clipped


@compiled
def _value_at(
    grid: Any, ring: NDArray[np.void], head: int, sensor: int, values: FloatArray, clipped: StatusArray
) -> tuple[int, int]:
    """Write a sensor's values (3,) at the next instant, NaN where there are none; add to clipped (1,) what
    was at its end in the samples that they rest on.

    Returns their ``Status`` (-1: there is no sample at or before it), and the time between these samples, ns.
    """
    for axis in range(3):
        values[axis] = np.nan
    slot, slot_after = _bracket(ring, head, sensor, grid.instant_ns)
    if slot < 0:
        return -1, 0
    before, after = ring[slot], ring[slot_after]  # the latter of no use where there is none
    is_next = slot_after >= 0 and after.sequence - before.sequence == 1
    age_ns = int(grid.instant_ns - before.time_ns)
    span_ns = int(after.time_ns - before.time_ns) if slot_after >= 0 else age_ns
    clipped[0] |= before.clipped
    if age_ns != 0 and slot_after >= 0 and (span_ns <= grid.max_gap_ns or is_next):
        weight, earlier, later = age_ns / span_ns, before.measured[sensor], after.measured[sensor]
        clipped[0] |= after.clipped
        for axis in range(3):
            values[axis] = (1.0 - weight) * earlier[axis] + weight * later[axis]
        return _MEASURED if is_next else _INTERPOLATED, span_ns
    if age_ns > grid.hold_ns:
        return _MISSING, span_ns
    for axis in range(3):
        values[axis] = before.measured[sensor, axis]
    return (_MEASURED, 0) if age_ns == 0 else (_HELD, span_ns)
