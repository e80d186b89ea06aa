"""What is counted of every module, and why samples were lost on their way: by what happened on the link
between the packets around the gap."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum

from firmware_protocol import DeviceInfo, Health
from gateway.clocks import ModuleClock, unwrap
from gateway.sources.module_rows import MODULE, SEQUENCE, SHARED_KINDS
from gateway.support.rows import Memory, Row, fields_of, memory_of, part


class Cause(Enum):
    """The likeliest first: what was found out later wins only where nothing before it fits."""

    LINK_DOWN = "the link was lost in between"
    OVERRUN = "bytes, frames or datagrams were lost for want of room (see the link's counts)"
    DAMAGED = "damaged wire frames were dropped in between"
    UNSEEN = "nothing was seen of them: lost in the suit, on the air or on the network"


class LinkLosses:
    """What has happened on one link, by the chunk in which it was noticed."""

    def __init__(self) -> None:
        self.chunk = 0
        """Number of the chunk in hand."""
        self._noticed: dict[Cause, int] = {}

    def notice(self, cause: Cause) -> None:
        """Note a cause of losses that came before, or in, the chunk in hand."""
        self._noticed[cause] = self.chunk

    def cause_since(self, chunk: int) -> Cause:
        """Return why packets are missing after one that came in ``chunk``."""
        # The order of ``Cause`` is the order of precedence where several happened.
        for cause in Cause:
            if self._noticed.get(cause, -1) >= chunk:
                return cause
        return Cause.UNSEEN


SEQUENCE_BITS = 16
MANY_RESTARTS, RESTLESS_NS = 3, 10_000_000_000
"""A module that loses its power begins anew once; one that does so that often in that time is ill."""
_REMEMBERED = 256
"""How far back a packet may be overtaken and still be told from a duplicate."""
_GAP_NAMES = ("1", "2", *(f"{2**k + 1}-{2 ** (k + 1)}" for k in range(1, 8)), "more")


@dataclass(slots=True)
class _Gap:
    """Numbers ``first`` to ``last`` that have not come, forgotten before ``known_from``."""

    first: int
    last: int
    cause: Cause
    known_from: int

    @property
    def length(self) -> int:
        return self.last - self.first + 1

    @property
    def known(self) -> int:
        """How many of its numbers would be taken for overtaken ones, should they come."""
        return self.last - self.known_from + 1


class SequenceCounter(Row):
    """Unwraps the 16-bit sequence of one kind of packet of one module; finds losses and duplicates.

    Numbers are untrusted: what a packet costs does not depend on how far its number jumps.
    """

    layout = SEQUENCE
    _fields_ = fields_of(SEQUENCE, "received")
    received: int
    _newest: int
    _first: int
    _shift: int
    _goes_on: int
    _received_in: int

    def __init__(self, *, memory: Memory | None = None) -> None:
        """Begin without packets; ``memory`` is a zeroed ``SEQUENCE`` where compiled code shares the state."""
        self.lost_by: Counter[Cause] = Counter()
        """Packets that have not come, by what may have befallen them."""
        self.duplicates = 0
        self.gaps = [0] * len(_GAP_NAMES)
        """How often so many packets were lost in a row, in the order of ``_GAP_NAMES``."""
        self._newest = -1
        self._open: list[_Gap] = []  # in order of their numbers
        self._known = 0  # sum of ``known`` of the open gaps

    @property
    def lost(self) -> int:
        """Packets that have not come."""
        return self.lost_by.total()

    @property
    def numbered(self) -> int:
        """Packets that were sent, by their numbers, from the first that was heard to the newest."""
        return self._newest - self._first + 1

    def count(self, sequence: int, link: LinkLosses) -> int | None:
        """Return the unwrapped sequence number; None for a packet received before. link: the one it came
        over."""
        if not self._goes_on:
            self._shift = sequence - (self._newest + 1)
            self._goes_on = True
        # Nearest to the number that is due: one that was overtaken is not taken for one of the next turn.
        return self._take(unwrap(sequence - self._shift, SEQUENCE_BITS, self._newest + 1), link)

    def count_unwrapped(self, full: int, link: LinkLosses) -> int | None:
        """Return the same for a number that is unwrapped already."""
        if not self._goes_on:
            # A new run of the sender may count from below: our numbers never go back.
            begin = max(self._newest, full - 1)
            self._first += begin - self._newest
            self._newest = begin
            self._goes_on = True
        return self._take(full, link)

    def _take(self, full: int, link: LinkLosses) -> int | None:
        if full <= self._newest:
            return self._overtaken(full)
        if full > self._newest + 1:
            self.open_gap(self._newest + 1, full, link.cause_since(self._received_in))
        self._newest = full
        self._received_in = link.chunk
        self.received += 1
        return full

    def open_gap(self, first: int, full: int, cause: Cause) -> None:
        """Note all numbers from ``first`` on as lost, up to ``full``, which came; forget the oldest known."""
        gap = _Gap(first, full - 1, cause, max(first, full - _REMEMBERED))
        self.lost_by[cause] += gap.length
        self.gaps[_order(gap.length)] += 1
        self._open.append(gap)
        self._known += gap.known
        # What a gap lost stays counted; only whether a number of it still comes is no longer looked at.
        while self._known > _REMEMBERED:
            oldest = self._open[0]
            forgotten = min(oldest.known, self._known - _REMEMBERED)
            oldest.known_from += forgotten
            self._known -= forgotten
            if not oldest.known:
                del self._open[0]

    def _overtaken(self, full: int) -> int | None:
        place = bisect_right(self._open, full, key=_first_of) - 1
        gap = self._open[place] if place >= 0 else None
        if gap is None or not gap.known_from <= full <= gap.last:
            self.duplicates += 1
            return None
        # The number came after all: its gap becomes the two parts before and after it.
        self.gaps[_order(gap.length)] -= 1
        before = _Gap(gap.first, full - 1, gap.cause, gap.known_from)
        after = _Gap(full + 1, gap.last, gap.cause, full + 1)
        for rest in (before, after):
            if rest.length:
                self.gaps[_order(rest.length)] += 1
        self._open[place : place + 1] = [rest for rest in (before, after) if rest.known]
        self._known -= 1
        self.lost_by[gap.cause] -= 1
        self.received += 1
        return full

    def restart(self) -> None:
        """Accept any number next, without a gap: the module counts from anew."""
        self._goes_on = False


def _first_of(gap: _Gap) -> int:
    return gap.first


def _order(length: int) -> int:
    """Place in ``_GAP_NAMES`` of so many lost in a row."""
    return min((length - 1).bit_length(), len(_GAP_NAMES) - 1)


class ModuleRecord(Row):
    """All that is known of a module (or local measuring device) on the air."""

    layout = MODULE
    _fields_ = fields_of(MODULE, "last_arrival_ns")
    last_arrival_ns: int

    def __init__(
        self,
        module: int,
        clock: ModuleClock,
        first_arrival_ns: int = 0,
        *,
        memory: Memory | None = None,
    ) -> None:
        """Begin the record of a module; ``memory`` is a zeroed ``MODULE`` where compiled code shares the
        state.
        """
        self.module = module
        self.clock = clock
        self.first_arrival_ns = first_arrival_ns
        self.sequences: dict[int, SequenceCounter] = {}
        """By kind of packet."""
        self.info: DeviceInfo | None = None
        self.health: Health | None = None
        self.restarted_ns: deque[int] = deque(maxlen=MANY_RESTARTS)
        """When its clock was found to begin anew, the last times."""
        self._shared = part(self.memory, MODULE, "sequences").view(SEQUENCE)

    def counter(self, kind: int) -> SequenceCounter:
        """Return the counter of a kind of packet, a new one at first."""
        counter = self.sequences.get(kind)
        if counter is None:
            place = SHARED_KINDS.get(kind)
            memory = None if place is None else memory_of(self._shared, place)
            counter = self.sequences[kind] = SequenceCounter(memory=memory)
        return counter

    @property
    def restlessness(self) -> str | None:
        """What to say of a clock that begins anew again and again; None: it does not."""
        if len(self.restarted_ns) < MANY_RESTARTS:
            return None
        if self.last_arrival_ns - self.restarted_ns[0] > RESTLESS_NS:
            return None
        return (
            f"module {self.module} began its clock anew {MANY_RESTARTS} times or more within "
            f"{RESTLESS_NS // 10**9} s, {self.clock.restarts} times in all: check its battery and plug, and "
            "that nobody else sends under its number"
        )

    @property
    def received(self) -> int:
        """Packets that came, of all kinds."""
        return sum(counter.received for counter in self.sequences.values())

    @property
    def lost(self) -> int:
        """Packets that did not come, of all kinds."""
        return sum(counter.lost for counter in self.sequences.values())

    @property
    def lost_by(self) -> dict[str, int]:
        """Lost packets by cause (``Cause``)."""
        return {
            cause.name.lower(): sum(counter.lost_by[cause] for counter in self.sequences.values())
            for cause in Cause
        }

    @property
    def duplicates(self) -> int:
        """Packets that came more than once, of all kinds."""
        return sum(counter.duplicates for counter in self.sequences.values())

    @property
    def gap_histogram(self) -> dict[str, int]:
        """How often packets were lost in a row, by how many: ``1``, ``2``, ``3-4``, ``5-8``, …"""
        counts = [counter.gaps for counter in self.sequences.values()]
        sums = {name: sum(count) for name, *count in zip(_GAP_NAMES, *counts, strict=True)}
        return {name: count for name, count in sums.items() if count}

    def summary(self) -> dict[str, object]:
        """Return the counters and clock figures as plain names and values, for the health message."""
        figures = self.clock.figures()
        summary: dict[str, object] = {
            "received": self.received,
            "lost": self.lost,
            "lost_by": self.lost_by,
            "duplicates": self.duplicates,
            "gaps": self.gap_histogram,
            "restarts": self.clock.restarts,
            "offset_ns": figures.offset_ns,
            "clock_ppm": round(figures.skew_ppm, 2),
            "residual_us": round(figures.residual_us, 1),
            "clock_sigma_us": round(figures.sigma_us, 1),
            "clock_steps": figures.steps,
            "last_arrival_ns": self.last_arrival_ns,
        }
        if figures.bound_us is not None:
            summary["clock_bound_us"] = round(figures.bound_us, 1)
        if self.health is not None:
            summary["battery_percent"] = self.health.battery_percent
            summary["temperature_celsius"] = self.health.temperature_celsius
            summary["rssi_dbm"] = self.health.rssi_dbm
        if self.info is not None:
            summary["unique_id"] = self.info.unique_id.hex()
            summary["firmware_version"] = ".".join(map(str, self.info.firmware_version))
        return summary
