"""The examples that become golden vectors: at least one wire frame of every kind."""

from __future__ import annotations

import dataclasses
import math

from firmware_protocol.can_transfer import FlowControl, FlowStatus, PieceType, flow_control_piece
from firmware_protocol.commands import Result, Verb, encode_arguments, encode_payload
from firmware_protocol.framing import BROADCAST, WireFrame
from firmware_protocol.golden_defects import GOOD
from firmware_protocol.packets import (
    Acknowledgement,
    Command,
    DeviceInfo,
    Event,
    FusedSample,
    Health,
    InertialSample,
    InertialSampleFine,
    LightSample,
    LocalMeasurement,
    LogLine,
    PassThrough,
    PressureSample,
    SamplingTrigger,
    SyncRequest,
    SyncResponse,
    TransferToHost,
    TransferToModule,
    wire_frame,
)
from firmware_protocol.relay import relay_batch

UNIQUE_ID = bytes(range(12))
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
    unique_id=UNIQUE_ID,
    hardware_version=(2, 1),
    firmware_version=(1, 4, 12),
    accelerometer_range=156.9,
    gyroscope_range=math.radians(2000),
    magnetometer_range=None,
    accelerometer_sampling_rate=100.0,
    gyroscope_sampling_rate=100.0,
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
_FUSED = FusedSample(orientation=(0.5, -0.5, 0.5, 0.5), displacement=(0.001234, -0.25, 1.5), interval=0.01)
_DARK = LightSample((0.0, 1.0, 0.25, 0.5, 0.75, 1 / 65535))
_PRESSURE = PressureSample((12.5, -3.75, 0.0), static_pressure=101_325.0, temperature_celsius=21.5)
_NMEA = b"$GNVTG,84.4,T,,M,1.2,N,2.2,K,A*1E\r\n"
_WRITE_RATE = Command(7, Verb.WRITE_SETTING, arguments=encode_arguments(Verb.WRITE_SETTING, 2, b"\xd0\x07"))
_ADDRESSED = Command(8, Verb.IDENTIFY, UNIQUE_ID, encode_arguments(Verb.IDENTIFY, 10))
_WRITTEN = Acknowledgement(
    7, Verb.WRITE_SETTING, Result.DONE, UNIQUE_ID, encode_payload(Verb.WRITE_SETTING, 2, b"\xd0\x07")
)
_LOCKED = Acknowledgement(9, Verb.FACTORY_RESET, Result.REFUSED, UNIQUE_ID)

_FRAMES: dict[str, WireFrame] = {
    "accelerometer and gyroscope": GOOD,
    "all three sensors": wire_frame(_ALL_SENSORS, 16, 65_535, 2**32 - 1),
    "beyond the range, clipped, on a trigger": wire_frame(_BEYOND_RANGE, 0, 0, 0),
    "no sensor read": wire_frame(InertialSample(), 63, 256, 65_536),
    "fine steps": wire_frame(_FINE, 5, 1000, 123_456_789),
    "position": wire_frame(_POSITION, 40, 2, 500_000),
    "module without magnetometer": wire_frame(_INFO, 7, 1, 100),
    "health": wire_frame(_HEALTH, 7, 9, 1_000_000),
    "health of a wired module": wire_frame(_HEALTH_UNKNOWN, 8, 9, 1_000_000),
    "health of the relay": wire_frame(_HEALTH, 254, 9, 1_000_000),
    "orientation fused on the module": wire_frame(_FUSED, 9, 4, 2_000_000),
    "photoelectric cells": wire_frame(_DARK, 10, 5, 2_000_100),
    "pressure tubes": wire_frame(_PRESSURE, 41, 6, 2_000_200),
    "pressure tubes without thermometer": wire_frame(
        dataclasses.replace(_PRESSURE, temperature_celsius=None), 41, 7, 2_000_300
    ),
    "a sentence of NMEA": wire_frame(PassThrough(1, _NMEA), 42, 8, 2_000_400),
    "two taps": wire_frame(Event(event=3, value=2), 9, 0, 2_000_500),
    "a line of the log": wire_frame(LogLine(level=2, text="température élevée"), 9, 1, 2_000_600),
    "an empty line of the log": wire_frame(LogLine(level=4, text=""), 9, 2, 2_000_700),
    "request for a module's clock": wire_frame(
        SyncRequest(token=513, host_time_us=1_795_000_000_123_456), 9, 3, 11
    ),
    "the module's clock": wire_frame(SyncResponse(513, 2**32 - 2, 150), 9, 3, 150),
    "trigger for all": wire_frame(SamplingTrigger(number=65_535), BROADCAST, 12, 13),
    "write a setting": wire_frame(_WRITE_RATE, 9, 14, 15),
    "to the device of one unique id": wire_frame(_ADDRESSED, BROADCAST, 15, 16),
    "a setting was written": wire_frame(_WRITTEN, 9, 16, 2_000_800),
    "refused": wire_frame(_LOCKED, 9, 17, 2_000_900),
    "first piece of 300 bytes": wire_frame(
        TransferToModule(PieceType.FIRST, 5, 300, bytes(range(1, 42))), 9, 18, 19
    ),
    "flow control: continue at piece 1, 8 of them, 1 ms apart": wire_frame(
        flow_control_piece(TransferToHost, 5, FlowControl(1, FlowStatus.CONTINUE, 8, 0.001)), 9, 19, 2_001_000
    ),
}
_SMALL_BATCH = relay_batch(list(_FRAMES.values())[:3], 77, 4_000_000)
_SUIT_BATCH = relay_batch([wire_frame(_ALL_SENSORS, m, 500, 5_000_000 + m) for m in range(17)], 78, 5_001_000)

FRAMES = _FRAMES | {"relay batch of three": _SMALL_BATCH, "relay batch of a suit": _SUIT_BATCH}
"""Every example by name."""
