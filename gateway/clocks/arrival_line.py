"""Instants of samples without a stamp, from when they arrived and how many there were.

Their numbers must be known: of samples without any ``gateway.sources.arrival_counter`` finds those first.
"""

from __future__ import annotations

from gateway.clocks.module_clock import ClockFigures

_LEAST_SAMPLES = 8
"""Before, the interval is not known: an instant is that of arrival."""
_TOGETHER_NS = 1_000_000
"""What arrives within so long has waited somewhere: the interval is not learnt from it."""
_MANY_SAMPLES = 32
"""After so many it is all the same; and after a silence so many are better than the mean of those before."""
_REMEMBERED = 2048
"""Samples that the interval is a mean over."""
_PULL = 0.005
"""Of its lateness, by which a sample that came late draws the line along: a slow clock is followed, a slow
network hardly. While the interval is a mean over fewer samples than this is the share of, it is their share:
the line is off by what the interval is off, and not for long."""
_STEADY = 50
"""So many samples in a row late by more than an interval: nothing was lost, the device paused."""
_RISE_NS = 20_000
"""By which a shortest round trip is given up with every ping: the way may have become a longer one."""
_LATENESS_GAIN = 0.01
_ANEW_NS = 400_000_000
"""So far from the line it begins anew."""


class ArrivalLine:
    """Follows the earliest arrivals of regular samples: a network delays, and never hands over early.

    An instant is never after the arrival, and later than the sampling by the shortest delay on the way, which
    two-way probes tell.
    """

    def __init__(self) -> None:
        self.interval_ns = 0.0
        """Mean time between two samples; 0: not known yet."""
        self._first_ns = 0
        self._arrived_ns = 0
        self._samples = -1
        self._n_arrivals = 0
        self._needed = _LEAST_SAMPLES
        """Samples since ``_first_ns`` from which the interval is a mean over them."""
        self._line_ns = 0.0
        self._late = 0
        self._least_late_ns = 0.0
        self.lateness_ns = 0.0
        """Mean time from an instant to its arrival, of late."""

    def intervals_since(self, arrived_ns: int) -> int:
        """Return how many intervals after the newest sample something arrived, at least 1."""
        if not self.interval_ns:
            return 1
        return max(1, round((arrived_ns - self._line_ns) / self.interval_ns))

    def instant(self, intervals: int, arrived_ns: int) -> int:
        """Return the instant of the next sample, ns.

        intervals: since the sample before, 1 where none was lost in between.
        """
        if self._samples < 0:
            self._begin(arrived_ns)
            return arrived_ns
        self._measure(intervals, arrived_ns)
        if not self.interval_ns:
            self._line_ns = float(arrived_ns)
            return arrived_ns
        expected_ns = self._line_ns + intervals * self.interval_ns
        late_ns = arrived_ns - expected_ns
        # So far off the line is no delay: the device was restarted, or paused for long.
        if abs(late_ns) > _ANEW_NS:
            self._begin(arrived_ns)
            return arrived_ns
        pull = max(_PULL, 1.0 / self._samples)
        # Early arrivals pull the line fully, as nothing arrives before it was sent; late ones only a little.
        self._line_ns = expected_ns + min(late_ns, pull * late_ns) + self._paused(late_ns)
        self.lateness_ns += _LATENESS_GAIN * (arrived_ns - self._line_ns - self.lateness_ns)
        return int(self._line_ns)

    def _begin(self, arrived_ns: int) -> None:
        self._needed = _MANY_SAMPLES if self.interval_ns else _LEAST_SAMPLES
        self._samples, self._late = 0, 0
        self._first_ns = self._arrived_ns = arrived_ns
        self._line_ns = float(arrived_ns)

    def _measure(self, intervals: int, arrived_ns: int) -> None:
        """Take in the time since the sample before."""
        since_ns, self._arrived_ns = arrived_ns - self._arrived_ns, arrived_ns
        self._samples += intervals
        self._n_arrivals += 1
        if self._samples > _REMEMBERED and self.interval_ns:
            self.interval_ns += (since_ns - intervals * self.interval_ns) / _REMEMBERED
        elif since_ns < _TOGETHER_NS and not self.interval_ns and self._n_arrivals < _MANY_SAMPLES:
            self._first_ns, self._samples = arrived_ns, 0
        elif self._samples >= self._needed:
            self.interval_ns = max(1.0, (arrived_ns - self._first_ns) / self._samples)

    def _paused(self, late_ns: float) -> float:
        """Return by how much the line is to be moved, because all recent samples are late."""
        if late_ns <= self.interval_ns:
            self._late = 0
            return 0.0
        self._least_late_ns = min(late_ns, self._least_late_ns) if self._late else late_ns
        self._late += 1
        if self._late < _STEADY:
            return 0.0
        self._late = 0
        return self._least_late_ns


class ArrivalClock:
    """The clock of a device that has none: its stamps are µs of gateway time, from an ``ArrivalLine``.

    Half the shortest round trip of pings is what the least delay on the way is taken for.
    """

    restarts = 0

    def __init__(self, line: ArrivalLine) -> None:
        self._line = line
        self._shortest_ns: int | None = None

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        """Return the gateway time, ns, of a 32-bit stamp that arrived at ``arrived_ns``: not after it."""
        arrived_us = arrived_ns // 1000
        full_us = arrived_us - (arrived_us - module_time_us) % 2**32
        return full_us * 1000 - (self._shortest_ns or 0) // 2

    def add_round_trip(self, round_trip_ns: int) -> None:
        """Take in how long it took until a ping was back."""
        known_ns = round_trip_ns if self._shortest_ns is None else self._shortest_ns + _RISE_NS
        self._shortest_ns = max(0, min(round_trip_ns, known_ns))

    def figures(self) -> ClockFigures:
        """Return how far instants can be off by the way alone, and by how much arrivals are late on
        average."""
        bound_us = None if self._shortest_ns is None else 0.5e-3 * self._shortest_ns
        return ClockFigures(0, 0.0, residual_us=self._line.lateness_ns * 1e-3, bound_us=bound_us)
