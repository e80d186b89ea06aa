"""Bodies of packets that are refused: by the encoder naming the field, by the decoder with a reason."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
from hypothesis import settings

from firmware_protocol import (
    Acknowledgement,
    Command,
    Defect,
    DeviceInfo,
    Event,
    FusedSample,
    Health,
    InertialSample,
    InertialSampleFine,
    LightSample,
    LocalMeasurement,
    LogLine,
    Packet,
    PassThrough,
    PressureSample,
    SamplingTrigger,
    SyncRequest,
    decode_body,
    encode_packet,
)

seeded = settings(deadline=None, derandomize=True)

G = 9.80665
INFO = DeviceInfo(b"0123456789ab", (1, 2), (3, 4, 5), 156.9, math.radians(2000), 4900.0, 100.0, 100.0, 20.0)
HEALTH = Health(50, 3.7, 31.25, -70, 1, 2, 3, 4, 5)
POSITION = LocalMeasurement(3, (1.0, 2.0, 3.0), (0.5, 0.5, 0.5))


NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("packet", "named"),
    [
        (InertialSample(specific_force=(0.0, NAN, 0.0)), "InertialSample.specific_force"),
        (InertialSample(magnetic_field=(INF, 0.0, 0.0)), "InertialSample.magnetic_field"),
        (InertialSampleFine(angular_rate=(0.0, 0.0, -INF)), "InertialSampleFine.angular_rate"),
        (InertialSample(specific_force=(0.0, 0.0)), "InertialSample.specific_force.*3 numbers"),
        (InertialSample(angular_rate=("1", "2", "3")), "InertialSample.angular_rate"),
        (InertialSample(angular_rate_clipped=True), "absent cannot be clipped"),
        (replace(POSITION, value=(NAN, 0.0, 0.0)), "LocalMeasurement.value"),
        (replace(POSITION, value=(1e39, 0.0, 0.0)), "LocalMeasurement.value.*too large"),
        (replace(POSITION, sigma=(0.1, INF, 0.1)), "LocalMeasurement.sigma"),
        (replace(POSITION, sigma=(0.1, -0.1, 0.1)), "LocalMeasurement.sigma"),
        (replace(POSITION, value=None), "LocalMeasurement.value"),
        (replace(POSITION, quantity=0), "LocalMeasurement.quantity"),
        (replace(POSITION, quantity=4), "LocalMeasurement.quantity"),
        (replace(INFO, unique_id=b"short"), "DeviceInfo.unique_id.*12 bytes"),
        (replace(INFO, firmware_version=(1, 2, 256)), "DeviceInfo.firmware_version.*u8"),
        (replace(INFO, hardware_version=(1, 2, 3)), "DeviceInfo.hardware_version"),
        (replace(INFO, accelerometer_range=6553.6), "DeviceInfo.accelerometer_range.*u16"),
        (replace(INFO, gyroscope_range=0.0), "DeviceInfo.gyroscope_range"),
        (replace(HEALTH, battery_percent=101), "Health.battery_percent"),
        (replace(HEALTH, battery_percent=50.5), "Health.battery_percent"),
        (replace(HEALTH, battery_voltage=65.535), "Health.battery_voltage"),
        (replace(HEALTH, temperature_celsius=NAN), "Health.temperature_celsius"),
        (replace(HEALTH, rssi_dbm=127), "Health.rssi_dbm"),
        (replace(HEALTH, uptime_s=-1), "Health.uptime_s"),
        (replace(HEALTH, resets=None), "Health.resets"),
        (FusedSample((1.1, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.01), "FusedSample.orientation"),
        (FusedSample((1.0, 0.0, 0.0, 0.0), (2200.0, 0.0, 0.0), 0.01), "FusedSample.displacement"),
        (FusedSample((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.01), "FusedSample.orientation.*4 numbers"),
        (FusedSample((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), -0.01), "FusedSample.interval"),
        (LightSample((1.1, 0.0, 0.0, 0.0, 0.0, 0.0)), "LightSample.intensity"),
        (PressureSample((0.0, 0.0, 0.0), INF, None), "PressureSample.static_pressure"),
        (PassThrough(1, b""), "PassThrough.data.*1 to 240"),
        (PassThrough(1, bytes(241)), "PassThrough.data.*1 to 240"),
        (PassThrough(4, b"a"), "PassThrough.format"),
        (LogLine(1, "é" * 101), "LogLine.text.*0 to 200"),
        (LogLine(1, "a\x00"), "LogLine.text.*zero"),
        (LogLine(1, b"bytes"), "LogLine.text.*text"),
        (Event(9), "Event.event"),
        (SyncRequest(1, 2**64), "SyncRequest.host_time_us.*u64"),
        (SamplingTrigger(65536), "SamplingTrigger.number.*u16"),
        (Command(1, 2, b"short"), "Command.unique_id.*12 bytes"),
        (Command(1, 2, arguments="text"), "Command.arguments.*bytes"),
        (Acknowledgement(1, 2, 10, bytes(12)), "Acknowledgement.result"),
        (Acknowledgement(1, 2, 0, bytes(12), bytes(201)), "Acknowledgement.payload.*0 to 200"),
    ],
)
def test_encoding_refuses_and_names_the_field(packet: Packet, named: str):
    with pytest.raises(ValueError, match=named):
        encode_packet(packet)


def local(quantity: int = 1, value: float = 0.0, sigma: float = 0.0) -> bytes:
    return struct.pack("<B6f", quantity, 0.0, value, 0.0, 0.0, 0.0, sigma)


@pytest.mark.parametrize(
    ("kind", "body", "defect"),
    [
        (0x77, b"", Defect.UNKNOWN_KIND),
        (0x20, b"", Defect.UNKNOWN_KIND),
        (0x10, b"", Defect.BAD_LENGTH),
        (0x10, b"\x08", Defect.BAD_VALUE),
        (0x10, b"\x10", Defect.BAD_VALUE),
        (0x10, b"\x01" + bytes(5), Defect.BAD_LENGTH),
        (0x10, b"\x01" + bytes(7), Defect.BAD_LENGTH),
        (0x10, b"\x07" + bytes(12), Defect.BAD_LENGTH),
        (0x11, b"\x01" + bytes(6), Defect.BAD_LENGTH),
        (0x18, local()[:-1], Defect.BAD_LENGTH),
        (0x18, local(quantity=0), Defect.BAD_VALUE),
        (0x18, local(quantity=4), Defect.BAD_VALUE),
        (0x18, local(value=NAN), Defect.BAD_VALUE),
        (0x18, local(value=INF), Defect.BAD_VALUE),
        (0x18, local(sigma=NAN), Defect.BAD_VALUE),
        (0x18, local(sigma=-0.5), Defect.BAD_VALUE),
        (0x30, bytes(28), Defect.BAD_LENGTH),
        (0x31, bytes(21), Defect.BAD_LENGTH),
        (0x31, b"\x65" + bytes(19), Defect.BAD_VALUE),
        (0x12, bytes(23), Defect.BAD_LENGTH),
        (0x19, bytes(13), Defect.BAD_LENGTH),
        (0x1A, struct.pack("<4fh", 0, 0, NAN, 0, 0), Defect.BAD_VALUE),
        (0x1A, struct.pack("<4fh", 0, 0, 0, -INF, 0), Defect.BAD_VALUE),
        (0x1B, b"\x01", Defect.BAD_LENGTH),
        (0x1B, b"\x01" + bytes(241), Defect.BAD_LENGTH),
        (0x1B, b"\x04a", Defect.BAD_VALUE),
        (0x32, b"\x00\x00", Defect.BAD_VALUE),
        (0x32, b"\x09\x00", Defect.BAD_VALUE),
        (0x32, b"\x01", Defect.BAD_LENGTH),
        (0x33, b"", Defect.BAD_LENGTH),
        (0x33, b"\x05a", Defect.BAD_VALUE),
        (0x33, b"\x01" + b"a" * 201, Defect.BAD_LENGTH),
        (0x33, b"\x01\xc2", Defect.BAD_VALUE),
        (0x33, b"\x01a\x00", Defect.BAD_VALUE),
        (0x40, bytes(9), Defect.BAD_LENGTH),
        (0x41, bytes(11), Defect.BAD_LENGTH),
        (0x42, bytes(3), Defect.BAD_LENGTH),
        (0x50, bytes(14), Defect.BAD_LENGTH),
        (0x50, bytes(15 + 201), Defect.BAD_LENGTH),
        (0x51, bytes(16 + 201), Defect.BAD_LENGTH),
        (0x51, bytes(3) + b"\x0a" + bytes(12), Defect.BAD_VALUE),
        (0x5E, bytes(4), Defect.BAD_VALUE),
        (0x5F, b"\x01" + bytes(3 + 242), Defect.BAD_LENGTH),
    ],
)
def test_decoding_refuses_with_a_reason(kind: int, body: bytes, defect: Defect):
    assert decode_body(kind, body) is defect


@pytest.mark.parametrize("kind", [0x10, 0x11])
def test_no_mask_is_accepted_with_another_length_than_its_own(kind: int):
    size = {0x10: 6, 0x11: 12}[kind]
    for mask in range(256):
        n_sensors = (mask & 7).bit_count()
        is_valid = not mask & 8 and (mask >> 4 & 7) & ~mask & 7 == 0
        decoded = [
            length
            for length in range(1, 45)
            if not isinstance(decode_body(kind, bytes([mask]) + bytes(length - 1)), Defect)
        ]
        assert decoded == ([1 + n_sensors * size] if is_valid else [])
