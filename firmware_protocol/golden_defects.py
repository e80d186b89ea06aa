"""Golden vectors of damage: what a receiver must drop, count and survive."""

from __future__ import annotations

import dataclasses
from typing import Any

from firmware_protocol.can_framing import CanFrameDecoder, fragment
from firmware_protocol.can_records import CanFrame, pack_can_records
from firmware_protocol.framing import MAX_FRAME_SIZE, PROTOCOL_VERSION, FrameDecoder, encode_frame
from firmware_protocol.golden_forms import received_as_json
from firmware_protocol.packets import (
    InertialSample,
    PacketDecoder,
    WireFrameDecoder,
    wire_frame,
)
from firmware_protocol.relay import relay_batch

_SAMPLE = InertialSample(specific_force=(0.0, 0.0, 9.81), angular_rate=(0.0, 0.1, 0.0))
GOOD = wire_frame(_SAMPLE, 3, 17, 1_250_000)
"""A module at rest, turning slowly about its y axis; its magnetometer was not read."""


def defect_vectors() -> dict[str, Any]:
    """Return what ``vectors/defects.json`` holds: damaged input, and what a receiver makes of it."""
    return {
        "protocol_version": PROTOCOL_VERSION,
        "byte_stream": [
            _vector(name, damaged, FrameDecoder()) for name, damaged in _damaged_byte_streams().items()
        ],
        "can": [
            _vector(name, pack_can_records(frames), CanFrameDecoder())
            for name, frames in _damaged_can_traffic().items()
        ],
    }


def _damaged_byte_streams() -> dict[str, bytes]:
    """Return damaged streams by name; each ends with a good wire frame, which is to come through."""
    sent = encode_frame(GOOD)
    batch = relay_batch([GOOD, GOOD], 1, 1_250_100)
    damaged = {
        "an idle line": bytes(5),
        "one bit of the body turned": _with_bit_turned(sent, 14, 2),
        "noise longer than a wire frame": b"\xa5" * (MAX_FRAME_SIZE + 100) + b"\x00",
        "stuffing that points past its end": b"\x09abc\x00",
        "a few stray bytes": b"\x04abc\x00",
        "another version": encode_frame(dataclasses.replace(GOOD, version=2)),
        "unknown kind": encode_frame(dataclasses.replace(GOOD, kind=0x77)),
        "body a byte too long": encode_frame(dataclasses.replace(GOOD, body=GOOD.body + b"\x01")),
        "reserved bit of the mask set": encode_frame(
            dataclasses.replace(GOOD, body=_with_bit_turned(GOOD.body, 0, 3))
        ),
        "module 64": encode_frame(dataclasses.replace(GOOD, module=64)),
        "batch from a module": encode_frame(dataclasses.replace(batch, module=3)),
        "last entry of a batch cut short": encode_frame(dataclasses.replace(batch, body=batch.body[:-1])),
    }
    return {name: prefix + sent for name, prefix in damaged.items()}


def _damaged_can_traffic() -> dict[str, list[CanFrame]]:
    """Return damaged traffic by name; each ends with a good wire frame, which is to come through."""
    first, second, third = pieces = fragment(GOOD)
    short_identifier = CanFrame(0x123, b"\x01", is_extended=False)
    remote = dataclasses.replace(first, data=b"", is_remote=True)
    other_version = dataclasses.replace(first, identifier=first.identifier ^ 3 << 6)
    other_module = dataclasses.replace(second, identifier=second.identifier ^ 1 << 10)
    return {
        "second piece lost": [first, third, *pieces],
        "last piece lost": [first, second, *pieces],
        "second piece sent twice": [first, second, second, third, *pieces],
        "pieces out of order": [first, third, second, *pieces],
        "module of one piece changed": [first, other_module, third, *pieces],
        "one bit of a piece turned": [
            first,
            dataclasses.replace(second, data=_with_bit_turned(second.data, 2, 0)),
            third,
            *pieces,
        ],
        "traffic of others between": [first, short_identifier, second, remote, other_version, third],
    }


def _with_bit_turned(data: bytes, place: int, bit: int) -> bytes:
    return data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :]


def _vector(name: str, damaged: bytes, frames: WireFrameDecoder) -> dict[str, Any]:
    decoder = PacketDecoder(frames)
    packets = [received_as_json(received) for received in decoder.feed(damaged)]
    dropped = {defect.name: count for defect, count in decoder.dropped.items()}
    return {"name": name, "input": damaged.hex(), "dropped": dropped, "packets": packets}
