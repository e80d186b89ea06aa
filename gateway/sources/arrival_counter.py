"""Numbers and stamps for samples of devices that send neither: by when they arrive, and how many.

Samples are taken at even intervals, and what delays them on their way only ever does so for a while. So the
least of ``arrival − number × interval`` over a few samples stays what it is, and rises by whole intervals
where samples were lost. A burst after a stall does not count: in it that value falls from sample to sample.

The stamps then go through the clock of any module. Where packets have numbers, so that losses are known, and
pings measure the delay, ``gateway.clocks.ArrivalLine`` gives instants straight away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from gateway.clocks import unwrap

_HALF = 24
"""Samples that are held against as many after them to measure an interval; none of them is made use of."""
_AGREED = 1.05
"""Two intervals measured one after the other may differ by so much to be believed."""
_EVEN = 1.25
"""The upper quartile of the intervals learnt from over the lower one; beyond it samples came in bursts."""
_BURSTS = 16
"""So many times more half of the samples are new, until they come neither in bursts nor at another rate."""
_SHORTEST_NS = 100_000.0
"""No device samples faster: what came in less had waited somewhere."""
_KNOWN = 0.92, 1.15
"""A measured interval between so much of a known one is taken for it: losses make it longer."""
_HALF_NS = 80_000_000
"""At least so long, and so many samples: of two such spans in a row the least values are compared."""
_HALF_SAMPLES = 4
_ALIKE = 0.5
"""Of the interval, by which they may differ."""
_UNLIKE_SPANS = 24
"""In a row, after which the interval must be another one: the device was set anew."""
_SILENCE_NS = 2_000_000_000
"""After so long what comes was not under way for that time."""
_CREEP = 0.01
"""Of what a counted sample is late by, by which the least value follows: for rates that are a little off."""
_EARLY = 3
"""Counts that a sample can be ahead of its arrival, as far as that is known."""


class ArrivalCounter:
    """Samples of one device, in order."""

    def __init__(
        self, rates_hz: Sequence[float] = (), rate_hz: float | None = None, counter_bits: int | None = None
    ) -> None:
        """Begin without a sample.

        rates_hz: output rates that such a device can have; empty: any rate.
        rate_hz: output rate that it has; None: it is estimated from the first samples.
        counter_bits: width of the counter in every sample; None: samples have no counter.
        """
        self.interval_ns: float | None = None if rate_hz is None else 1e9 / rate_hz
        """Between two samples; None: not known yet."""
        self._rates_hz, self._bits = rates_hz, counter_bits
        self._first: list[tuple[int, int]] = []  # (arrival, number) of the samples learnt from
        self._bursts = 0
        self._measured_ns: float | None = None
        """Interval of the samples before, which those that follow on them are to confirm."""
        self._number = -1
        self._shift = 0
        """Added to the counts of a device that counts from anew."""
        self._arrived_ns: int | None = None
        self._least_ns: float | None = None
        self._span: list[float] = []
        self._before_ns: float | None = None  # least of the span before
        self._delay_ns = 0.0  # arrival − stamp, before the interval was to be learnt anew
        self._unlike = 0  # spans in a row that were not like the one before
        self._stamped: tuple[int, float] | None = None
        """Number and stamp, ns, of the newest sample."""

    def stamp(self, arrived_ns: int, count: int | None = None, n_lost: int = 0) -> tuple[int, int] | None:
        """Return number and stamp (32 bits, µs) of the next sample; None while its interval is learnt.

        count: the one that it has; n_lost: samples before it that are known to be lost.
        """
        last_ns, self._arrived_ns = self._arrived_ns, arrived_ns
        if self.interval_ns is None:
            self._learn(arrived_ns, count, n_lost)
            return None
        silence_ns = 0 if last_ns is None else arrived_ns - last_ns
        if count is not None and self._bits is not None:
            self._number = self._counted(arrived_ns, count, self.interval_ns)
        # After silence the count goes on by the clock: how many samples were not sent cannot be known
        # otherwise.
        elif silence_ns > _SILENCE_NS:
            self._number += max(1, round(silence_ns / self.interval_ns))
            self._least_ns, self._before_ns, self._span = None, None, []
        else:
            self._number += 1 + n_lost
            self._number += self._unseen(arrived_ns - self._number * self.interval_ns, self.interval_ns)

        number, stamp_ns = self._stamped or (0, 0.0)
        stamp_ns += (self._number - number) * self.interval_ns
        self._stamped = self._number, stamp_ns
        # The spans have not looked alike for long: the interval itself has changed, and is learnt anew.
        if self._unlike >= _UNLIKE_SPANS:
            by_number_ns = self._number * self.interval_ns
            self._delay_ns = (self._least_ns or arrived_ns - by_number_ns) + by_number_ns - stamp_ns
            self.interval_ns, self._unlike = None, 0
            self._least_ns, self._before_ns, self._span = None, None, []
        return self._number, round(stamp_ns * 1e-3) % 2**32

    def _counted(self, arrived_ns: int, count: int, interval_ns: float) -> int:
        assert self._bits is not None
        expected = self._number + 1
        if self._least_ns is not None:
            expected = max(expected, int((arrived_ns - self._least_ns) / interval_ns))
        number = unwrap(count + self._shift, self._bits, expected)
        if not self._number < number <= expected + _EARLY:  # it counts from anew
            number, self._least_ns = self._number + 1, None
            self._shift = number - count
        late_ns = arrived_ns - number * interval_ns
        if self._least_ns is None or late_ns < self._least_ns:
            self._least_ns = late_ns
        else:
            self._least_ns += _CREEP * (late_ns - self._least_ns)
        return number

    def _unseen(self, late_ns: float, interval_ns: float) -> int:
        """Return how many samples before this one were lost, as far as that shows now."""
        # The least delay of a span is nearly free of jitter; a step of a whole interval in it is a lost
        # sample.
        self._span.append(late_ns)
        if len(self._span) < max(_HALF_SAMPLES, _HALF_NS / interval_ns):
            return 0
        before_ns, now_ns = self._before_ns, min(self._span)
        self._before_ns, self._span = now_ns, []
        if before_ns is None or abs(now_ns - before_ns) > _ALIKE * interval_ns:
            self._unlike += 1
            return 0
        self._unlike = 0
        settled_ns = min(before_ns, now_ns)
        if self._least_ns is None:
            self._least_ns = settled_ns
        n_lost = max(0, round((settled_ns - self._least_ns) / interval_ns))
        self._least_ns = settled_ns - n_lost * interval_ns
        self._before_ns -= n_lost * interval_ns
        return n_lost

    def _learn(self, arrived_ns: int, count: int | None, n_lost: int) -> None:
        newest = self._first[-1][1] if self._first else self._number
        number = newest + 1 + n_lost
        if count is not None and self._bits is not None and self._first:
            number = unwrap(count, self._bits, newest + 1)
        elif count is not None:
            number = count
        self._first.append((arrived_ns, number))
        if len(self._first) < 2 * _HALF:
            return
        before_ns, measured_ns = self._measured_ns, self._measured()
        self._measured_ns = measured_ns
        del self._first[:_HALF]
        if measured_ns is None:
            return
        # Two measurements in a row must agree: a burst at the start looks like a high rate.
        near_ns, far_ns = sorted((measured_ns, before_ns or math.inf))
        if far_ns > _AGREED * near_ns and self._bursts < _BURSTS:
            self._bursts += 1
            return
        # Crystals are within a fraction of a per cent of a rate that the maker names: that one is exact.
        near = (1e9 / rate_hz for rate_hz in self._rates_hz)
        known = (each for each in near if _KNOWN[0] * each <= measured_ns < _KNOWN[1] * each)
        self.interval_ns = next(known, measured_ns)
        if self._stamped is None:
            self._number = number
        else:
            self._stamped = self._number, arrived_ns - self._delay_ns
        self._first, self._bursts, self._measured_ns = [], 0, None

    def _measured(self) -> float | None:
        """Return the interval between both halves; None where they are seen to have come in bursts."""
        pairs = zip(self._first[:_HALF], self._first[_HALF:], strict=True)
        spans = sorted((late - early) / max(b - a, 1) for (early, a), (late, b) in pairs)
        # Quartiles, as single packets may be late.
        lower_ns, upper_ns = spans[_HALF // 4], spans[3 * _HALF // 4]
        if lower_ns < max(_SHORTEST_NS, _KNOWN[0] * 1e9 / max(self._rates_hz, default=math.inf)):
            return None
        if upper_ns > _EVEN * lower_ns and self._bursts < _BURSTS:
            self._bursts += 1
            return None
        return lower_ns
