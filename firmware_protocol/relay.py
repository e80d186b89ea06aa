"""Relay batches: many modules' wire frames forwarded by a relay unit as one.

Body of a batch, entries to its end::

    ([kind:1] [module:1] [sequence:2] [module_time_us:4] [length:1] [body:length])*
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from firmware_protocol.fields import BYTE_ORDER, WireField
from firmware_protocol.framing import HEADER_FIELDS, RELAY, Entry, WireFrame
from firmware_protocol.kinds import Kind

RELAY_BATCH = int(Kind.RELAY_BATCH)

# An entry is the wire frame without version and checksum, which the batch has once for all.
ENTRY_FIELDS = (
    *HEADER_FIELDS[1:],
    WireField(name="length", code="B", sentence="Bytes of the entry's body."),
)
MAX_ENTRY_BODY_SIZE = 255

_ENTRY = struct.Struct(BYTE_ORDER + "".join(f.struct_format for f in ENTRY_FIELDS))


def relay_batch(frames: Sequence[WireFrame], sequence: int, module_time_us: int) -> WireFrame:
    """Return the wire frame in which a relay forwards others.

    Raises ValueError for a batch within a batch, a body over 255 bytes or a number that does not
    fit its field. The whole batch may be too long for a wire frame: ``encode_frame`` refuses it then.
    """
    body = b"".join(_entry(frame) for frame in frames)
    return WireFrame(RELAY_BATCH, RELAY, sequence, module_time_us, body)


def split_batch(body: bytes) -> tuple[list[Entry], bool]:
    """Return the whole entries of a batch, and whether a truncated one followed them. Never raises."""
    entries: list[Entry] = []
    end, size = len(body), _ENTRY.size
    stop = 0
    while stop + size <= end:
        kind, module, sequence, module_time_us, length = _ENTRY.unpack_from(body, stop)
        start = stop + size
        # Where the body ends is known, where the next entry begins is not.
        if start + length > end:
            return entries, True
        stop = start + length
        entries.append((kind, module, sequence, module_time_us, body[start:stop]))
    return entries, stop < end


def _entry(frame: WireFrame) -> bytes:
    if frame.kind == RELAY_BATCH:
        raise ValueError("a relay batch cannot hold another")
    try:
        head = _ENTRY.pack(frame.kind, frame.module, frame.sequence, frame.module_time_us, len(frame.body))
    except struct.error as error:
        raise ValueError(f"relay entry of {frame}: {error}") from None
    return head + frame.body
