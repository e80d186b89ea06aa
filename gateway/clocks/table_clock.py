"""Mode 1 at run time: rates from the table, offsets from the first arrivals, then from nothing else.

Every module's count becomes time of the reference clock by the table. How the counts of two modules stand to
each other is found once, in the first seconds after the module's start; from then on it is the table alone
that holds them together. The reference's own clock is turned into gateway time by its arrivals.
"""

from __future__ import annotations

from gateway.clocks.batching import LinkBatching
from gateway.clocks.counter import Counter32
from gateway.clocks.estimated import EstimatedClock
from gateway.clocks.module_clock import ClockFigures
from gateway.clocks.table import ClockTable

FREEZE_US = 20_000_000
"""After so much time of the module its offset against the reference stands."""


class TableClocks:
    """The clocks of all modules of one table."""

    def __init__(self, table: ClockTable, *, is_compiled: bool = True) -> None:
        """Begin without modules; ``is_compiled`` as for ``EstimatedClock``."""
        self.table = table
        self.is_compiled = is_compiled
        self.reference: TableClock | None = None
        """Clock of the reference module, once it was heard."""

    def clock(self, module: int, batching: LinkBatching | None = None) -> TableClock:
        """Return the clock of a module."""
        clock = TableClock(self, module, batching)
        if module == self.table.reference:
            self.reference = clock
        return clock


class TableClock:
    """One module by the table. Without a reference on the air it estimates its corrected time by itself."""

    def __init__(self, clocks: TableClocks, module: int, batching: LinkBatching | None) -> None:
        self._clocks = clocks
        self._module = module
        self._counter = Counter32()
        self._estimate = EstimatedClock(batching, is_compiled=clocks.is_compiled)
        self._start_us = 0
        self._counts_per_us = 1.0
        self._ahead_us: float | None = None  # reference's corrected time minus this one's, same instant
        self._reference_restarts = 0

    @property
    def restarts(self) -> int:
        """How often the module's counter was found to count from anew."""
        return self._counter.restarts

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        """Return the gateway time, ns, of a sample, from the module's counter and the packet's arrival."""
        expected_us = self._start_us + self._counts_per_us * self._estimate.count_us(arrived_ns)
        full_us = self._counter.full_us(module_time_us, int(expected_us), arrived_ns)
        # The counter began anew: offsets of before hold no longer, the rate does.
        if full_us is None:
            full_us = self._start_us = module_time_us
            self._ahead_us = None
            self._estimate.forget()
        counted_us = full_us - self._start_us
        corrected_us = self._clocks.table.reference_us(self._module, counted_us)
        if corrected_us > 0:
            self._counts_per_us = counted_us / corrected_us
        estimated_ns = self._estimate.gateway_time(round(corrected_us) % 2**32, arrived_ns)
        reference = self._clocks.reference

        if reference is None or reference is self:
            return estimated_ns
        if self._ahead_us is None or self._reference_restarts != reference.restarts:
            # Until both have run for a while, the offset between them is not known well enough to be frozen.
            if min(corrected_us, reference.corrected_us) < FREEZE_US:
                return estimated_ns
            self._reference_restarts = reference.restarts
            self._ahead_us = reference.count_us(estimated_ns) - corrected_us
        return min(reference.instant_ns(corrected_us + self._ahead_us), arrived_ns)

    @property
    def corrected_us(self) -> float:
        """Reference time since the start, at the newest stamp."""
        return float(self._estimate.newest_us)

    def count_us(self, time_ns: int) -> float:
        """Return the reference time since the start at a gateway time."""
        return self._estimate.count_us(time_ns)

    def instant_ns(self, corrected_us: float) -> int:
        """Return the gateway time, ns, of a reference time since the start."""
        return self._estimate.instant_ns(round(corrected_us))

    def figures(self) -> ClockFigures:
        """Return offset and rate; the rate adds what was estimated to that of the table."""
        figures = self._estimate.figures()
        table = self._clocks.table
        ppm = table.skew_ppm(self._module) if self._module in table.alpha else 0.0
        return figures._replace(skew_ppm=figures.skew_ppm + ppm)
