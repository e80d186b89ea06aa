"""CAN frames, and how a CAN link packs them into the bytes of its chunks, one record each::

    [identifier and flags:4] [fd flags:1] [length:1] [data:length]

Flags beside the identifier as in SocketCAN: bit 31 extended, 30 remote, 29 error; fd flags: bit 0
FD, bit 1 bit-rate switch.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass

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
