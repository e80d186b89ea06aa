"""Wire frames on a CAN bus, classic and FD, cut into pieces under 29-bit identifiers.

Identifier, most significant bit first::

    [priority:3] [kind:8] [module:8] [version:4] [last:1] [index:5]

What the pieces of one wire frame hold, joined in the order of ``index``::

    [sequence:2] [module_time_us:4] [body_length:1] [body:body_length] [crc32:4] [padding, FD only]

``crc32`` is that of the same wire frame on a byte stream, so it covers what the identifier says too.

A CAN link packs the CAN frames into the bytes of its chunks, one record each::

    [identifier and flags:4] [fd flags:1] [length:1] [data:length]

Flags beside the identifier as in SocketCAN: bit 31 extended, 30 remote, 29 error; fd flags: bit 0
FD, bit 1 bit-rate switch.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

from firmware_protocol.fields import BYTE_ORDER, WireField
from firmware_protocol.framing import (
    CHECKSUM_FIELD,
    HEADER_FIELDS,
    PROTOCOL_VERSION,
    Defect,
    Entry,
    WireFrame,
    parse,
    serialize,
)
from firmware_protocol.kinds import CAN_PRIORITY, LOWEST_CAN_PRIORITY

EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
FD, BITRATE_SWITCH = 1 << 0, 1 << 1

CLASSIC_DATA_SIZE = 8
FD_DATA_SIZE = 64

_RECORD = struct.Struct("<IBB")
RECORD_SIZE = _RECORD.size
"""Bytes of a record beside its data."""
FD_FLAGS_AT, LENGTH_AT = struct.calcsize("<I"), struct.calcsize("<IB")

Record = tuple[int, int, bytes]
"""identifier with flags, fd flags, data: a plain tuple because thousands pass each second."""


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One frame of a CAN bus."""

    identifier: int
    """11 or 29 bits, without flags."""
    data: bytes
    is_extended: bool = True
    is_fd: bool = False
    is_remote: bool = False
    is_error: bool = False
    bitrate_switch: bool = False


def data_limit(is_fd: bool) -> int:
    """Return how many data bytes a CAN frame holds at most."""
    return FD_DATA_SIZE if is_fd else CLASSIC_DATA_SIZE


def pack_can_records(frames: Iterable[CanFrame]) -> bytes:
    """Return CAN frames as the bytes of a link's chunk.

    Raises ValueError when a frame has more data or a longer identifier than CAN allows.
    """
    return b"".join(map(_pack, frames))


def unpack_can_records(data: bytes) -> list[CanFrame]:
    """Return the CAN frames of a link's chunk. Never raises: a broken tail is dropped."""
    return [_unpack(*record) for record in split_records(data)[0]]


def split_records(data: bytes) -> tuple[list[Record], bool]:
    """Return the whole records of a chunk, and whether a broken one followed them. Never raises."""
    records: list[Record] = []
    stop = 0
    while stop + _RECORD.size <= len(data):
        flagged_identifier, fd_flags, length = _RECORD.unpack_from(data, stop)
        start = stop + _RECORD.size
        # A length that leads beyond the data is damage: nothing says where the next record begins.
        if start + length > len(data) or length > data_limit(bool(fd_flags & FD)):
            return records, True
        stop = start + length
        records.append((flagged_identifier, fd_flags, data[start:stop]))
    return records, stop < len(data)


def _pack(frame: CanFrame) -> bytes:
    limit = data_limit(frame.is_fd)
    if len(frame.data) > limit:
        raise ValueError(f"{len(frame.data)} bytes of data: a CAN{' FD' * frame.is_fd} frame holds {limit}")
    bits = 29 if frame.is_extended or frame.is_error else 11
    if not 0 <= frame.identifier < 1 << bits:
        raise ValueError(f"identifier {frame.identifier:#x}: this CAN frame has one of {bits} bits")
    flags = EXTENDED * frame.is_extended | REMOTE * frame.is_remote | ERROR * frame.is_error
    fd_flags = FD * frame.is_fd | BITRATE_SWITCH * frame.bitrate_switch
    return _RECORD.pack(frame.identifier | flags, fd_flags, len(frame.data)) + frame.data


def _unpack(flagged_identifier: int, fd_flags: int, data: bytes) -> CanFrame:
    return CanFrame(
        # The flags are the three bits above the identifier's 29, and ERROR is the lowest of them.
        identifier=flagged_identifier & (ERROR - 1),
        data=data,
        is_extended=bool(flagged_identifier & EXTENDED),
        is_fd=bool(fd_flags & FD),
        is_remote=bool(flagged_identifier & REMOTE),
        is_error=bool(flagged_identifier & ERROR),
        bitrate_switch=bool(fd_flags & BITRATE_SWITCH),
    )


IDENTIFIER_BITS = (("priority", 3), ("kind", 8), ("module", 8), ("version", 4), ("last", 1), ("index", 5))
"""Parts of the identifier and their bits, most significant first."""

IDENTIFIER_MEANINGS = {
    "priority": "Urgency of the kind, 0 the highest; receivers ignore it.",
    "kind": "As in the wire frame.",
    "module": "As in the wire frame.",
    "version": "Protocol version, 1.",
    "last": "1 on the last piece.",
    "index": "Number of the piece, from 0.",
}

HEAD_FIELDS = (*HEADER_FIELDS[3:], WireField(name="body_length", code="B", sentence="Bytes of the body."))
"""What comes before the body in the joined pieces."""

FD_LENGTHS: tuple[int, ...] = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Lengths that a CAN FD frame can have, bytes."""

# What five bits of index can number, and what the byte of the body's length can say.
MAX_PIECES = 32
MAX_CAN_BODY_SIZE = 255
MAX_PARTIAL_FRAMES = 256
"""Wire frames in reassembly at one time: 64 modules, each interrupting itself up to three times."""

_WIDTHS = [bits for _, bits in IDENTIFIER_BITS]
IDENTIFIER_SHIFT = {name: sum(_WIDTHS[place + 1 :]) for place, (name, _) in enumerate(IDENTIFIER_BITS)}
"""Place of the lowest bit of each part."""

_MASK = {name: ((1 << bits) - 1) << IDENTIFIER_SHIFT[name] for name, bits in IDENTIFIER_BITS}
LAST, INDEX_MASK = _MASK["last"], _MASK["index"]
STREAM_SHIFT, STREAM_MASK = IDENTIFIER_SHIFT["module"], _MASK["kind"] | _MASK["module"]
"""Of kind and module together, which distinguish wire frames that come in turns."""

# Ours is what has a long identifier, is neither remote nor an error, and is of our version.
OWN_MASK = EXTENDED | REMOTE | ERROR | _MASK["version"]
OWN_PATTERN = EXTENDED | PROTOCOL_VERSION << IDENTIFIER_SHIFT["version"]

_IDENTITY = struct.Struct("<BBB")
_HEAD = struct.Struct(BYTE_ORDER + "".join(f.struct_format for f in HEAD_FIELDS))
LENGTH_OFFSET = _HEAD.size - 1
"""Place of the body's length in the joined pieces, and the end of what a byte stream has, too."""
OVERHEAD = _HEAD.size + CHECKSUM_FIELD.size
"""Bytes of the joined pieces beside the body."""
MAX_PADDING = max(longer - shorter for shorter, longer in pairwise(FD_LENGTHS)) - 1
"""Bytes after the checksum, of FD frames."""
MAX_CLASSIC_BODY_SIZE = MAX_PIECES * CLASSIC_DATA_SIZE - OVERHEAD


def fragment(frame: WireFrame, fd: bool = False) -> list[CanFrame]:
    """Return the CAN frames that carry a wire frame, in the order to be sent.

    Raises ValueError when the body exceeds 255 bytes (classic: 245, the most that 32 pieces hold) or
    a number does not fit its field.
    """
    limit = MAX_CAN_BODY_SIZE if fd else MAX_CLASSIC_BODY_SIZE
    if len(frame.body) > limit:
        raise ValueError(f"body of {len(frame.body)} bytes: CAN{' FD' if fd else ''} carries at most {limit}")
    payload = _payload(frame)
    size = data_limit(fd)
    pieces = [payload[start : start + size] for start in range(0, len(payload), size)]
    # CAN FD has frames of certain lengths only; the header says how many of the bytes count.
    if fd:
        pieces[-1] = pieces[-1].ljust(_fd_length(len(pieces[-1])), b"\x00")
    base = identifier(frame.kind, frame.module, version=frame.version)
    last = len(pieces) - 1
    return [
        CanFrame(base | (LAST if index == last else 0) | index, piece, is_fd=fd, bitrate_switch=fd)
        for index, piece in enumerate(pieces)
    ]


def identifier(
    kind: int, module: int, index: int = 0, is_last: bool = False, version: int = PROTOCOL_VERSION
) -> int:
    """Return the identifier of one piece. Raises ValueError, naming it, for a number that does not fit."""
    parts = {
        "priority": CAN_PRIORITY.get(kind, LOWEST_CAN_PRIORITY),
        "kind": kind,
        "module": module,
        "version": version,
        "last": int(is_last),
        "index": index,
    }
    # A number too large for its part would change the part beside it unnoticed.
    for name, part in parts.items():
        if part << IDENTIFIER_SHIFT[name] > _MASK[name]:
            raise ValueError(f"{name} {part} does not fit a CAN identifier")
    return sum(part << IDENTIFIER_SHIFT[name] for name, part in parts.items())


def _payload(frame: WireFrame) -> bytes:
    raw = serialize(frame)
    head_end = _IDENTITY.size + LENGTH_OFFSET
    return raw[_IDENTITY.size : head_end] + bytes([len(frame.body)]) + raw[head_end:]


def _fd_length(size: int) -> int:
    return min(length for length in FD_LENGTHS if length >= size)


class CanFrameDecoder:
    """Reassembles wire frames from the CAN frames of a bus, those of many modules interleaved.

    A chunk is a run of whole records. ``feed`` never raises, it counts what it drops: a wire frame
    of which a piece is missing counts once. At most ``MAX_PARTIAL_FRAMES`` wire frames of 2 kB each
    are in reassembly; the one begun longest ago gives way to a new one.
    """

    def __init__(self) -> None:
        self.dropped: Counter[Defect] = Counter()
        """What was dropped, by reason."""
        self.accepted = 0
        """Wire frames handed out."""
        # By (kind, module): the pieces so far, or None while the rest of a spoilt frame passes.
        self._partial: dict[int, list[bytes] | None] = {}

    def feed(self, chunk: bytes) -> list[WireFrame]:
        """Return the wire frames that this chunk completes, in order."""
        return [WireFrame(*entry) for entry in self.entries(chunk)]

    def entries(self, chunk: bytes) -> list[Entry]:
        """Return the same as plain tuples."""
        records, is_broken = split_records(chunk)
        entries: list[Entry] = []
        for flagged_identifier, fd_flags, data in records:
            # Other traffic on the bus is counted, never decoded.
            if flagged_identifier & OWN_MASK != OWN_PATTERN:
                self.dropped[Defect.FOREIGN] += 1
                continue
            stream = (flagged_identifier & STREAM_MASK) >> STREAM_SHIFT
            index = flagged_identifier & INDEX_MASK
            pieces = self._partial.get(stream)
            # A first piece, or one out of sequence: then all of the frame is void, up to its last piece.
            if not index or pieces is None or len(pieces) != index:
                pieces = self._pieces_before(stream, index)
            if pieces is not None:
                pieces.append(data)
            if flagged_identifier & LAST:
                self._finish(stream, bool(fd_flags & FD), entries)
        if is_broken:
            self.dropped[Defect.TRUNCATED] += 1
        self.accepted += len(entries)
        return entries

    def _finish(self, stream: int, is_fd: bool, entries: list[Entry]) -> None:
        """Add the wire frame after its last piece, or count why there is none."""
        pieces = self._partial.pop(stream)
        if pieces is None:
            return
        entry = _reassemble(stream, b"".join(pieces), is_fd)
        if type(entry) is Defect:
            self.dropped[entry] += 1
        else:
            entries.append(entry)

    def _pieces_before(self, stream: int, index: int) -> list[bytes] | None:
        """Return the pieces of a wire frame that begins, or None when this one does not follow the last."""
        if index == 0:
            self._forget(stream)
            return self._begin(stream, [])
        # The loss counts here, once; the rest of a wire frame that was spoilt before passes uncounted.
        if self._partial.get(stream) is not None or stream not in self._partial:
            self.dropped[Defect.LOST_FRAGMENT] += 1
            return self._begin(stream, None)
        return None

    def _begin(self, stream: int, pieces: list[bytes] | None) -> list[bytes] | None:
        # A dictionary keeps the order of adding: its first key was begun longest ago.
        if stream not in self._partial and len(self._partial) >= MAX_PARTIAL_FRAMES:
            self._forget(next(iter(self._partial)))
        self._partial[stream] = pieces
        return pieces

    def _forget(self, stream: int) -> None:
        """Give up an unfinished wire frame, which counts unless it has been counted as spoilt."""
        if self._partial.pop(stream, None) is not None:
            self.dropped[Defect.LOST_FRAGMENT] += 1


def _reassemble(stream: int, payload: bytes, is_fd: bool) -> Entry | Defect:
    """Return the wire frame of one (kind, module) ``stream`` from its joined pieces."""
    if len(payload) < OVERHEAD:
        return Defect.TOO_SHORT
    end = OVERHEAD + payload[LENGTH_OFFSET]
    if not 0 <= len(payload) - end <= (MAX_PADDING if is_fd else 0):
        return Defect.BAD_LENGTH
    # The checksum covers the header of a byte stream, of which CAN has the first part in the identifier.
    identity = _IDENTITY.pack(PROTOCOL_VERSION, stream >> 8, stream & 0xFF)
    return parse(identity + payload[:LENGTH_OFFSET] + payload[_HEAD.size : end])
