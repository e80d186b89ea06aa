"""Bytes of a link to samples in gateway time, in compiled code.

``FrameDecoder`` and ``PacketDecoder`` of ``firmware_protocol`` are the readable reference of the first half
(``decode_stream``), ``ModuleTable``, ``SequenceCounter`` and the clocks that of the second (``follow``). The
first half takes apart all that comes and counts every defect; of packets it checks the bodies of inertial
samples alone. The second takes the samples of modules whose clocks and counters go on as usual, and stops at
any other packet.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.framing import (
    MAX_MODULE,
    MAX_STUFFED_SIZE,
    MIN_FRAME_SIZE,
    PROTOCOL_VERSION,
    RELAY,
)
from gateway.clocks.clock_kernels import UNUSUAL, follow_clock, full_count
from gateway.frames import IntArray
from gateway.geometry.compiled import compiled
from gateway.sources.wire_layout import (
    BAD_CRC,
    BAD_LENGTH,
    BAD_MODULE,
    BAD_STUFFING,
    BAD_VALUE,
    BAD_VERSION,
    BATCH,
    BODY_SIZE,
    CHECKSUM_SIZE,
    CLIPPED,
    CRC_TABLE,
    ELEMENT_SIZE,
    ENTRY_KIND_AT,
    ENTRY_LENGTH_AT,
    ENTRY_MODULE_AT,
    ENTRY_SEQUENCE_AT,
    ENTRY_SIZE,
    ENTRY_TIME_AT,
    GAP,
    HEADER_SIZE,
    KIND_AT,
    MODULE_AT,
    OVERLONG,
    READABLE,
    SAMPLE,
    SCALE,
    SENSOR_AT,
    SEQUENCE_AT,
    SEQUENCE_SIZE,
    TICK,
    TIME_AT,
    TIME_SIZE,
    TOO_SHORT,
    TRUNCATED,
    UNKNOWN,
    UNKNOWN_KIND,
    VERSION_AT,
)

Bytes = NDArray[np.uint8]
Row = Any
"""One element of a structured array, whose fields are attributes in compiled code."""
Rows = Any
"""A structured array."""


class Room(NamedTuple):
    """What packets are decoded into: one for all links of a stream."""

    treatments: Bytes  # (256,) by kind, whether and how it is read here
    entries: Rows  # (k,) ENTRY, as many as the bytes can hold
    left: IntArray  # (k,) places of the entries that are left to Python
    raw: Bytes  # unstuffed bytes


class PacketHead(NamedTuple):
    """What is said of a packet before its body, and where in ``Room.raw`` that lies."""

    kind: int
    module: int
    sequence: int
    time_us: int
    relayed_us: int  # when a relay sent it on; -1: none did
    start: int
    stop: int


_FULL_BLOCK = 255
"""Length of a COBS block after which no zero is left out."""
_SEQUENCE_BITS = 8 * SEQUENCE_SIZE
_HALF, _SEQUENCE_MASK = 1 << (_SEQUENCE_BITS - 1), (1 << _SEQUENCE_BITS) - 1


@compiled
def unsigned(raw: bytes | Bytes, at: int, size: int) -> int:
    """Return an integer of so many bytes, the lowest first."""
    value = 0
    for k in range(size):
        value |= int(raw[at + k]) << (8 * k)
    return value


@compiled
def _unstuff(data: bytes, place: int, end: int, raw: Bytes, at: int) -> int:
    """Write what was stuffed into ``data[place:end]`` to ``raw`` from ``at``; return its end, or -1."""
    while True:
        length = int(data[place])
        stop = place + length
        if stop > end:
            return -1
        for k in range(place + 1, stop):
            raw[at] = data[k]
            at += 1
        if stop == end:
            return at
        # A block of full length has no zero behind it.
        if length != _FULL_BLOCK:
            raw[at] = 0
            at += 1
        place = stop


@compiled
def defect_of_frame(raw: Bytes, start: int, stop: int) -> int:
    """Return why the bytes are no wire frame, or -1."""
    if stop - start < MIN_FRAME_SIZE:
        return TOO_SHORT
    # CRC-32 as zlib has it, byte by byte by a table.
    checksum = 0xFFFFFFFF
    for k in range(start, stop - CHECKSUM_SIZE):
        checksum = CRC_TABLE[(checksum ^ int(raw[k])) & 0xFF] ^ (checksum >> 8)
    if checksum ^ 0xFFFFFFFF != unsigned(raw, stop - CHECKSUM_SIZE, CHECKSUM_SIZE):
        return BAD_CRC
    return -1 if raw[start + VERSION_AT] == PROTOCOL_VERSION else BAD_VERSION


@compiled
def _defect_of_packet(how: int, module: int, raw: Bytes, start: int, stop: int) -> int:
    """Return why an entry is no packet, or -1 for one of no defect, or that Python will judge."""
    if how in (UNKNOWN, BATCH):
        return UNKNOWN_KIND
    if how == READABLE:
        return -1
    if module > MAX_MODULE and module != RELAY:
        return BAD_MODULE
    if start == stop:
        return BAD_LENGTH
    size = BODY_SIZE[how - SAMPLE, raw[start]]
    if size < 0:
        return BAD_VALUE
    return -1 if size == stop - start else BAD_LENGTH


@compiled
def drop(decoder: Rows, defect: int) -> None:
    """Count a defect. decoder: (1,) DECODER."""
    decoder[0].dropped[defect] += 1
    decoder[0].damaged += 1


@compiled
def _take_entry(room: Room, decoder: Rows, n: int, head: PacketHead) -> int:
    """Append a packet's entry, or count its defect; return how many entries there are now."""
    how = int(room.treatments[head.kind])
    defect = _defect_of_packet(how, head.module, room.raw, head.start, head.stop)
    if defect >= 0:
        drop(decoder, defect)
        return n
    entry = room.entries[n]
    entry.how, entry.kind, entry.module, entry.sequence = how, head.kind, head.module, head.sequence
    entry.module_time_us, entry.relayed_us = head.time_us, head.relayed_us
    entry.start, entry.stop = head.start, head.stop
    if how == READABLE:
        room.left[decoder[0].n_left] = n
        decoder[0].n_left += 1
    return n + 1


@compiled
def take_frame(room: Room, decoder: Rows, n: int, start: int, stop: int) -> int:
    """Append the packets of the wire frame in ``room.raw[start:stop]``; return how many entries there are
    now.
    """
    raw = room.raw
    kind, module = int(raw[start + KIND_AT]), int(raw[start + MODULE_AT])
    sequence = unsigned(raw, start + SEQUENCE_AT, SEQUENCE_SIZE)
    time_us = unsigned(raw, start + TIME_AT, TIME_SIZE)
    at, end = start + HEADER_SIZE, stop - CHECKSUM_SIZE
    relayed_us = time_us if room.treatments[kind] == BATCH else -1
    if relayed_us < 0:
        return _take_entry(room, decoder, n, PacketHead(kind, module, sequence, time_us, relayed_us, at, end))
    if module != RELAY:
        drop(decoder, BAD_MODULE)
        return n
    while at + ENTRY_SIZE <= end:
        body = at + ENTRY_SIZE
        body_end = body + int(raw[at + ENTRY_LENGTH_AT])
        if body_end > end:
            break
        kind, module = int(raw[at + ENTRY_KIND_AT]), int(raw[at + ENTRY_MODULE_AT])
        sequence = unsigned(raw, at + ENTRY_SEQUENCE_AT, SEQUENCE_SIZE)
        time_us = unsigned(raw, at + ENTRY_TIME_AT, TIME_SIZE)
        n = _take_entry(
            room, decoder, n, PacketHead(kind, module, sequence, time_us, relayed_us, body, body_end)
        )
        at = body_end
    if at < end:
        drop(decoder, TRUNCATED)
    return n


@compiled
def decode_stream(data: bytes, decoder: Rows, room: Room) -> tuple[int, int]:
    """Take bytes apart, as ``FrameDecoder`` and ``PacketDecoder`` do.

    data: what was left of the bytes before, and a chunk; decoder: (1,) DECODER; ``room.raw``: for at least as
    many bytes as ``data``. Return how many bytes of ``data`` are done with, and the number of entries.
    """
    begin, at, n = 0, 0, 0
    decoder[0].n_left = 0
    for place in range(len(data)):
        if data[place] != 0:
            continue
        # The end of an overlong frame: what follows the delimiter is good again.
        if decoder[0].is_skipping != 0:
            decoder[0].is_skipping = 0
        elif place - begin > MAX_STUFFED_SIZE:
            drop(decoder, OVERLONG)
        elif place > begin:
            stop = _unstuff(data, begin, place, room.raw, at)
            defect = BAD_STUFFING if stop < 0 else defect_of_frame(room.raw, at, stop)
            if defect >= 0:
                drop(decoder, defect)
            else:
                n = take_frame(room, decoder, n, at, stop)
                at = stop
        # The frame's end is not in this chunk; beyond the largest size it can only be noise.
        begin = place + 1
    if decoder[0].is_skipping == 0 and len(data) - begin > MAX_STUFFED_SIZE:
        drop(decoder, OVERLONG)
        decoder[0].is_skipping = 1
    return (begin if decoder[0].is_skipping == 0 else len(data)), n


@compiled
def _read_sample(raw: Bytes, entry: Row, sample: Row) -> None:
    """Write what sensors say to a sample."""
    place, mask, size = entry.how - SAMPLE, raw[entry.start], ELEMENT_SIZE[entry.how - SAMPLE]
    sign = 1 << (8 * size - 1)
    for sensor in range(3):
        begin = SENSOR_AT[place, mask, sensor]
        for axis in range(3):
            if begin < 0:
                # A sensor that is absent from the sample.
                sample.measured[sensor, axis] = np.nan
            else:
                # Subtracting the sign bit after flipping it extends it: an unsigned number becomes a signed
                # one.
                element = (unsigned(raw, entry.start + begin + axis * size, size) ^ sign) - sign
                sample.measured[sensor, axis] = element * SCALE[place, sensor]
    sample.clipped = CLIPPED[place, mask]


@compiled
def follow(
    at: int, n: int, arrived_ns: int, chunk: int, room: Room, modules: Rows, samples: Rows,
    n_samples: int, events: Rows,
) -> tuple[int, int, int]:  # fmt: skip
    """Take the samples of entries from ``at`` to ``n``, up to one that is not usual.

    arrived_ns: gateway time of the chunk; chunk: its number on its link; room: what ``decode_stream`` has
    filled; modules: (256,) MODULE; samples: INERTIAL_SAMPLE of which ``n_samples`` are taken; events: twice
    as many EVENT as entries. Return where it stopped, and how many samples and events there are now.
    """
    n_events, tick_us = 0, -1
    while at < n:
        entry = room.entries[at]
        if entry.how == UNKNOWN:
            at += 1
            continue
        if entry.how == READABLE:
            break
        module = modules[entry.module]
        counter = module.sequences[entry.how - SAMPLE]
        full_us = full_count(module.clock, entry.module_time_us, arrived_ns)
        near = counter.newest + 1
        full = near + ((entry.sequence - counter.shift - near + _HALF) & _SEQUENCE_MASK) - _HALF
        if full_us == UNUSUAL or counter.goes_on == 0 or full < near:
            break
        if entry.relayed_us >= 0 and entry.relayed_us != tick_us:
            tick_us = entry.relayed_us
            events[n_events].what, events[n_events].first = TICK, tick_us
            n_events += 1
        if full > near:
            event = events[n_events]
            event.what, event.module, event.kind = GAP, entry.module, entry.kind
            event.first, event.full, event.received_in = near, full, counter.received_in
            n_events += 1
        counter.newest, counter.received_in = full, chunk
        counter.received += 1
        module.last_arrival_ns = arrived_ns
        sample = samples[n_samples]
        sample.module, sample.sequence = entry.module, full
        sample.time_ns = follow_clock(module.clock, full_us, arrived_ns)
        _read_sample(room.raw, entry, sample)
        n_samples += 1
        at += 1
    return at, n_samples, n_events
