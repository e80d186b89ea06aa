"""Bodies of packets: against numbers worked out by hand, there and back, and those that are refused."""

from __future__ import annotations

import math
import struct
from dataclasses import fields, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol import (
    PACKETS,
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
    SyncResponse,
    TransferToHost,
    TransferToModule,
    decode_body,
    encode_packet,
)
from firmware_protocol.fields import INTEGER_RANGE, WireField, layout_of

seeded = settings(deadline=None, derandomize=True)

G = 9.80665
INFO = DeviceInfo(b"0123456789ab", (1, 2), (3, 4, 5), 156.9, math.radians(2000), 4900.0, 100.0, 100.0, 20.0)
HEALTH = Health(50, 3.7, 31.25, -70, 1, 2, 3, 4, 5)
POSITION = LocalMeasurement(3, (1.0, 2.0, 3.0), (0.5, 0.5, 0.5))
NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("kind", "body", "packet"),
    [
        (
            0x10,
            struct.pack("<B3h", 0x01, 2048, -2048, 32767),
            InertialSample(specific_force=(G, -G, 16 * G * 32767 / 32768)),
        ),
        (0x10, struct.pack("<B3h", 0x02, 20, -40, 0), InertialSample(magnetic_field=(1.0, -2.0, 0.0))),
        (
            0x10,
            struct.pack("<B3h", 0xC4, 16384, -32768, 0),
            InertialSample(
                angular_rate=(math.radians(1000), -math.radians(2000), 0.0),
                angular_rate_clipped=True,
                triggered=True,
            ),
        ),
        (
            0x10,
            struct.pack("<B9h", 0x37, 2048, 0, 0, 0, 20, 0, 0, 0, 16384),
            InertialSample((G, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, math.radians(1000)), True, True),
        ),
        (
            0x11,
            struct.pack("<B9i", 0x07, 980665, 0, -1, 500000, 0, 1, 1000000, 0, -1),
            InertialSampleFine((G, 0.0, -1e-5), (50.0, 0.0, 1e-4), (1.0, 0.0, -1e-6)),
        ),
        (
            0x18,
            struct.pack("<B6f", 2, 1.5, -2.5, 0.0, 0.25, 0.5, 0.0),
            LocalMeasurement(quantity=2, value=(1.5, -2.5, 0.0), sigma=(0.25, 0.5, 0.0)),
        ),
        (
            0x30,
            b"0123456789ab" + struct.pack("<5B6H", 1, 2, 3, 4, 5, 1569, 2000, 4900, 1000, 1000, 200),
            INFO,
        ),
        (
            0x30,
            b"0123456789ab" + struct.pack("<5B6H", 1, 2, 3, 4, 5, 1569, 0, 0, 1000, 0, 0),
            DeviceInfo(b"0123456789ab", (1, 2), (3, 4, 5), 156.9, None, None, 100.0, None, None),
        ),
        (0x31, struct.pack("<BHhbIIHHH", 50, 3700, 3125, -70, 1, 2, 3, 4, 5), HEALTH),
        (
            0x31,
            struct.pack("<BHhbIIHHH", 255, 65535, -32768, 127, 2**32 - 1, 0, 65535, 0, 0),
            Health(None, None, None, None, 2**32 - 1, 0, 65535, 0, 0),
        ),
        (
            0x12,
            struct.pack("<4h3iI", 32767, 0, -32767, 16384, 1_000_000, -1, 250, 10_000),
            FusedSample((1.0, 0.0, -1.0, 16384 / 32767), (1.0, -1e-6, 2.5e-4), 0.01),
        ),
        (
            0x19,
            struct.pack("<6H", 65535, 0, 13107, 1, 0, 0),
            LightSample((1.0, 0.0, 0.2, 1 / 65535, 0.0, 0.0)),
        ),
        (
            0x1A,
            struct.pack("<4fh", 1.5, -2.5, 0.0, 101325.0, 2150),
            PressureSample((1.5, -2.5, 0.0), 101325.0, 21.5),
        ),
        (0x1A, struct.pack("<4fh", 0, 0, 0, 1, -(2**15)), PressureSample((0.0, 0.0, 0.0), 1.0, None)),
        (0x1B, b"\x02\xb5\x62\x00", PassThrough(2, b"\xb5\x62\x00")),
        (0x1B, b"\x03" + bytes(240), PassThrough(3, bytes(240))),
        (0x32, b"\x03\x02", Event(3, 2)),
        (0x33, b"\x02" + "µ".encode(), LogLine(2, "µ")),
        (0x33, b"\x01", LogLine(1, "")),
        (0x40, struct.pack("<HQ", 7, 2**64 - 1), SyncRequest(7, 2**64 - 1)),
        (0x41, struct.pack("<HII", 7, 2**32 - 1, 3), SyncResponse(7, 2**32 - 1, 3)),
        (0x42, b"\x01\x02", SamplingTrigger(0x201)),
        (0x50, b"\x07\x00\x0b" + bytes(12) + b"\x01\x09", Command(7, 11, bytes(12), b"\x01\x09")),
        (0x50, b"\x07\x00\xfe" + b"0123456789ab", Command(7, 0xFE, b"0123456789ab")),
        (
            0x51,
            b"\x07\x00\x0b\x03" + b"0123456789ab" + b"\x01",
            Acknowledgement(7, 11, 3, b"0123456789ab", b"\x01"),
        ),
        (0x5E, b"\x01\x05\x2c\x01abc", TransferToModule(1, 5, 300, b"abc")),
        (0x5F, b"\x02\x05\x01\x00", TransferToHost(2, 5, 1)),
    ],
)
def test_decoded_values_are_those_worked_out_by_hand(kind: int, body: bytes, packet: Packet):
    decoded = decode_body(kind, body)
    assert type(decoded) is type(packet)
    for f in fields(packet):
        expected, value = getattr(packet, f.name), getattr(decoded, f.name)
        assert value == (
            expected if isinstance(expected, bytes | str | bool | None) else pytest.approx(expected)
        )


def elements(declared: WireField) -> st.SearchStrategy[Any]:
    """Any decoded element that the field can carry without clipping."""
    if declared.meanings:
        return st.sampled_from(sorted(declared.meanings))
    if declared.code == "f":
        return st.floats(declared.minimum, allow_nan=False, allow_infinity=False, width=32)
    low, high = INTEGER_RANGE[declared.code]
    numbers = st.integers(max(low, -high), high if declared.maximum is None else int(declared.maximum))
    numbers = numbers.filter(lambda number: number != declared.absent)
    if declared.scale is None:
        return numbers
    # Anywhere within the step around a number, not only on it.
    return st.builds(
        lambda number, offset: (number + offset) * declared.scale, numbers, st.floats(-0.49, 0.49)
    )


def values(declared: WireField) -> st.SearchStrategy[Any]:
    if declared.is_text:
        largest = declared.max_size or declared.count
        texts = st.text(st.characters(min_codepoint=1, codec="utf-8"), max_size=largest)
        return texts.filter(lambda text: len(text.encode()) <= largest)
    if declared.is_rest:
        return st.binary(min_size=declared.min_size, max_size=declared.max_size)
    if declared.code == "s":
        return st.binary(min_size=declared.count, max_size=declared.count)
    whole = elements(declared)
    if declared.count > 1:
        whole = st.tuples(*[whole] * declared.count)
    is_optional = declared.absent is not None or declared.presence_bit is not None
    return st.none() | whole if is_optional else whole


packets = st.one_of(
    *(
        st.builds(
            packet_class,
            **{f.name: values(f) for f in layout_of(packet_class).fields},
            **({"triggered": st.booleans()} if layout_of(packet_class).flags else {}),
        )
        for packet_class in PACKETS.values()
    )
)


@seeded
@given(packets)
def test_round_trip_within_half_a_step(packet: Packet):
    decoded = decode_body(packet.KIND, encode_packet(packet))
    assert type(decoded) is type(packet)
    for declared in layout_of(type(packet)).fields:
        sent, received = getattr(packet, declared.name), getattr(decoded, declared.name)
        if sent is None or declared.scale is None:
            assert received == sent
        else:
            assert received == pytest.approx(sent, rel=1e-12, abs=declared.scale / 2)
    for declared_flag in layout_of(type(packet)).flags:
        assert getattr(decoded, declared_flag.name) == getattr(packet, declared_flag.name)


@seeded
@given(st.sampled_from(sorted(PACKETS)), st.binary(max_size=40))
def test_arbitrary_bodies_never_raise(kind: int, body: bytes):
    assert isinstance(decode_body(kind, body), Defect | PACKETS[kind])


@seeded
@given(st.sampled_from(sorted(PACKETS)), st.data())
def test_what_decodes_encodes_to_the_same_bytes(kind: int, data: st.DataObject):
    layout = layout_of(PACKETS[kind])
    mask = data.draw(st.sampled_from(layout.valid_masks()))
    least, most = (size - layout.has_mask for size in layout.sizes(mask))
    body = bytes([mask] * layout.has_mask) + data.draw(st.binary(min_size=least, max_size=most))
    packet = decode_body(kind, body)
    if isinstance(packet, Defect):
        assert packet is Defect.BAD_VALUE
        return
    raw = struct.unpack_from(layout.struct_format(mask), body)
    if -(2**15) in raw or -(2**31) in raw:
        return  # below the least number that encoding gives
    assert encode_packet(packet) == body


SENSORS = ("specific_force", "magnetic_field", "angular_rate")


@pytest.mark.parametrize(
    ("packet_class", "limit"), [(InertialSample, 2**15 - 1), (InertialSampleFine, 2**31 - 1)]
)
@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("beyond", [1.0001, 3.0, 1e300])
def test_readings_beyond_the_range_are_sent_as_its_end_and_marked(
    packet_class: type[InertialSample], limit: int, sensor: str, beyond: float
):
    (declared,) = (f for f in layout_of(packet_class).fields if f.name == sensor)
    end = limit * declared.scale
    packet = packet_class(
        **dict.fromkeys(SENSORS, (0.0, 0.0, 0.0)) | {sensor: (end * beyond, -end * beyond, 0.0)}
    )
    decoded = decode_body(packet.KIND, encode_packet(packet))
    assert isinstance(decoded, packet_class)
    assert getattr(decoded, sensor) == pytest.approx((end, -end, 0.0), rel=1e-12)
    for each in SENSORS:
        assert getattr(decoded, f"{each}_clipped") is (each == sensor)


def test_a_reading_at_the_end_of_the_range_is_not_clipped_by_encoding():
    end = 32767 * 16 * G / 32768
    decoded = decode_body(0x10, encode_packet(InertialSample(specific_force=(end, -end, 0.0))))
    assert isinstance(decoded, InertialSample)
    assert decoded.specific_force_clipped is False


def test_a_sensor_clipped_below_the_range_of_the_wire_stays_marked():
    sample = InertialSample(angular_rate=(8.7, 0.0, 0.0), angular_rate_clipped=True)
    decoded = decode_body(0x10, encode_packet(sample))
    assert isinstance(decoded, InertialSample)
    assert decoded.angular_rate_clipped is True


@pytest.mark.parametrize("packet_class", PACKETS.values())
def test_every_declaration_says_all_a_generator_needs(packet_class: type[Packet]):
    layout = layout_of(packet_class)
    names = [f.name for f in fields(packet_class)]
    assert [f.name for f in layout.fields] + [f.name for f in layout.flags] == names
    assert all(f.sentence.endswith(".") for f in (*layout.fields, *layout.flags))
    assert all(f.unit for f in layout.fields if f.scale is not None)
    assert not any(f.is_rest for f in layout.fields[:-1])
    bits = [f.presence_bit for f in layout.fields if f.presence_bit is not None] + [
        f.bit for f in layout.flags
    ]
    assert len(bits) == len(set(bits))


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
