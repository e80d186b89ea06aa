"""CAN records to packets in compiled code, as ``CanFrameDecoder`` and ``PacketDecoder`` take them apart."""

from __future__ import annotations

from typing import NamedTuple

from firmware_protocol.can_framing import (
    CLASSIC_DATA_SIZE,
    FD,
    FD_DATA_SIZE,
    FD_FLAGS_AT,
    INDEX_MASK,
    LAST,
    LENGTH_AT,
    LENGTH_OFFSET,
    MAX_PADDING,
    MAX_PARTIAL_FRAMES,
    OVERHEAD,
    OWN_MASK,
    OWN_PATTERN,
    RECORD_SIZE,
    STREAM_MASK,
    STREAM_SHIFT,
)
from firmware_protocol.framing import PROTOCOL_VERSION
from gateway.frames import IntArray
from gateway.geometry.compiled import compiled
from gateway.sources.wire_kernels import (
    Bytes,
    Room,
    Row,
    Rows,
    defect_of_frame,
    drop,
    take_frame,
    unsigned,
)
from gateway.sources.wire_layout import (
    BAD_LENGTH,
    FOREIGN,
    KIND_AT,
    LOST_FRAGMENT,
    MODULE_AT,
    SEQUENCE_AT,
    TOO_SHORT,
    TRUNCATED,
    VERSION_AT,
)


class Unfinished(NamedTuple):
    """Wire frames of which not all pieces have come."""

    frames: Rows  # (MAX_PARTIAL_FRAMES,) PARTIAL
    places: IntArray  # (N_STREAMS,) of each stream's frame in them, from 1; 0: it has none


@compiled
def _forget(decoder: Rows, unfinished: Unfinished, place: int) -> None:
    """Give up an unfinished wire frame, which counts unless it has been counted as spoilt."""
    if unfinished.frames[place].pieces >= 0:
        drop(decoder, LOST_FRAGMENT)
    _free(decoder, unfinished, place)


@compiled
def _free(decoder: Rows, unfinished: Unfinished, place: int) -> None:
    """Have a place free for another wire frame."""
    frame = unfinished.frames[place]
    unfinished.places[frame.stream] = 0
    frame.begun = 0
    decoder[0].n_partial -= 1


@compiled
def _begin(decoder: Rows, unfinished: Unfinished, stream: int, pieces: int) -> int:
    """Begin a wire frame, or with ``pieces`` -1 the rest of a spoilt one; return its place."""
    partial, places = unfinished.frames, unfinished.places
    place = int(places[stream]) - 1
    # A free place, or else that of the oldest frame, which will hardly be completed any more.
    if place < 0:
        oldest = 0
        for k in range(MAX_PARTIAL_FRAMES):
            if partial[k].begun == 0 or partial[k].begun < partial[oldest].begun:
                oldest = k
            if partial[k].begun == 0:
                break
        place = oldest
        if decoder[0].n_partial >= MAX_PARTIAL_FRAMES:
            _forget(decoder, unfinished, place)
        decoder[0].n_partial += 1
        decoder[0].n_begun += 1
        places[stream], partial[place].stream, partial[place].begun = place + 1, stream, decoder[0].n_begun
    partial[place].pieces, partial[place].size = pieces, 0
    return place


@compiled
def _place_of(decoder: Rows, unfinished: Unfinished, stream: int, index: int) -> int:
    """Return where a piece belongs: to a wire frame that it begins or goes on with, or to a spoilt one."""
    partial = unfinished.frames
    place = int(unfinished.places[stream]) - 1
    if index == 0:
        if place >= 0:
            _forget(decoder, unfinished, place)
        return _begin(decoder, unfinished, stream, 0)
    if place >= 0 and (partial[place].pieces == index or partial[place].pieces < 0):
        return place
    drop(decoder, LOST_FRAGMENT)
    return _begin(decoder, unfinished, stream, -1)


@compiled
def _reassemble(frame: Row, is_fd: bool, raw: Bytes, at: int) -> int:
    """Write joined pieces to ``raw`` from ``at`` as on a byte stream; return the end, or -1 - the defect."""
    if frame.size < OVERHEAD:
        return -1 - TOO_SHORT
    size = OVERHEAD + int(frame.data[LENGTH_OFFSET])
    padding = frame.size - size
    if padding < 0 or padding > (MAX_PADDING if is_fd else 0):
        return -1 - BAD_LENGTH
    raw[at + VERSION_AT] = PROTOCOL_VERSION
    raw[at + KIND_AT], raw[at + MODULE_AT] = frame.stream >> 8, frame.stream & 0xFF
    to = at + SEQUENCE_AT
    for k in range(size):
        # The length is of CAN alone: a byte stream's frame says it by its end.
        if k != LENGTH_OFFSET:
            raw[to] = frame.data[k]
            to += 1
    return to


@compiled
def decode_records(data: bytes, decoder: Rows, unfinished: Unfinished, room: Room) -> int:
    """Take records apart; return the number of entries.

    data: a chunk; ``room.raw``: for at least ``CARRIED`` more bytes than ``data``; all else as for
    ``decode_stream``.
    """
    begin, at, n = 0, 0, 0
    decoder[0].n_left = 0
    while begin + RECORD_SIZE <= len(data):
        identifier, is_fd = unsigned(data, begin, FD_FLAGS_AT), data[begin + FD_FLAGS_AT] & FD != 0
        length, start = int(data[begin + LENGTH_AT]), begin + RECORD_SIZE
        if start + length > len(data) or length > (FD_DATA_SIZE if is_fd else CLASSIC_DATA_SIZE):
            break
        begin = start + length
        if identifier & OWN_MASK != OWN_PATTERN:
            drop(decoder, FOREIGN)
            decoder[0].damaged -= 1  # none of ours
            continue
        stream = (identifier & STREAM_MASK) >> STREAM_SHIFT
        place = _place_of(decoder, unfinished, stream, identifier & INDEX_MASK)
        frame = unfinished.frames[place]
        if frame.pieces >= 0:
            for k in range(length):
                frame.data[frame.size + k] = data[start + k]
            frame.size += length
            frame.pieces += 1
        if identifier & LAST == 0:
            continue
        if frame.pieces >= 0:
            stop = _reassemble(frame, is_fd, room.raw, at)
            defect = defect_of_frame(room.raw, at, stop) if stop >= 0 else -1 - stop
            if defect >= 0:
                drop(decoder, defect)
            else:
                n = take_frame(room, decoder, n, at, stop)
                at = stop
        _free(decoder, unfinished, place)
    if begin < len(data):
        drop(decoder, TRUNCATED)
    return n
