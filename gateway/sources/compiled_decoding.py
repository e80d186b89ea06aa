"""Packets out of the bytes of a link by kernels, as ``PacketDecoder`` gives them, and samples of these."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from devices.link import Chunk, Framing
from firmware_protocol import Defect, FrameDecoder, PacketDecoder, ReceivedPacket
from firmware_protocol.can_framing import MAX_PARTIAL_FRAMES
from gateway.geometry.compiled import for_types_of
from gateway.sources.can_kernels import Unfinished, decode_records
from gateway.sources.module_rows import SHARED_KINDS
from gateway.sources.module_table import ModuleTable
from gateway.sources.readings import ReadingCollector
from gateway.sources.wire_kernels import Room, decode_stream, follow
from gateway.sources.wire_layout import (
    CARRIED,
    DECODER,
    DEFECTS,
    ENTRY,
    ENTRY_SIZE,
    EVENT,
    N_STREAMS,
    PARTIAL,
    READABLE,
    SAMPLE,
    TICK,
    UNKNOWN,
    treatments,
)
from gateway.support.rows import Row, fields_of

_FIRST_BYTES = 4096


class Entries:
    """The packets of the chunk in hand: those of samples as kernels left them, others as they are.

    One serves all links of a stream: what it holds is gone with the next chunk.
    """

    def __init__(self) -> None:
        self._treatments = treatments()
        self.n = 0
        """Entries in use."""
        self.packets: dict[int, ReceivedPacket] = {}
        """Those that Python decoded, by their place."""
        self._dropped = 0
        self._decoder = PacketDecoder(FrameDecoder())
        self.fit(_FIRST_BYTES)

    def __len__(self) -> int:
        """Return the number of packets."""
        return self.n - self._dropped

    def fit(self, n_bytes: int) -> None:
        """Make room for whatever so many bytes can hold."""
        self.n_bytes = n_bytes
        raw = np.zeros(n_bytes + CARRIED, np.uint8)
        # No more entries fit than the smallest ones would.
        most = len(raw) // ENTRY_SIZE + 1
        self.room = Room(self._treatments, np.zeros(most, ENTRY), np.zeros(most, np.int64), raw)
        self._numbers = self.room.entries.view(np.int64).reshape(most, -1)
        self.events = np.zeros(2 * most, EVENT)

    def leave_samples(self, kind: int, are_left: bool) -> None:
        """Leave samples of a kind to Python, or take them again."""
        self._treatments[kind] = READABLE if are_left else SAMPLE + SHARED_KINDS[kind]

    def begin(self, n: int, n_left: int, decoder: PacketDecoder) -> None:
        """Take what a kernel has found; have ``decoder`` decode what it left to Python."""
        self.n, self._dropped, self._decoder = n, 0, decoder
        if self.packets:
            self.packets = {}
        if n_left:
            for place in self.room.left[:n_left].tolist():
                packet = self._decoded(place)
                if packet is None:
                    self.room.entries[place]["how"] = UNKNOWN
                    self._dropped += 1
                else:
                    self.packets[place] = packet

    def packet(self, place: int) -> ReceivedPacket:
        """Return the packet of an entry, whether a kernel has read it or not."""
        packet = self.packets.get(place) or self._decoded(place)
        assert packet is not None, "a kernel took what is no packet"
        return packet

    def _decoded(self, place: int) -> ReceivedPacket | None:
        _, kind, module, sequence, module_time_us, relayed_us, start, stop = self._numbers[place].tolist()
        entry = kind, module, sequence, module_time_us, self.room.raw[start:stop].tobytes()
        return self._decoder.decode(entry, None if relayed_us < 0 else relayed_us)


class CompiledDecoder(Row):
    """Takes a stream of bytes apart in compiled code. ``feed`` never raises; what is dropped is counted."""

    layout = DECODER
    _fields_ = fields_of(DECODER)
    _damaged: int
    _n_left: int

    def __init__(self, entries: Entries) -> None:
        """Decode into ``entries``, which other decoders may share."""
        self._row = self.memory.view(DECODER)
        self._entries = entries
        self._kernel: Callable[..., Any] = self._compile()
        self._partial = b""
        self._others = PacketDecoder(FrameDecoder())

    @property
    def dropped(self) -> Counter[Defect]:
        """What was dropped by reason."""
        counts = zip(DEFECTS, self._row["dropped"][0].tolist(), strict=True)
        return Counter({defect: count for defect, count in counts if count}) + self._others.dropped

    @property
    def damaged(self) -> int:
        """How many drops there were that packets of ours may have been lost in."""
        return self._damaged + self._others.damaged

    def feed(self, chunk: bytes) -> Entries:
        """Return the packets that this chunk completes, in order; they stand until something else is fed."""
        entries, data = self._entries, self._partial + chunk if self._partial else bytes(chunk)
        if len(data) > entries.n_bytes:
            entries.fit(2 * len(data))
        entries.begin(self._decode(data), self._n_left, self._others)
        return entries

    def _compile(self) -> Callable[..., Any]:
        """Return the kernel that takes bytes apart, compiled now and not when the first packets wait."""
        return for_types_of(decode_stream, b"", self._row, self._entries.room)

    def _decode(self, data: bytes) -> int:
        """Have the kernel take bytes apart; return the number of entries."""
        used, n = self._kernel(data, self._row, self._entries.room)
        self._partial = data[used:]
        return int(n)


class CompiledCanDecoder(CompiledDecoder):
    """The same of CAN records; a chunk is a run of whole ones."""

    def __init__(self, entries: Entries) -> None:
        """Decode into ``entries``, which other decoders may share."""
        self._unfinished = Unfinished(np.zeros(MAX_PARTIAL_FRAMES, PARTIAL), np.zeros(N_STREAMS, np.int64))
        super().__init__(entries)

    def _compile(self) -> Callable[..., Any]:
        return for_types_of(decode_records, b"", self._row, self._unfinished, self._entries.room)

    def _decode(self, data: bytes) -> int:
        return int(self._kernel(data, self._row, self._unfinished, self._entries.room))


DECODERS: Mapping[Framing, type[CompiledDecoder]] = {
    Framing.BYTE_STREAM: CompiledDecoder,
    Framing.CAN: CompiledCanDecoder,
}


class Follower:
    """Turns the samples among the packets of a chunk into rows of a batch, by kernels."""

    def __init__(self, table: ModuleTable, readings: ReadingCollector) -> None:
        """Follow the clocks of ``table``, and put samples into ``readings``."""
        self._table = table
        self._readings = readings
        self._follow = follow

    def warm_up(self, entries: Entries) -> None:
        """Compile the kernel now, not when the first packets wait."""
        self._follow = for_types_of(
            follow, 0, 0, 0, 0, entries.room, self._table.rows, self._readings.rows, 0, entries.events
        )  # fmt: skip

    def others(self, entries: Entries, chunk: Chunk) -> Iterator[ReceivedPacket]:
        """Take the samples that are as usual; yield, in its place among them, each packet that is not."""
        table, readings, at, n = self._table, self._readings, 0, entries.n
        while at < n:
            if at not in entries.packets:
                at, readings.n_rows, n_events = self._follow(
                    at, n, chunk.arrived_ns, table.losses(chunk.link).chunk, entries.room, table.rows,
                    readings.rows, readings.n_rows, entries.events,
                )  # fmt: skip
                if n_events:
                    self._note(entries.events[:n_events], chunk.link)
            if at < n:
                yield entries.packet(at)
                at += 1

    def _note(self, events: NDArray[np.void], link: str) -> None:
        """Note what kernels have left to be noted. events: (n,) EVENT."""
        for what, module, kind, first, full, received_in in events.tolist():
            if what == TICK:
                self._table.relayed(link, first)
            else:
                self._table.missed(link, module, kind, first, full, received_in)
