"""Where everything lies on the wire, as constants of kernels: worked out from the declarations.

``firmware_protocol`` says what the wire is; nothing of it is stated here a second time.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from firmware_protocol import PACKETS, Defect, InertialSample, InertialSampleFine
from firmware_protocol.can_framing import (
    FD_DATA_SIZE,
    MAX_CAN_BODY_SIZE,
    MAX_PARTIAL_FRAMES,
    MAX_PIECES,
    OVERHEAD,
)
from firmware_protocol.fields import BYTE_ORDER, Layout, WireField, layout_of
from firmware_protocol.framing import CHECKSUM_FIELD, HEADER_FIELDS
from firmware_protocol.relay import ENTRY_FIELDS, RELAY_BATCH
from gateway.frames import Clipped, IntArray
from gateway.sources.module_rows import SHARED_KINDS

assert BYTE_ORDER == "<", "kernels read the lowest byte first"

DEFECTS = tuple(Defect)
"""By the number that kernels give to each."""
_NUMBER = {defect: number for number, defect in enumerate(DEFECTS)}
OVERLONG, BAD_STUFFING = _NUMBER[Defect.OVERLONG], _NUMBER[Defect.BAD_STUFFING]
TOO_SHORT, BAD_CRC = _NUMBER[Defect.TOO_SHORT], _NUMBER[Defect.BAD_CRC]
BAD_VERSION, UNKNOWN_KIND = _NUMBER[Defect.BAD_VERSION], _NUMBER[Defect.UNKNOWN_KIND]
BAD_LENGTH, BAD_VALUE = _NUMBER[Defect.BAD_LENGTH], _NUMBER[Defect.BAD_VALUE]
BAD_MODULE, TRUNCATED = _NUMBER[Defect.BAD_MODULE], _NUMBER[Defect.TRUNCATED]
FOREIGN, LOST_FRAGMENT = _NUMBER[Defect.FOREIGN], _NUMBER[Defect.LOST_FRAGMENT]


def _places(fields: Sequence[WireField]) -> dict[str, tuple[int, int]]:
    """Return offset and size of each field by name, and of all of them together as ``""``, in bytes."""
    ends = [
        struct.calcsize(BYTE_ORDER + "".join(f.struct_format for f in fields[:n]))
        for n in range(len(fields) + 1)
    ]
    places = {f.name: (begin, f.size) for f, begin in zip(fields, ends, strict=False)}
    return places | {"": (0, ends[-1])}


_HEADER, _ENTRY = _places(HEADER_FIELDS), _places(ENTRY_FIELDS)
HEADER_SIZE, CHECKSUM_SIZE = _HEADER[""][1], CHECKSUM_FIELD.size
VERSION_AT, KIND_AT, MODULE_AT = (_HEADER[name][0] for name in ("version", "kind", "module"))
SEQUENCE_AT, SEQUENCE_SIZE = _HEADER["sequence"]
TIME_AT, TIME_SIZE = _HEADER["module_time_us"]
ENTRY_SIZE = _ENTRY[""][1]
ENTRY_KIND_AT, ENTRY_MODULE_AT, ENTRY_LENGTH_AT = (_ENTRY[name][0] for name in ("kind", "module", "length"))
ENTRY_SEQUENCE_AT, ENTRY_TIME_AT = _ENTRY["sequence"][0], _ENTRY["module_time_us"][0]

UNKNOWN, READABLE, BATCH, SAMPLE = range(4)
"""What becomes of a kind: dropped, left to Python, opened, or taken by kernels; those that kernels take are
``SAMPLE`` and the place of their counter in a module's row."""


def treatments() -> NDArray[np.uint8]:
    """Return by kind (256,) what becomes of it, where samples have no listener."""
    found = np.full(256, UNKNOWN, np.uint8)
    found[list(PACKETS)] = READABLE
    found[RELAY_BATCH] = BATCH
    for kind, place in SHARED_KINDS.items():
        found[kind] = SAMPLE + place
    return found


_SENSORS = ("specific_force", "angular_rate", "magnetic_field")
"""In the order of a sample's rows."""
_CLIPS = {"specific_force": Clipped.SPECIFIC_FORCE, "angular_rate": Clipped.ANGULAR_RATE}
_LAYOUTS: tuple[Layout, ...] = tuple(layout_of(packet) for packet in (InertialSample, InertialSampleFine))
_FIELDS: list[dict[str, WireField]] = [{f.name: f for f in layout.fields} for layout in _LAYOUTS]
assert [packet.KIND for packet in (InertialSample, InertialSampleFine)] == list(SHARED_KINDS)
assert all(
    f.code in "hi" and f.count == 3 and not f.is_restricted for named in _FIELDS for f in named.values()
)

ELEMENT_SIZE: IntArray = np.array([named["specific_force"].size // 3 for named in _FIELDS])
"""Bytes of one element, signed, the same for all sensors of a kind (2,)."""
assert all(
    f.size == 3 * size for named, size in zip(_FIELDS, ELEMENT_SIZE, strict=True) for f in named.values()
)
SCALE = np.array([[named[name].scale for name in _SENSORS] for named in _FIELDS], np.float64)
"""Value of one step of an element (2, 3)."""


def _body_tables() -> tuple[IntArray, IntArray, IntArray]:
    """Return by kind and mask the size of a body (2, 256), the place of each sensor in it (2, 256, 3) and
    which sensors are clipped (2, 256). Size -1: there is no such mask; place -1: nothing to be read."""
    size, place = np.full((2, 256), -1), np.full((2, 256, 3), -1)
    clipped = np.zeros((2, 256), np.int64)
    for k, layout in enumerate(_LAYOUTS):
        for mask in layout.valid_masks():
            size[k, mask] = layout.sizes(mask)[0]
            flags = {flag.clips for flag in layout.flags if mask >> flag.bit & 1}
            clipped[k, mask] = sum(clip for name, clip in _CLIPS.items() if name in flags)
            begin = 1
            for f in layout.present(mask):
                # A clipped field points elsewhere, and is not used.
                if not (f.name == "magnetic_field" and f.name in flags):
                    place[k, mask, _SENSORS.index(f.name)] = begin
                begin += f.size
    return size, place, clipped


BODY_SIZE, SENSOR_AT, CLIPPED = _body_tables()


def _crc_table() -> IntArray:
    """Return the CRC-32 of each byte (256,), the reflected polynomial of ISO-HDLC."""
    table: list[int] = []
    for byte in range(256):
        rest = byte
        for _ in range(8):
            rest = rest >> 1 ^ (0xEDB88320 if rest & 1 else 0)
        table.append(rest)
    return np.array(table)


CRC_TABLE = _crc_table()

DECODER = np.dtype(
    [
        ("is_skipping", np.int64),  # the rest of an overlong wire frame, until a delimiter
        ("damaged", np.int64),  # drops that packets of ours may have been lost in
        ("n_left", np.int64),  # entries of the newest chunk that are ``READABLE``
        ("dropped", np.int64, (len(DEFECTS),)),
        ("n_partial", np.int64),  # CAN: wire frames in reassembly, and how many were ever begun
        ("n_begun", np.int64),
    ]
)
"""What a decoder keeps from chunk to chunk, beside the bytes begun."""

PARTIAL = np.dtype(
    [
        ("stream", np.int64),  # kind and module
        ("begun", np.int64),  # in this order; 0: nothing is here
        ("pieces", np.int64),  # so far; -1 while the rest of a spoilt wire frame passes
        ("size", np.int64),
        ("data", np.uint8, (MAX_PIECES * FD_DATA_SIZE,)),
    ]
)
"""One wire frame in reassembly from CAN frames."""
N_STREAMS = 1 << (8 * (MODULE_AT + 1 - KIND_AT))
"""Numbers that kind and module together can have."""
CARRIED = MAX_PARTIAL_FRAMES * (SEQUENCE_AT + OVERHEAD + MAX_CAN_BODY_SIZE)
"""Bytes of wire frames that may have been in reassembly before a chunk and be whole in it."""

ENTRY = np.dtype(
    [
        ("how", np.int64),  # see ``READABLE``
        ("kind", np.int64),
        ("module", np.int64),
        ("sequence", np.int64),
        ("module_time_us", np.int64),
        ("relayed_us", np.int64),  # of the batch it came in; -1: by itself
        ("start", np.int64),  # of its body among the unstuffed bytes, and where that ends
        ("stop", np.int64),
    ]
)
"""One packet's wire frame, or its entry in a batch."""

TICK, GAP = range(2)
EVENT = np.dtype(
    [
        ("what", np.int64),  # ``TICK``: of the relay, at ``first``; ``GAP``: numbers that have not come
        ("module", np.int64),
        ("kind", np.int64),
        ("first", np.int64),
        ("full", np.int64),  # the number that came after the gap
        ("received_in", np.int64),  # chunk in which one came before it
    ]
)
"""What kernels leave to Python to be noted, in its order."""
