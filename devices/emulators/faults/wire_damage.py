"""Good wire frames of every kind, drawn at random, and the ways a line, a bus and a driver damage them.

Each block of ``Traffic`` states what a receiver must hand out whatever surrounds it (``required``), and
all that it may hand out (``sent``): nothing else was ever said. All draws are seeded.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any

from firmware_protocol import (
    BROADCAST,
    FROM_HOST,
    PACKETS,
    RELAY,
    CanFrame,
    Kind,
    WireFrame,
    encode_frame,
    fragment,
    pack_can_records,
    relay_batch,
)
from firmware_protocol.fields import INTEGER_RANGE, WireField, layout_of

UNKNOWN_KIND = 0x77
_BODIES_OF_A_KIND = 32


class Source:
    """Wire frames of every kind, each with a module time of its own."""

    def __init__(self, rng: Random, largest: int) -> None:
        self._rng = rng
        self._time_us = 0
        self._bodies = [
            (kind, body)
            for kind in PACKETS
            for body in (_body(rng, kind) for _ in range(_BODIES_OF_A_KIND))
            if len(body) <= largest
        ]
        self._bodies += [(UNKNOWN_KIND, rng.randbytes(size)) for size in range(_BODIES_OF_A_KIND)]
        self._bodies += [
            (int(Kind.RELAY_BATCH), body)
            for body in (_batch_body(rng, self._bodies, size) for size in range(_BODIES_OF_A_KIND))
            if len(body) <= largest
        ]

    def frames(self, n: int) -> list[WireFrame]:
        """Return the next ``n`` frames."""
        rng, frames = self._rng, []
        for _ in range(n):
            kind, body = rng.choice(self._bodies)
            module = RELAY if kind == Kind.RELAY_BATCH else rng.randrange(64)
            if kind in FROM_HOST and rng.random() < 0.1:
                module = BROADCAST
            self._time_us += 1
            frames.append(WireFrame(kind, module, rng.randrange(65536), self._time_us, body))
        return frames


def _batch_body(rng: Random, bodies: Sequence[tuple[int, bytes]], size: int) -> bytes:
    entries = [
        WireFrame(kind, rng.randrange(64), rng.randrange(65536), rng.randrange(2**32), body)
        for kind, body in rng.choices(bodies, k=size)
    ]
    return relay_batch(entries, 0, 0).body


def _body(rng: Random, kind: int) -> bytes:
    """Return a body that is good: every value within its limits."""
    layout = layout_of(PACKETS[kind])
    mask = rng.choice(layout.valid_masks())
    elements: list[Any] = [mask] if layout.has_mask else []
    for declared in layout.present(mask):
        if not declared.is_rest:
            elements += _elements(rng, declared)
    body = struct.pack(layout.struct_format(mask), *elements)
    if layout.rest is None:
        return body
    size = rng.randint(layout.rest.min_size, layout.rest.max_size or 200)
    return body + (bytes(rng.choices(range(32, 127), k=size)) if layout.rest.is_text else rng.randbytes(size))


def _elements(rng: Random, declared: WireField) -> list[Any]:
    if declared.code == "s":
        return [rng.randbytes(declared.count)]
    if declared.meanings:
        return [rng.choice(list(declared.meanings))]
    if declared.code == "f":
        return [rng.uniform(0.0, 1e4) for _ in range(declared.count)]
    low, high = INTEGER_RANGE[declared.code]
    high = high if declared.maximum is None else int(declared.maximum)
    return [rng.choice((low, high, 0, rng.randint(low, high))) for _ in range(declared.count)]


BLOCK_SIZE = 256
"""Wire frames in one block."""
DAMAGED_SHARE = 0.3


@dataclass
class Traffic:
    """One block as a receiver gets it."""

    chunks: list[bytes] = field(default_factory=list)
    sent: dict[int, WireFrame] = field(default_factory=dict)
    """By module time, which no two wire frames of a campaign share."""
    required: Counter[int] = field(default_factory=Counter)
    """Module time of each wire frame that must come through, and how often."""
    n_damaged: int = 0


class ByteStream:
    """Blocks on a byte stream. Damage carries over from block to block, as on a line."""

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self._source = Source(rng, largest=4000)
        self._is_delimited = True  # the bytes so far end with a delimiter

    def block(self) -> Traffic:
        """Return the next block."""
        traffic, rng = Traffic(), self._rng
        frames = self._source.frames(BLOCK_SIZE)
        traffic.sent = {frame.module_time_us: frame for frame in frames}
        encoded = [encode_frame(frame) for frame in frames]
        stream: list[bytes] = []
        for place, data in enumerate(encoded):
            if rng.random() < DAMAGED_SHARE:
                traffic.n_damaged += 1
                whole = rng.choice(BYTE_DAMAGES)(rng, data, encoded[place - 1])
            else:
                whole = [data]
            for piece in whole:
                # A wire frame that follows a delimiter must come through, whatever came before that.
                if piece is data and self._is_delimited:
                    traffic.required[frames[place].module_time_us] += 1
                if piece:
                    self._is_delimited = piece[-1] == 0
                stream.append(piece)
        traffic.chunks = list(_chunks(rng, b"".join(stream)))
        return traffic


def _chunks(rng: Random, stream: bytes) -> list[bytes]:
    (largest,) = rng.choices((7, 64, 1024, 16384), (1, 6, 6, 6))
    chunks, at = [], 0
    while at < len(stream):
        size = rng.randint(1, largest)
        chunks.append(stream[at : at + size])
        at += size
    return chunks


def _cut(rng: Random, data: bytes) -> tuple[bytes, bytes]:
    place = rng.randrange(len(data))
    return data[:place], data[place:]


BYTE_DAMAGES: tuple[Callable[[Random, bytes, bytes], list[bytes]], ...] = (
    lambda rng, data, _: [turn_bits(rng, data, 0, len(data))],
    lambda rng, data, _: [_cut(rng, data)[0]],  # the delimiter is lost with the rest
    lambda rng, data, _: [_cut(rng, data)[1][1:]],
    lambda rng, data, other: [_cut(rng, data)[0], _cut(rng, other)[1]],
    lambda _, data, __: [data, data],
    lambda rng, data, other: [other, data],
    lambda rng, data, _: [rng.randbytes(rng.choice((1, 4, 40))).join(_cut(rng, data))],
    lambda rng, data, _: [rng.choice((rng.randbytes(10), rng.randbytes(5000), b"\xa5" * 5000)), data],
)
"""What comes of a stuffed wire frame and the one before it. What is ``data`` itself is undamaged."""


def turn_bits(rng: Random, data: bytes, start: int, stop: int) -> bytes:
    """Return ``data`` with one to eight bits flipped among the bytes from ``start`` to ``stop``."""
    turned = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8))):
        # Two flips of one bit are none: then draw again, as what is called damaged must be.
        turned[rng.randrange(start, stop)] ^= 1 << rng.randrange(8)
    return bytes(turned) if turned != data else turn_bits(rng, data, start, stop)


class CanBus:
    """Blocks on a CAN bus, classic and FD."""

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self._source = Source(rng, largest=245)

    def block(self) -> Traffic:
        """Return the next block."""
        traffic, rng = Traffic(), self._rng
        frames = self._source.frames(BLOCK_SIZE)
        traffic.sent = {frame.module_time_us: frame for frame in frames}
        records = [[pack_can_records([piece]) for piece in fragment(f, rng.random() < 0.5)] for f in frames]
        at = 0
        while at < BLOCK_SIZE:
            end = min(at + rng.randint(1, 40), BLOCK_SIZE)
            chunk, intact = self._chunk(frames[at:end], records[at:end], traffic)
            if chunk and rng.random() < 0.05:  # all of it may have been lost
                traffic.n_damaged += 1
                cut = rng.randrange(len(chunk))
                chunk = rng.choice((chunk[:cut], turn_bits(rng, chunk, cut, len(chunk))))
            else:
                traffic.required.update(intact)
            traffic.chunks.append(chunk)
            at = end
        return traffic

    def _chunk(
        self, frames: list[WireFrame], records: list[list[bytes]], traffic: Traffic
    ) -> tuple[bytes, list[int]]:
        """Return one chunk, and the module times of the wire frames in it that must come through."""
        rng = self._rng
        stream: list[bytes] = []
        intact: list[int] = []
        for place, (frame, pieces) in enumerate(zip(frames, records, strict=True)):
            before, earlier = records[place - 1], frames[place - 1]
            if rng.random() >= DAMAGED_SHARE:
                stream += pieces
                intact.append(frame.module_time_us)
                continue
            traffic.n_damaged += 1
            # Frames of one stream cannot be interleaved: a receiver could not distinguish their pieces.
            if rng.random() < 0.2 and (earlier.kind, earlier.module) != (frame.kind, frame.module):
                stream += _interleaved(rng, pieces, before)
                intact += [frame.module_time_us, earlier.module_time_us]
            else:
                stream += rng.choice(PIECE_DAMAGES)(rng, pieces, before)
        return b"".join(stream), intact


def _interleaved(rng: Random, one: list[bytes], other: list[bytes]) -> list[bytes]:
    """Return the records of two wire frames interleaved, which must damage neither."""
    turns = rng.sample([0] * len(one) + [1] * len(other), len(one) + len(other))
    queues = iter(one), iter(other)
    return [next(queues[turn]) for turn in turns]


_RECORD_HEAD = 6
_FOREIGN = pack_can_records(
    [
        CanFrame(0x123, b"\x01\x02", is_extended=False),
        CanFrame(0x1ABCDEF, b"", is_remote=True),
        CanFrame(0x4, bytes(8), is_error=True),
    ]
)


def _lose(rng: Random, pieces: list[bytes], _: list[bytes]) -> list[bytes]:
    place = rng.randrange(len(pieces))
    return [*pieces[:place], *pieces[place + 1 :]]


def _repeat(rng: Random, pieces: list[bytes], _: list[bytes]) -> list[bytes]:
    place = rng.randrange(len(pieces))
    return [*pieces[:place], pieces[place], *pieces[place:]]


def _reorder(rng: Random, pieces: list[bytes], _: list[bytes]) -> list[bytes]:
    return rng.sample(pieces, len(pieces))


def _turn_data(rng: Random, pieces: list[bytes], _: list[bytes]) -> list[bytes]:
    place = rng.randrange(len(pieces))
    hit = turn_bits(rng, pieces[place], _RECORD_HEAD, len(pieces[place]))
    return [*pieces[:place], hit, *pieces[place + 1 :]]


def _turn_identifier(rng: Random, pieces: list[bytes], _: list[bytes]) -> list[bytes]:
    place = rng.randrange(len(pieces))
    identifier = int.from_bytes(pieces[place][:4], "little") ^ 1 << rng.randrange(29)
    hit = identifier.to_bytes(4, "little") + pieces[place][4:]
    return [*pieces[:place], hit, *pieces[place + 1 :]]


def _splice(rng: Random, pieces: list[bytes], other: list[bytes]) -> list[bytes]:
    return [*pieces[: rng.randrange(len(pieces))], *other[rng.randrange(len(other)) :]]


def _mix_with_foreign(rng: Random, pieces: list[bytes], _: list[bytes]) -> list[bytes]:
    place = rng.randrange(len(pieces))
    return [*pieces[:place], _FOREIGN, *pieces[place:]]


PIECE_DAMAGES = (_lose, _repeat, _reorder, _turn_data, _turn_identifier, _splice, _mix_with_foreign)
"""What comes of the records of one wire frame, none of which has to come through."""
