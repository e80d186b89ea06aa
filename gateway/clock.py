"""Module time to gateway time.

Every module counts its own crystal. ``EstimatedClock`` finds rate and offset of one module from its
time stamps against the arrival times; ``SharedClock`` serves suits whose modules already count one
clock (wired suits, one controller): a single offset, set once, so that instants depend on the
stamps alone. Both unwrap the 32-bit counter and recognise a module that has restarted.

Sans-I/O and deterministic: arrival times are arguments.
"""

from __future__ import annotations

import itertools
from collections import deque
from typing import NamedTuple, Protocol

COUNTER_BITS = 32
MICROSECOND_NS = 1000
RESTART_NS = 2_000_000_000
"""A module whose time and arrival time have moved apart by this much has restarted."""


def unwrap(count: int, bits: int, near: int) -> int:
    """The full count nearest ``near`` whose low ``bits`` bits are ``count``."""
    period = 1 << bits
    return near + (count - near + period // 2) % period - period // 2


class ClockFigures(NamedTuple):
    """What is known of a module's clock."""

    offset_ns: int
    """Gateway time minus module time at the newest stamp."""
    skew_ppm: float
    """How much faster than the gateway's the module's clock runs (negative: slower)."""


class ModuleClock(Protocol):
    """Turns the time stamps of one module into gateway time."""

    @property
    def restarts(self) -> int:
        """How often the module was found to count from anew."""
        ...

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        """Gateway time in ns of a 32-bit stamp that arrived at ``arrived_ns``."""
        ...

    def figures(self) -> ClockFigures: ...


class _Unwrapper:
    """Full module time from its 32-bit microseconds; notices restarts."""

    def __init__(self) -> None:
        self.restarts = 0
        self._time_us = 0
        self._arrived_ns: int | None = None

    def full_time_ns(self, module_time_us: int, arrived_ns: int) -> tuple[int, bool]:
        """Unwrapped module time in ns, and whether the module has (re)started just now."""
        if self._arrived_ns is None:
            self._time_us, self._arrived_ns = module_time_us, arrived_ns
            return module_time_us * MICROSECOND_NS, True
        expected_us = self._time_us + (arrived_ns - self._arrived_ns) // MICROSECOND_NS
        full_us = unwrap(module_time_us, COUNTER_BITS, expected_us)
        restarted = abs(full_us - expected_us) * MICROSECOND_NS > RESTART_NS
        if restarted:
            self.restarts += 1
            full_us = module_time_us
        if restarted or full_us >= self._time_us:
            self._time_us, self._arrived_ns = full_us, arrived_ns
        return full_us * MICROSECOND_NS, restarted


class SharedOffset:
    """The one offset of all modules that count the same clock; set by the first stamp."""

    def __init__(self) -> None:
        self.offset_ns: int | None = None


class SharedClock:
    """A module that counts the same clock as its fellows: one offset for all, rate as stamped."""

    def __init__(self, shared: SharedOffset) -> None:
        self._shared = shared
        self._unwrapper = _Unwrapper()
        self._offset_ns = 0

    @property
    def restarts(self) -> int:
        return self._unwrapper.restarts

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        time_ns, restarted = self._unwrapper.full_time_ns(module_time_us, arrived_ns)
        if restarted:
            self._offset_ns = self._join(time_ns, arrived_ns)
        return time_ns + self._offset_ns

    def _join(self, time_ns: int, arrived_ns: int) -> int:
        """The common offset, or a new one when this module's stamps cannot belong to it."""
        shared = self._shared.offset_ns
        if shared is None or abs(time_ns + shared - arrived_ns) > RESTART_NS:
            self._shared.offset_ns = shared = arrived_ns - time_ns
        return shared

    def figures(self) -> ClockFigures:
        return ClockFigures(self._offset_ns, 0.0)


class _Point(NamedTuple):
    time_ns: int
    """Module time since the module's start."""
    delay_ns: int
    """Arrival minus module time, against the first: true offset, drift, and a transport delay >= 0."""


class EstimatedClock:
    """Rate and offset of one module from stamps against arrivals.

    Transport only ever delays, so the line wanted lies *below* all points (module time, arrival -
    module time) and as close to them as it can: of all such lines the one with the least summed
    distance passes through the edge of the lower convex hull above the mean time (Moon, Skelly,
    Towsley 1999, "Estimation and removal of clock skew from network delay measurements"). Only the
    earliest point of every block of module time is kept, so the hull stays small.
    """

    BLOCK_NS = 500_000_000
    MAX_BLOCKS = 120  # a minute: long enough to average jitter, short enough to follow temperature
    MIN_SPAN_NS = 2_000_000_000
    MAX_SKEW = 5e-3  # real modules have been seen 0.3 % off; more is jitter, not crystal

    def __init__(self) -> None:
        self._unwrapper = _Unwrapper()
        self._begin(0, 0)

    def _begin(self, time_ns: int, arrived_ns: int) -> None:
        self._start_ns, self._start_arrived_ns = time_ns, arrived_ns
        self._blocks: deque[_Point] = deque(maxlen=self.MAX_BLOCKS)
        self._open_block = _Point(0, 0)
        self._anchor = _Point(0, 0)
        self._slope = 0.0

    @property
    def restarts(self) -> int:
        return self._unwrapper.restarts

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        time_ns, restarted = self._unwrapper.full_time_ns(module_time_us, arrived_ns)
        if restarted:
            self._begin(time_ns, arrived_ns)
        elapsed_ns = time_ns - self._start_ns
        self._observe(_Point(elapsed_ns, arrived_ns - self._start_arrived_ns - elapsed_ns))
        return self._map(elapsed_ns)

    def _observe(self, point: _Point) -> None:
        if point.time_ns // self.BLOCK_NS > self._open_block.time_ns // self.BLOCK_NS:
            self._blocks.append(self._open_block)
            self._open_block = point
            self._fit()
        elif point.delay_ns < self._open_block.delay_ns:
            self._open_block = point
        if point.delay_ns < self._line(point.time_ns):
            self._anchor = point  # the line lies below all points, always

    def _line(self, time_ns: int) -> float:
        return self._anchor.delay_ns + self._slope * (time_ns - self._anchor.time_ns)

    def _map(self, elapsed_ns: int) -> int:
        return self._start_arrived_ns + elapsed_ns + round(self._line(elapsed_ns))

    def _fit(self) -> None:
        hull = _lower_hull(self._blocks)
        middle_ns = (hull[0].time_ns + hull[-1].time_ns) / 2
        edges = itertools.pairwise(hull)
        left, right = next((e for e in edges if e[1].time_ns >= middle_ns), (hull[0], hull[-1]))
        span_ns = self._blocks[-1].time_ns - self._blocks[0].time_ns
        if span_ns >= self.MIN_SPAN_NS and right.time_ns > left.time_ns:
            slope = (right.delay_ns - left.delay_ns) / (right.time_ns - left.time_ns)
            self._slope = min(max(slope, -self.MAX_SKEW), self.MAX_SKEW)
            self._anchor = min(hull, key=lambda point: point.delay_ns - self._slope * point.time_ns)
        else:
            self._anchor = min(self._blocks, key=lambda point: point.delay_ns)

    def figures(self) -> ClockFigures:
        offset_ns = self._start_arrived_ns - self._start_ns + round(self._line(self._open_block.time_ns))
        skew_ppm = (1.0 / (1.0 + self._slope) - 1.0) * 1e6
        return ClockFigures(offset_ns, skew_ppm)


def _lower_hull(points: deque[_Point]) -> list[_Point]:
    """Lower convex hull of points in order of time (Andrew's monotone chain)."""
    hull: list[_Point] = []
    for point in points:
        while len(hull) >= 2 and _turns_down(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _turns_down(first: _Point, second: _Point, third: _Point) -> bool:
    """Whether ``second`` lies on or above the line from ``first`` to ``third``."""
    rise = (second.delay_ns - first.delay_ns) * (third.time_ns - first.time_ns)
    return rise >= (third.delay_ns - first.delay_ns) * (second.time_ns - first.time_ns)
