"""Wire frames on a byte stream: stuffed, delimited, checked.

A wire frame before stuffing, all integers little-endian::

    [version:1] [kind:1] [module:1] [sequence:2] [module_time_us:4] [body:N] [crc32:4]

It is stuffed by COBS (Cheshire & Baker 1999) so that it holds no zero byte, and ended by one zero.
A receiver that joins late or loses bytes is whole again at the next zero.

Which protocol versions are spoken, and how two parties agree on one.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, final
from zlib import crc32

from firmware_protocol import stuffing
from firmware_protocol.fields import BYTE_ORDER, WireField

DELIMITER = b"\x00"
PROTOCOL_VERSION = 1
MAX_FRAME_SIZE = 4096
"""Largest wire frame before stuffing, bytes: what a receiver must be able to hold."""

MAX_MODULE = 63
RELAY = 0xFE
BROADCAST = 0xFF

HEADER_FIELDS = (
    WireField(name="version", code="B", sentence="Protocol version, 1."),
    WireField(name="kind", code="B", sentence="What the body is."),
    WireField(
        name="module",
        code="B",
        sentence="Module that sends, or that the host means: 0 to 63, or 254 for a relay. 255: all of them.",
    ),
    WireField(name="sequence", code="H", sentence="Counts wire frames of one (module, kind), wraps to 0."),
    WireField(
        name="module_time_us",
        code="I",
        unit="µs",
        sentence="Sender's clock at the moment of sampling (a batch: of sending), wraps to 0.",
    ),
)
CHECKSUM_FIELD = WireField(
    name="crc32", code="I", sentence="CRC-32 of ISO-HDLC (zlib's) over all bytes before it."
)

_HEADER = struct.Struct(BYTE_ORDER + "".join(f.struct_format for f in HEADER_FIELDS))
_CHECKSUM = struct.Struct(BYTE_ORDER + CHECKSUM_FIELD.struct_format)
MIN_FRAME_SIZE = _HEADER.size + _CHECKSUM.size
MAX_BODY_SIZE = MAX_FRAME_SIZE - MIN_FRAME_SIZE
# COBS adds one byte for each 254 begun.
MAX_STUFFED_SIZE = MAX_FRAME_SIZE + MAX_FRAME_SIZE // 254 + 1


@final
class Defect(Enum):
    """Why received bytes were dropped. Each value is the reason in words."""

    OVERLONG = "more bytes than the largest wire frame came without a delimiter"
    BAD_STUFFING = "the bytes between two delimiters are no COBS encoding"
    TOO_SHORT = "there are fewer bytes than header and checksum need"
    BAD_CRC = "the checksum does not fit the bytes"
    BAD_VERSION = "the protocol version is not 1"
    UNKNOWN_KIND = "this version does not define the kind"
    BAD_LENGTH = "the body is longer or shorter than it says or than its kind and mask demand"
    BAD_VALUE = "a field has a value that it does not allow: reserved, not finite or out of range"
    BAD_MODULE = "a module of this id cannot send this"
    TRUNCATED = "an entry or record runs past the end of what carries it"
    FOREIGN = "the CAN frame is somebody else's: short identifier, remote, error or other version"
    LOST_FRAGMENT = "a CAN piece was lost, repeated or out of order"
    UNSIGNED = "the link is signed, and this came without a signature"
    BAD_SIGNATURE = "the signature fits neither the key nor the bytes, or is the receiver's own"
    REPLAYED = "the count of the signature has come before"
    OUTDATED = "the count of the signature is older than the window or the receiver's start"


@dataclass(frozen=True, slots=True)
class WireFrame:
    """Checked bytes with their header."""

    kind: int
    module: int
    sequence: int
    """Count of the sender's wire frames of this kind, modulo 2^16."""
    module_time_us: int
    """Sender's clock, µs modulo 2^32."""
    body: bytes
    version: int = PROTOCOL_VERSION


Entry = tuple[int, int, int, int, bytes]
"""kind, module, sequence, module_time_us, body of a wire frame of our version: a plain tuple, because
64 000 pass each second."""


def serialize(frame: WireFrame) -> bytes:
    """Return the wire frame before stuffing, checksum included.

    Raises ValueError when a number does not fit its field or the body is too long.
    """
    if len(frame.body) > MAX_BODY_SIZE:
        raise ValueError(f"body of {len(frame.body)} bytes: a wire frame holds at most {MAX_BODY_SIZE}")
    try:
        header = _HEADER.pack(frame.version, frame.kind, frame.module, frame.sequence, frame.module_time_us)
    except struct.error as error:
        raise ValueError(f"header of {frame}: {error}") from None
    content = header + frame.body
    return content + _CHECKSUM.pack(crc32(content))


def encode_frame(frame: WireFrame) -> bytes:
    """Return the wire frame as sent on a byte stream: stuffed and ended by the delimiter.

    Raises ValueError when a number does not fit its field or the body is too long.
    """
    return stuffing.stuff(serialize(frame)) + DELIMITER


def parse(raw: bytes) -> Entry | Defect:
    """Return a wire frame from its bytes before stuffing."""
    if len(raw) < MIN_FRAME_SIZE:
        return Defect.TOO_SHORT
    content = raw[: -_CHECKSUM.size]
    # The checksum comes before the version, as a damaged version is damage and not another version.
    if _CHECKSUM.unpack_from(raw, len(content))[0] != crc32(content):
        return Defect.BAD_CRC
    version, kind, module, sequence, module_time_us = _HEADER.unpack_from(raw)
    if version != PROTOCOL_VERSION:
        return Defect.BAD_VERSION
    return kind, module, sequence, module_time_us, content[_HEADER.size :]


def unstuff(encoded: bytes) -> Entry | Defect:
    """Return a wire frame from the bytes between two delimiters."""
    if len(encoded) > MAX_STUFFED_SIZE:
        return Defect.OVERLONG
    raw = stuffing.unstuff(encoded)
    return Defect.BAD_STUFFING if raw is None else parse(raw)


class FrameDecoder:
    """Reassembles wire frames from chunks of any size.

    Bytes from the wire are untrusted: ``feed`` never raises, it counts what it drops. It holds at
    most one stuffed frame (``MAX_STUFFED_SIZE`` bytes) between chunks.
    """

    def __init__(self) -> None:
        self.dropped: Counter[Defect] = Counter()
        """What was dropped, by reason."""
        self.accepted = 0
        """Wire frames handed out."""
        self._partial = b""
        self._skipping = False

    def feed(self, chunk: bytes) -> list[WireFrame]:
        """Return the wire frames that this chunk completes, in order."""
        return [WireFrame(*entry) for entry in self.entries(chunk)]

    def entries(self, chunk: bytes) -> list[Entry]:
        """Return the same as plain tuples."""
        *complete, self._partial = (self._partial + chunk).split(DELIMITER)
        if complete and self._skipping:
            # The rest of an overlong frame, which was counted when it grew too long.
            del complete[0]
            self._skipping = False
        entries: list[Entry] = []
        for encoded in complete:
            if not encoded:
                continue  # two delimiters in a row: an idle line
            entry = unstuff(encoded)
            if type(entry) is Defect:
                self.dropped[entry] += 1
            else:
                entries.append(entry)
        self.accepted += len(entries)
        if self._skipping or len(self._partial) > MAX_STUFFED_SIZE:
            self._skip()
        return entries

    def _skip(self) -> None:
        # Without a delimiter the buffer would grow for ever: what came is dropped until the next one.
        if not self._skipping:
            self.dropped[Defect.OVERLONG] += 1
        self._partial, self._skipping = b"", True


class VersionRange(NamedTuple):
    """Protocol versions from ``lowest`` to ``highest``, both included."""

    lowest: int
    highest: int


SUPPORTED = VersionRange(PROTOCOL_VERSION, PROTOCOL_VERSION)
"""What this package speaks."""

NO_VERSION = 0
"""Stands for "none in common" in the answer to HELLO."""


def negotiate(one: tuple[int, int], other: tuple[int, int]) -> int | None:
    """Return the highest version in both ranges (lowest, highest); None when they share none."""
    lowest, highest = max(one[0], other[0]), min(one[1], other[1])
    return highest if lowest <= highest and highest != NO_VERSION else None
