"""How wire frames and packets are written in the golden vectors."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

from firmware_protocol.can_framing import MAX_CAN_BODY_SIZE, MAX_CLASSIC_BODY_SIZE, fragment
from firmware_protocol.can_records import CanFrame, pack_can_records
from firmware_protocol.framing import FrameDecoder, WireFrame, encode_frame
from firmware_protocol.kinds import Kind
from firmware_protocol.packets import PacketDecoder, ReceivedPacket


def frame_vector(frame: WireFrame) -> dict[str, Any]:
    """Return a wire frame on every link, and the packets it holds."""
    sent = encode_frame(frame)
    # A body that is too long for a bus has no form there, which is null in the file.
    classic = fragment(frame) if len(frame.body) <= MAX_CLASSIC_BODY_SIZE else None
    fd = fragment(frame, fd=True) if len(frame.body) <= MAX_CAN_BODY_SIZE else None
    return {
        "kind": frame.kind,
        "kind_name": Kind(frame.kind).name,
        "module": frame.module,
        "sequence": frame.sequence,
        "module_time_us": frame.module_time_us,
        "body": frame.body.hex(),
        "byte_stream": sent.hex(),
        "can_classic": classic and _can_vector(classic),
        "can_fd": fd and _can_vector(fd),
        "packets": [received_as_json(received) for received in PacketDecoder(FrameDecoder()).feed(sent)],
    }


def _can_vector(frames: Iterable[CanFrame]) -> dict[str, Any]:
    frames = list(frames)
    return {
        "frames": [{"identifier": f"0x{f.identifier:08x}", "data": f.data.hex()} for f in frames],
        "records": pack_can_records(frames).hex(),
    }


def received_as_json(received: ReceivedPacket) -> dict[str, Any]:
    """Return a received packet as JSON holds it: tuples as lists, bytes as hex."""
    values = dataclasses.asdict(received.packet)
    return {
        "kind": received.kind,
        "module": received.module,
        "sequence": received.sequence,
        "module_time_us": received.module_time_us,
        "type": type(received.packet).__name__,
        "values": {name: as_json(value) for name, value in values.items()},
    }


def as_json(value: Any) -> Any:
    """Return a value as JSON holds it: tuples as lists, bytes as hex."""
    if isinstance(value, bytes):
        return value.hex()
    return [as_json(element) for element in value] if isinstance(value, tuple) else value
