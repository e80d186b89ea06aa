"""One module's clock, estimated while the capture runs from its stamps and their arrival times."""

from __future__ import annotations

import numpy as np

from gateway.clocks.batching import LinkBatching
from gateway.clocks.clock_kernels import UNUSUAL, follow_usual
from gateway.clocks.counter import Counter32
from gateway.clocks.delay_floor import CRYSTAL, REMEMBERED, TRANSPORT, DelayFloor
from gateway.clocks.module_clock import CLOCK, ESTIMATED, MICROSECOND_NS, MOST_PACKETS, ClockFigures
from gateway.frames import FloatArray
from gateway.support.rows import Memory, Row, fields_of, part

_FIRST_BLOCK_US = 50_000
_BLOCK_US = 1_000_000
_SLEW_PPM = 500.0
_FIRST_SLEW_PPM = 20_000.0
_SETTLING_US = 10_000_000
_OPENING_US = 5_000_000
_STEP_US = 50_000.0
"""An estimate that is off by more is adopted at once: slewing would take too long."""
_IN_STEP = 0.02
_SLOT_NEWS = 0.2
_UNREST_GAIN, _UNREST_SIGMAS = 0.5, 2.0
"""A rate that still moves from block to block is not as well known as its covariance has it: delays that come
in bursts are less independent than the estimate takes them for."""
_RESTARTED_RATE_SIGMA_PPM = 2.0  # the same crystal
_FADE_US = 1_000_000.0
_BOUND_SIGMAS = 3.0


class EstimatedClock(Row):
    """Offset and rate by the lower envelope of the delays (see ``floor_filter``), published without jumps.

    What a stamp is turned into depends on nothing that came after it. Between blocks the instants follow
    the line of the last block; its correction is spread out (slewed), so that instants of advancing stamps
    never run backwards, and no instant lies after its arrival.

    In the first seconds (the opening) every block ends with all packets so far being taken in together, anew:
    block by block, what a few of them seemed to show would be believed.

    Arrivals alone leave the constant part of the delay in the offset. Two-way exchanges
    (``add_exchange``) take it out: the least delays of the way there and of the way back enclose the
    offset, and it lies in their middle where the two ways are alike.
    """

    layout = CLOCK
    _fields_ = fields_of(CLOCK)
    _kind: int
    _start_us: int
    _start_ns: int
    _expected_us: int
    _fit_us: int
    _offset_us: float
    _rate: float
    _correction_us: float
    _fade_us: float
    _clamped_us: int
    _clamped_ns: int
    _block_end_us: int
    _packets: int

    def __init__(
        self,
        batching: LinkBatching | None = None,
        *,
        memory: Memory | None = None,
        is_compiled: bool = True,
    ) -> None:
        """Begin without a stamp.

        batching: of the link; None: a link that hands over what it has at once.
        memory: a zeroed ``CLOCK`` where compiled code shares the state.
        is_compiled: whether a kernel takes the usual stamps; if not, Python takes all, to the same result.
        """
        self._kind = ESTIMATED
        self._rows = self.memory.view(CLOCK)
        self._elapsed = part(self.memory, CLOCK, "elapsed_us").view(np.int64)
        self._delays = part(self.memory, CLOCK, "delays_us").view(np.float64)
        self._is_compiled = is_compiled
        self._batching = batching or LinkBatching()
        self._counter = Counter32(memory=part(self.memory, CLOCK, "counter"))
        self._back = DelayFloor(CRYSTAL)  # module to host: every packet
        self._round_trip = DelayFloor(TRANSPORT)  # exchanges only; by the clock of the way back
        self._steps = 0
        self._unrest_ppm = 0.0
        self._previous_slot_us = self._batching.slot_us
        self._begin(0, 0)

    def _begin(self, stamp_us: int, arrived_ns: int) -> None:
        """Count elapsed and arrival time from here. A rate found before is a good first guess."""
        self._start_us, self._start_ns = stamp_us, arrived_ns
        self._expected_us = stamp_us
        is_sure = self._back.packets >= REMEMBERED
        self._back.begin(_RESTARTED_RATE_SIGMA_PPM if is_sure else CRYSTAL.rate_sigma_ppm)
        self._round_trip.rebase()
        self._is_opening = True
        self._packets = 0
        self._exchanges: list[tuple[int, float]] = []
        self._block_us = _FIRST_BLOCK_US
        self._block_end_us = _FIRST_BLOCK_US
        self._fit_us, self._offset_us, self._rate = 0, 0.0, self._back.rate_ppm * 1e-6
        self._correction_us, self._fade_us = 0.0, _FADE_US
        self._clamped_us, self._clamped_ns = 0, arrived_ns

    @property
    def restarts(self) -> int:
        """How often the module's counter began anew."""
        return self._counter.restarts

    def gateway_time(self, module_time_us: int, arrived_ns: int) -> int:
        """Return the gateway time, ns, of a 32-bit stamp that arrived at ``arrived_ns``."""
        if self._is_compiled:
            time_ns = follow_usual(self._rows, module_time_us, arrived_ns)
            if time_ns != UNUSUAL:
                return time_ns

        since_ns = arrived_ns - self._start_ns
        full_us = self._counter.full_us(module_time_us, self._expected_us + since_ns // 1000, arrived_ns)
        if full_us is None:
            self._begin(module_time_us, arrived_ns)
            full_us, since_ns = module_time_us, 0
        elapsed_us, packets = full_us - self._start_us, self._packets
        self._elapsed[packets] = elapsed_us
        self._delays[packets] = since_ns * 1e-3 - elapsed_us
        self._packets = packets + 1

        if elapsed_us >= self._block_end_us or packets >= MOST_PACKETS:
            self._close_block(elapsed_us)
        since_fit_us = elapsed_us - self._fit_us
        offset_us = self._offset_us + self._rate * since_fit_us
        # After a new fit the offset moves over gradually: a step would look like motion.
        if self._correction_us and since_fit_us < self._fade_us:
            offset_us += self._correction_us * (1.0 - since_fit_us / self._fade_us)
        time_ns = self._start_ns + elapsed_us * 1000 + int(offset_us * 1000.0)
        return time_ns if time_ns <= arrived_ns else self._clamped(elapsed_us, arrived_ns)

    def _clamped(self, elapsed_us: int, arrived_ns: int) -> int:
        """Return an instant, ns, no later than the arrival and later than that of every earlier stamp."""
        if elapsed_us <= self._clamped_us:
            return arrived_ns
        self._clamped_us, self._clamped_ns = elapsed_us, max(arrived_ns, self._clamped_ns + 1)
        return self._clamped_ns

    def add_exchange(self, sent_ns: int, received_us: int, replied_us: int, arrived_ns: int) -> None:
        """Take in a two-way exchange: gateway time sent, module stamps received and replied, and arrival."""
        restarts = self.restarts
        self.gateway_time(replied_us, arrived_ns)
        if self.restarts == restarts:
            packets = self._packets
            newest_us = int(self._elapsed[packets - 1]) if packets else self._fit_us
            elapsed_us = newest_us - (replied_us - received_us) % 2**32
            self._exchanges.append((elapsed_us, elapsed_us - (sent_ns - self._start_ns) * 1e-3))

    def instant_ns(self, full_us: int) -> int:
        """Return the gateway time, ns, of a full count, by what is known now."""
        elapsed_us = full_us - self._start_us
        return self._start_ns + elapsed_us * 1000 + int(_published_us(self._line, elapsed_us) * 1000.0)

    def count_us(self, time_ns: int) -> float:
        """Return the full count at a gateway time, by what is known now."""
        since_us, line = (time_ns - self._start_ns) * 1e-3, self._line
        # two steps: the offset changes by a small part of the change in time
        elapsed_us = since_us - _published_us(line, round(since_us))
        elapsed_us = since_us - _published_us(line, round(elapsed_us))
        return self._start_us + elapsed_us

    def forget(self) -> None:
        """Start anew at the next stamp, but keep the estimated rate."""
        self._counter.forget()

    @property
    def newest_us(self) -> int:
        """The largest full count heard since the last start."""
        return self._counter.newest_us or 0

    @property
    def _line(self) -> _Line:
        return self._fit_us, self._offset_us, self._rate, self._correction_us, self._fade_us

    def _close_block(self, newest_us: int) -> None:
        """Take the packets since the last block into the estimate, and plan how to follow it."""
        newest_us = max(newest_us, self._fit_us)
        is_first = not self._back.is_known
        packets = self._packets
        elapsed_s = (self._elapsed[:packets].astype(np.float64) - newest_us) * 1e-6
        if self._is_opening:
            self._back.take_back(forgets_delays=self._slot_is_news())
            self._round_trip.take_back()
        self._back.update(newest_us, elapsed_s, self._delays[:packets], self._slot_us(elapsed_s))
        if self._exchanges:
            received = np.array(self._exchanges)  # (n, 2): module time, delay of the way there
            since_s = (received[:, 0] - newest_us) * 1e-6
            trips_us = received[:, 1] + self._back.offset_us(newest_us) + self._back.rate_ppm * since_s
            self._round_trip.update(newest_us, since_s, trips_us, 0.0)
        self._follow(newest_us, is_first)
        if newest_us >= _OPENING_US or packets >= MOST_PACKETS:
            self._is_opening = False
        if not self._is_opening:
            self._packets, self._exchanges = 0, []
        self._block_us = min(2 * self._block_us, _BLOCK_US)
        self._block_end_us = newest_us + self._block_us

    def _follow(self, newest_us: int, is_first: bool) -> None:
        """Take the new line as the one to publish; what it differs by now fades away at a bounded rate."""
        published_us = _published_us(self._line, newest_us)
        moved_ppm = abs(self._back.rate_ppm - self._rate * 1e6)
        self._unrest_ppm += _UNREST_GAIN * (moved_ppm - self._unrest_ppm)
        offset_us, rate_ppm = self._back.offset_us(newest_us), self._back.rate_ppm
        if self._round_trip.is_known:
            offset_us -= 0.5 * self._round_trip.offset_us(newest_us)
        correction_us = published_us - offset_us
        # Too far off to fade in reasonable time: a step, which is counted.
        if abs(correction_us) > _STEP_US:
            self._steps += not is_first
            correction_us = 0.0
        slew_ppm = _FIRST_SLEW_PPM if newest_us < _SETTLING_US else _SLEW_PPM
        self._correction_us = correction_us
        self._fade_us = max(_FADE_US, abs(correction_us) / (slew_ppm * 1e-6))
        self._fit_us, self._offset_us, self._rate = newest_us, offset_us, rate_ppm * 1e-6
        self._expected_us = self._start_us - int(offset_us)

    def _slot_is_news(self) -> bool:
        """Return whether the link turned out to hand over otherwise than was believed until now."""
        before_us, self._previous_slot_us = self._previous_slot_us, self._batching.slot_us
        return abs(self._previous_slot_us - before_us) > _SLOT_NEWS * max(self._previous_slot_us, before_us)

    def _slot_us(self, elapsed_s: FloatArray) -> float:
        """Return the link's slot, unless the module samples in step with it: then it has no information.

        Exchanges are in step with nothing, and where in its slot a module samples is known by them.
        """
        slot_us = self._batching.slot_us
        if slot_us and len(elapsed_s) > 1 and not self._exchanges:
            intervals = np.sort(np.diff(elapsed_s))
            samples = slot_us * 1e-6 / max(float(intervals[len(intervals) // 2]), 1e-6)
            if round(samples) >= 1 and abs(samples - round(samples)) < _IN_STEP:
                return 0.0
        return slot_us

    def figures(self) -> ClockFigures:
        """Return offset, rate and their uncertainty at the newest sample."""
        newest_us = self.newest_us - self._start_us
        back, round_trip, bound_us = self._back, self._round_trip, None
        sigma_us = back.sigma_us if back.is_known else 0.0
        if round_trip.is_known:
            # Half of the round trip is the delay of one way, so half of its uncertainty counts.
            sigma_us = float(np.hypot(sigma_us, 0.5 * round_trip.sigma_us))
            bound_us = 0.5 * round_trip.offset_us(newest_us) + _BOUND_SIGMAS * sigma_us
        published_ns = round(_published_us(self._line, newest_us) * 1e3)
        return ClockFigures(
            offset_ns=self._start_ns - self._start_us * MICROSECOND_NS + published_ns,
            skew_ppm=(1.0 / (1.0 + self._rate) - 1.0) * 1e6,
            residual_us=back.residual_us,
            sigma_us=sigma_us,
            bound_us=bound_us,
            steps=self._steps,
            rate_sigma_ppm=float(np.hypot(back.rate_sigma_ppm, _UNREST_SIGMAS * self._unrest_ppm)),
        )


_Line = tuple[int, float, float, float, float]
"""What is published, as the state has it: fit, offset, rate, correction, fade."""


def _published_us(line: _Line, elapsed_us: int) -> float:
    fit_us, offset_us, rate, correction_us, fade_us = line
    since_fit_us = elapsed_us - fit_us
    fading = max(0.0, 1.0 - since_fit_us / fade_us)
    return offset_us + rate * since_fit_us + correction_us * fading
