"""What a module clock is, the row of its state, and the clock of modules that already count one time.

Every packet touches the state, so it is a row that compiled code shares (``clock_kernels``).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from gateway.clocks.counter import COUNTER32, Counter32
from gateway.support.rows import Memory, Row, fields_of, part

MOST_PACKETS = 2_000
"""Of one block, so that a module with a runaway rate does not make it dearer; and of the opening."""

UNKNOWN, ESTIMATED, SHARED = range(3)
"""Kinds of clock: ``UNKNOWN`` are those that compiled code leaves to Python."""

CLOCK = np.dtype(
    [
        ("kind", np.int64),
        ("counter", COUNTER32),
        # of either kind: gateway time that full counts are reckoned from
        ("start_ns", np.int64),  # shared: gateway time minus module time; estimated: arrival of the start
        ("received_ns", np.int64),  # shared: arrival of the newest stamp
        # estimated: see ``EstimatedClock``
        ("start_us", np.int64),
        ("expected_us", np.int64),  # full count that arrives at the start
        ("fit_us", np.int64),  # published: offset + rate (t - fit) + correction, which fades away
        ("offset_us", np.float64),
        ("rate", np.float64),
        ("correction_us", np.float64),
        ("fade_us", np.float64),
        ("clamped_us", np.int64),  # newest stamp that arrived before its instant, and that instant
        ("clamped_ns", np.int64),
        ("block_end_us", np.int64),
        ("packets", np.int64),  # of the block so far: the first ones of the two that follow
        ("elapsed_us", np.int64, (MOST_PACKETS + 1,)),
        ("delays_us", np.float64, (MOST_PACKETS + 1,)),
    ]
)
"""A clock; µs of the module's clock since ``start_us`` unless their name says otherwise."""


MICROSECOND_NS = 1000
SAME_CLOCK_NS = 2_000_000_000
"""Modules whose offsets differ by more do not count the same clock."""


RATE_SETTLED_PPM = 5.0
"""A rate is published once its standard deviation is this or less: after some 10 s over an ordinary link."""


class ClockFigures(NamedTuple):
    """What is known of a module's clock."""

    offset_ns: int
    """Gateway time minus module time at the newest stamp."""
    skew_ppm: float
    """How much faster than the gateway's the module's clock runs (negative: slower)."""
    residual_us: float = 0.0
    """Mean of the delay of arrivals above the floor that the estimate stands on (the constant part of the
    delay cannot be told from an offset)."""
    sigma_us: float = 0.0
    """Standard deviation of the offset, as the estimate has it; 0 where nothing is estimated."""
    bound_us: float | None = None
    """How far the offset can be off at most, whatever the delays of the two ways: half the shortest round
    trip, and the estimate's own error. None without two-way exchanges."""
    steps: int = 0
    """How often the instants had to jump, because the estimate was too far off to be slewed."""
    rate_sigma_ppm: float = 0.0
    """Standard deviation of ``skew_ppm``, as the estimate has it; 0 where nothing is estimated."""

    @property
    def is_settled(self) -> bool:
        """Whether the rate is known well enough to be published."""
        return self.rate_sigma_ppm <= RATE_SETTLED_PPM


class ModuleClock(Protocol):
    """Turns the time stamps of one module into gateway time."""

    @property
    def restarts(self) -> int:
        """How often the module was found to count from anew."""
        ...

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        """Return the gateway time, ns, of a 32-bit stamp that arrived at ``arrived_ns``."""
        ...

    def figures(self) -> ClockFigures:
        """Return offset, rate and their uncertainty as now estimated."""


class SharedOffset:
    """The one offset of all modules that count the same clock; set by the first stamp."""

    def __init__(self) -> None:
        self.offset_ns: int | None = None


class SharedClock(Row):
    """A module that counts the same clock as its fellows: one offset for all, rate as stamped."""

    layout = CLOCK
    _fields_ = fields_of(CLOCK)
    _kind: int
    _start_ns: int
    _received_ns: int

    def __init__(
        self,
        shared: SharedOffset,
        *,
        memory: Memory | None = None,
    ) -> None:
        """Begin without a stamp; ``memory`` is a zeroed ``CLOCK`` where compiled code shares the state."""
        self._kind = SHARED
        self._shared = shared
        self._counter = Counter32(memory=part(self.memory, CLOCK, "counter"))

    @property
    def restarts(self) -> int:
        """How often the modules' counter began anew."""
        return self._counter.restarts

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        # from packet to packet: data may be played faster than they were taken, and nothing is estimated
        """Return the gateway time of a stamp, ns."""
        newest_us = self._counter.newest_us
        expected_us = (newest_us or 0) + (arrived_ns - self._received_ns) // MICROSECOND_NS
        full_us = self._counter.full_us(module_time_us, expected_us, arrived_ns)
        if full_us is None or self._counter.newest_us != newest_us:
            self._received_ns = arrived_ns
        if full_us is None:
            full_us = module_time_us
            self._start_ns = self._join(module_time_us * MICROSECOND_NS, arrived_ns)
        return full_us * MICROSECOND_NS + self._start_ns

    def _join(self, time_ns: int, arrived_ns: int) -> int:
        """Return the common offset, or a new one when this module's stamps cannot belong to it."""
        shared = self._shared.offset_ns
        if shared is None or abs(time_ns + shared - arrived_ns) > SAME_CLOCK_NS:
            self._shared.offset_ns = shared = arrived_ns - time_ns
        return shared

    def figures(self) -> ClockFigures:
        """Return the common offset; the rate is exact, since the modules count one clock."""
        return ClockFigures(self._start_ns, 0.0)
