"""How a device sends: under an id, by its clock, with a count for every kind. Sans-I/O.

A device knows only its own clock: "elapsed" is seconds since it was switched on, by that clock.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from devices.emulators.imperfections import ModuleClock
from firmware_protocol import Packet, WireFrame, encode_packet


class Timed(NamedTuple):
    """A wire frame and the true time at which it is handed to the radio, s."""

    time_s: float
    frame: WireFrame


class Sender:
    """An id, a clock, and a sequence for every kind of wire frame."""

    def __init__(self, module: int, clock: ModuleClock, sequences: Counter[int] | None = None) -> None:
        """Send as ``module``; ``sequences`` are those of a sender with another id that this one replaces."""
        self.module = module
        self.clock = clock
        self.sequences: Counter[int] = Counter() if sequences is None else sequences
        """Wire frames sent so far, by kind."""

    def frame(self, kind: int, elapsed: float, body: bytes) -> Timed:
        """Return the next wire frame of this kind, stamped with the clock."""
        sequence = self.sequences[kind]
        self.sequences[kind] = sequence + 1
        return self.numbered(kind, elapsed, body, sequence % 2**16)

    def numbered(self, kind: int, elapsed: float, body: bytes, sequence: int) -> Timed:
        """Return a wire frame under a sequence number that is not this sender's to choose."""
        wire_frame = WireFrame(kind, self.module, sequence, self.clock.count_us(elapsed), body)
        return Timed(self.clock.true_time(elapsed), wire_frame)

    def packet(self, packet: Packet, elapsed: float) -> Timed:
        """Return the next wire frame of this packet's kind."""
        return self.frame(packet.KIND, elapsed, encode_packet(packet))
