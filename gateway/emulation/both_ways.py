"""Two streams fed alike, with kernels and the readable way: whatever differs is an error."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from devices.link import Chunk, SentChunk
from firmware_protocol import Packet, ReceivedPacket
from gateway.frames import InertialBatch, Reading
from gateway.sources.suit import Listener, SuitSource


class BothWaysDiffer(AssertionError):
    """The two ways do not give the same."""


class BothWays:
    """Takes what a stream takes. Raises ``BothWaysDiffer`` where kernels give another result, to the bit."""

    def __init__(self, make: Callable[[bool], SuitSource]) -> None:
        """Make two streams; ``make`` returns one with kernels for True, without for False."""
        self.compiled, self.readable = make(True), make(False)
        self._streams = self.compiled, self.readable
        self._packets: list[list[tuple[ReceivedPacket, int]]] = [[], []]

    def add_link(self, name: str, content: str) -> None:
        """Announce a link, before its first chunk."""
        for stream in self._streams:
            stream.add_link(name, content)

    def listen(self, packet_class: type[Packet]) -> None:
        """Call a listener with packets of a class; its calls are compared too."""
        for stream, packets in zip(self._streams, self._packets, strict=True):
            stream.listen(packet_class, _noting(packets))

    def sent(self, chunk: SentChunk) -> None:
        """Pass what left to both."""
        for stream in self._streams:
            stream.sent(chunk)

    def receive(self, chunk: Chunk) -> list[Reading]:
        """Return the readings that a chunk completes, and compare them."""
        found, expected = (stream.receive(chunk) for stream in self._streams)
        if _plain(found) != _plain(expected):
            raise BothWaysDiffer(f"readings of {chunk}: {found}, the readable way {expected}")
        if self._packets[0] != self._packets[1]:
            raise BothWaysDiffer(f"listeners at {chunk}: {self._packets}")
        for packets in self._packets:
            packets.clear()
        return found

    def compare_accounts(self) -> None:
        """Compare all that is counted and known beside the readings."""
        found, expected = (accounts(stream) for stream in self._streams)
        for name, account in expected.items():
            if found[name] != account:
                raise BothWaysDiffer(f"{name}: {found[name]}, the readable way {account}")


def _noting(packets: list[tuple[ReceivedPacket, int]]) -> Listener:
    return lambda packet, chunk: packets.append((packet, chunk.arrived_ns))


def accounts(stream: SuitSource) -> dict[str, Any]:
    """Return all that a stream has counted, and knows of its modules and links."""
    table = stream.table
    return {
        "dropped": stream.dropped(),
        "balances": [*stream.balances(), *table.balances()],
        "statistics": stream.statistics(),
        "modules": table.statistics(),
        "restless": table.restless(),
        "sequences": {
            (module, kind): (counter.received, counter.lost_by, counter.duplicates, counter.gaps)
            for module, record in table.records.items()
            for kind, counter in record.sequences.items()
        },
        "figures": {module: record.clock.figures() for module, record in table.records.items()},
        "arrivals": {m: (r.first_arrival_ns, r.last_arrival_ns) for m, r in table.records.items()},
        "restarted": {module: list(record.restarted_ns) for module, record in table.records.items()},
        "senders": stream.sender_statistics(),
        "links": [(d.accepted, d.strange_chunks, d.is_trusted, d.is_damaged) for d in stream.decoders()],
    }


def _plain(readings: Sequence[Reading]) -> list[object]:
    """Return readings as values that are equal when all bits are."""
    return [_fields_of(reading) for reading in readings]


def _fields_of(reading: Reading) -> tuple[object, ...]:
    if isinstance(reading, InertialBatch):
        samples = reading.samples
        assert samples.dtype.names is not None
        return ("batch", *((name, samples[name].tobytes()) for name in samples.dtype.names))
    values = (getattr(reading, field.name) for field in dataclasses.fields(reading))
    return (type(reading), *(v.tobytes() if isinstance(v, np.ndarray) else v for v in values))
