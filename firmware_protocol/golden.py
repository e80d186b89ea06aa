"""Writes the golden vectors: wire bytes with what they mean, for firmware authors and for the tests.

::

    python -m firmware_protocol.golden

The tests compare against the committed files, so a change of the wire cannot pass unnoticed.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from firmware_protocol.can_framing import MAX_CAN_BODY_SIZE, MAX_CLASSIC_BODY_SIZE, fragment
from firmware_protocol.can_records import CanFrame, pack_can_records
from firmware_protocol.framing import PROTOCOL_VERSION, FrameDecoder, WireFrame, encode_frame
from firmware_protocol.golden_defects import GOOD, defect_vectors, received_as_json
from firmware_protocol.kinds import Kind
from firmware_protocol.packets import (
    DeviceInfo,
    Health,
    InertialSample,
    InertialSampleFine,
    LocalMeasurement,
    PacketDecoder,
    wire_frame,
)
from firmware_protocol.relay import relay_batch

VECTORS = Path(__file__).parent / "vectors"

_ALL_SENSORS = InertialSample(
    specific_force=(-1.5, 3.25, 9.0), magnetic_field=(19.8, -3.1, -42.7), angular_rate=(0.5, -1.25, 12.0)
)
_BEYOND_RANGE = InertialSample(
    specific_force=(400.0, -400.0, 9.81), angular_rate=(0.0, 0.0, 40.0), triggered=True
)
_FINE = InertialSampleFine(
    specific_force=(0.01234, -0.5, 9.80665),
    magnetic_field=(19.8765, -3.1, -42.7),
    angular_rate=(1e-6, -2.5, 0.0),
)
_POSITION = LocalMeasurement(quantity=3, value=(1.25, -0.5, 0.75), sigma=(0.125, 0.125, 0.25))
_INFO = DeviceInfo(
    unique_id=bytes(range(12)),
    hardware_version=(2, 1),
    firmware_version=(1, 4, 12),
    accelerometer_range=156.9,
    gyrometer_range=math.radians(2000),
    magnetometer_range=None,
    accelerometer_sampling_rate=100.0,
    gyrometer_sampling_rate=100.0,
    magnetometer_sampling_rate=None,
)
_HEALTH = Health(
    battery_percent=87,
    battery_voltage=3.912,
    temperature_celsius=-4.25,
    rssi_dbm=-61,
    uptime_s=86_400,
    samples_taken=8_640_000,
    samples_dropped=3,
    sensor_errors=0,
    resets=12,
)
_HEALTH_UNKNOWN = dataclasses.replace(
    _HEALTH, battery_percent=None, battery_voltage=None, temperature_celsius=None, rssi_dbm=None
)

_FRAMES: dict[str, WireFrame] = {
    "accelerometer and gyrometer": GOOD,
    "all three sensors": wire_frame(_ALL_SENSORS, 16, 65_535, 2**32 - 1),
    "beyond the range, clipped, on a trigger": wire_frame(_BEYOND_RANGE, 0, 0, 0),
    "no sensor read": wire_frame(InertialSample(), 63, 256, 65_536),
    "fine steps": wire_frame(_FINE, 5, 1000, 123_456_789),
    "position": wire_frame(_POSITION, 40, 2, 500_000),
    "module without magnetometer": wire_frame(_INFO, 7, 1, 100),
    "health": wire_frame(_HEALTH, 7, 9, 1_000_000),
    "health of a wired module": wire_frame(_HEALTH_UNKNOWN, 8, 9, 1_000_000),
    "health of the relay": wire_frame(_HEALTH, 254, 9, 1_000_000),
}
_SMALL_BATCH = relay_batch(list(_FRAMES.values())[:3], 77, 4_000_000)
_SUIT_BATCH = relay_batch([wire_frame(_ALL_SENSORS, m, 500, 5_000_000 + m) for m in range(17)], 78, 5_001_000)

FRAMES = _FRAMES | {"relay batch of three": _SMALL_BATCH, "relay batch of a suit": _SUIT_BATCH}
"""Every example by name."""


def packet_vectors() -> dict[str, Any]:
    """What ``vectors/packets.json`` holds."""
    vectors = [_packet_vector(name, frame) for name, frame in FRAMES.items()]
    return {"protocol_version": PROTOCOL_VERSION, "vectors": vectors}


def _packet_vector(name: str, frame: WireFrame) -> dict[str, Any]:
    sent = encode_frame(frame)
    classic = fragment(frame) if len(frame.body) <= MAX_CLASSIC_BODY_SIZE else None
    fd = fragment(frame, fd=True) if len(frame.body) <= MAX_CAN_BODY_SIZE else None
    return {
        "name": name,
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


def write(folder: Path) -> None:
    """Writes every file of vectors into a folder."""
    for name, content in (("packets", packet_vectors()), ("defects", defect_vectors())):
        (folder / f"{name}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(VECTORS)
