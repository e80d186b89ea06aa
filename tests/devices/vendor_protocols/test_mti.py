"""Messages of an MTi: what real ones sent, round trips, and bytes that are none."""

from __future__ import annotations

import math
import re
import struct
from collections import Counter

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.vendor_protocols.mti import (
    AXES,
    CAN_COUNTER,
    CAN_ITEMS,
    CAN_STATUS,
    CAN_TIME,
    CLIPPED,
    ITEMS,
    NUMBERS,
    Measurement,
    Mid,
    MtiCanDecoder,
    MtiDecoder,
    Reply,
    decode_items,
    encode,
    encode_can,
    encode_item,
    encode_output_configuration,
    read_output_configuration,
)
from firmware_protocol import unpack_can_records

FORMATS = ("Float32", "FP1220", "FP1632", "Float64")
NAMES = {
    "RateOfTurn": "rate_of_turn",
    "BaroPressure": "baro_pressure",
    "DeltaQ": "delta_q",
    "DeltaV": "delta_v",
    "GNSSPVTData": "gnss_pvt",
    "PositionECEF": "position_ecef",
    "LatLon": "lat_lon",
    "UTCTime": "utc",
    "VelocityXYZ": "velocity",
}


@pytest.fixture(params=range(1, 6))
def captured(request, recording_set):
    """(bytes, golden text, messages in hexadecimal, output configuration and its golden) of a real device."""
    folder = recording_set("live_captures") / "xsens_mti"

    def read(name):
        return (folder / f"{request.param}.{name}").read_bytes()

    texts = [read(name).decode() for name in ("output.golden", "messages.golden", "outputconfig.golden")]
    return read("output.bin"), texts[0], texts[1].split(), read("outputconfig.bin"), texts[2]


def name_of(text):
    word = text.partition("(")[0]
    return NAMES.get(word) or re.sub(r"(?<=[a-z])(?=[A-Z])", "_", word).lower()


def goldens(text):
    """The items of each measurement, by name: the lines under it."""
    for block in text.strip("\n").split("\n\n"):
        items, name = {}, ""
        for line in block.split("\n"):
            if line.startswith("  "):
                items[name].append(line.strip())
            else:
                name = line.rstrip(":")
                items[name] = []
        yield items


def as_told(name, values):
    """The lines of a golden that values are."""
    if name == "utc":
        ns, year, month, day, hour, minute, second, _ = map(int, values)
        fraction = f".{ns:09d}".rstrip("0").rstrip(".")
        return [f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}:{second:02d}{fraction}Z"]
    if name.startswith("status"):
        return [f"{int(values[0]):0{8 if name == 'status_byte' else 32}b}"]
    return list(values)


def told(line):
    value = line.rpartition(":")[2]
    return float(value)


def test_every_measurement_of_a_real_device_is_read_as_it_is(captured):
    data, text, messages, *_ = captured
    decoder = MtiDecoder()
    found = [message for at in range(0, len(data), 7) for message in decoder.feed(data[at : at + 7])]
    assert not decoder.dropped
    assert len(found) == len(messages) == 100
    for measurement, golden in zip(found, goldens(text), strict=True):
        names = {name_of(each): each for each in golden}
        unknown = set(names) - set(measurement.values)
        assert unknown <= {"gnsssat_info"}, unknown
        assert set(measurement.values) <= set(names)
        for name, values in measurement.values.items():
            lines = golden[names[name]]
            if name in ("utc", "status_byte", "status_word"):
                assert as_told(name, values) == lines
            else:
                assert list(values) == [pytest.approx(told(line), rel=1e-15, abs=0) for line in lines], name
            if "EastNorthUp" in names[name]:
                assert measurement.axes == "ENU"


def test_messages_are_put_together_as_the_device_did(captured):
    _, _, messages, *_ = captured
    decoder = MtiDecoder()
    for text in messages:
        data = bytes.fromhex(text)
        assert len(decoder.feed(data)) == 1
        payload = data[6:-1] if data[3] == 0xFF else data[4:-1]
        assert encode(Mid.MT_DATA_2, payload) == data


def test_the_output_configuration_is_read(captured):
    *_, data, text = captured
    expected, name = {}, ""
    for line in text.split("\n"):
        if line.startswith("  "):
            word = line.split()[0]
            expected[name] = 0xFFFF if word == "Max" else int(word)
        else:
            name = name_of(line.rstrip(":"))
    found = read_output_configuration(data)
    assert {name: rate for name, rate in found.items() if not name.startswith("0x")} == {
        name: rate for name, rate in expected.items() if name in ITEMS
    }


singles = st.floats(-30.0, 30.0, width=32)
vectors = st.tuples(singles, singles, singles)


@given(vectors, vectors, vectors, st.integers(0, 3), st.integers(0, 2), st.lists(st.integers(1, 40)))
def test_every_number_format_and_axes_come_back_however_the_bytes_are_cut(a, w, v, number, axes, cuts):
    items = [encode_item("packet_counter", [7]), encode_item("acceleration", a, number, axes)]
    items += [encode_item("rate_of_turn", w, number, axes), encode_item("velocity", v, number, axes)]
    data = encode(Mid.MT_DATA_2, b"".join(items))
    decoder, found = MtiDecoder(), []
    for cut in [*cuts, len(data)]:
        found += decoder.feed(data[:cut])
        data = data[cut:]
    (measurement,) = found
    assert measurement.axes == AXES[axes]
    assert measurement.whole("packet_counter") == 7
    exact = [2**-24, 2**-20, 2**-32, 0][number]
    for name, values in (("acceleration", a), ("rate_of_turn", w), ("velocity", v)):
        assert measurement.values[name] == pytest.approx(values, abs=exact, rel=0)


@given(st.binary(max_size=400))
def test_noise_raises_nothing_and_costs_no_message_after_it(noise):
    good = encode(Mid.MT_DATA_2, encode_item("acceleration", (0, 0, 9.81)))
    decoder = MtiDecoder()
    # a length that noise announces may be as much as the longest message
    found = decoder.feed(noise + good) + decoder.feed(bytes(2100))
    assert any(isinstance(each, Measurement) and "acceleration" in each.values for each in found)


@given(st.binary(max_size=300))
def test_no_payload_raises(data):
    MtiDecoder().feed(encode(Mid.MT_DATA_2, data))
    read_output_configuration(data)
    MtiCanDecoder().feed(data)


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (encode(Mid.MT_DATA_2, encode_item("acceleration", (0, 0, 251.0))), "force_beyond_sensor"),
        (encode(Mid.MT_DATA_2, encode_item("rate_of_turn", (0, 41.0, 0))), "rate_beyond_sensor"),
        (encode(Mid.MT_DATA_2, encode_item("magnetic_field", (-101.0, 0, 0))), "field_beyond_sensor"),
        (encode(Mid.MT_DATA_2, encode_item("acceleration", (0, math.nan, 0))), "not_finite"),
        (encode(Mid.MT_DATA_2, b"\x40\x20\x0c\x00"), "bad_item"),
        (encode(Mid.MT_DATA_2, b"\x40\x20\x0b" + bytes(11)), "bad_item"),
        (b"\xfa\xff\x36\x01\x00\x00", "bad_checksum"),
        (b"\x01\x02", "noise"),
    ],
)
def test_what_cannot_be_is_dropped_and_counted_by_reason(message, reason):
    decoder = MtiDecoder()
    assert decoder.feed(message) == []
    assert reason in decoder.dropped


def test_other_messages_are_handed_on_long_ones_too():
    configuration = encode_output_configuration({"acceleration": 100, "packet_counter": 0xFFFF}, 3)
    decoder = MtiDecoder()
    found = decoder.feed(encode(Mid.OUTPUT_CONFIGURATION + 1, configuration) + encode(0x90, bytes(700)))
    assert found == [Reply(0xC1, configuration), Reply(0x90, bytes(700))]
    assert read_output_configuration(configuration) == {"acceleration": 100, "packet_counter": 0xFFFF}
    assert configuration[:2] == b"\x40\x23"


@pytest.fixture(scope="module")
def dbc(recording_set):
    path = recording_set("live_captures") / "xsens_can_dbc" / "xsens.dbc"
    return cantools.database.load_file(path, strict=False)


def test_the_bits_of_clipping_are_those_of_the_status_word_on_can(dbc):
    signals = dbc.get_message_by_name("StatusWord").signals
    for name, sensor in (("acceleration", "Acc"), ("rate_of_turn", "Gyr"), ("magnetic_field", "Mag")):
        data = CLIPPED[name].to_bytes(4, "big")
        set_bits = {each.name for each in signals if data[each.start // 8] >> each.start % 8 & 1}
        assert {each for each in set_bits if each.startswith("Clip")} >= {f"Clip{sensor}{a}" for a in "XYZ"}
        assert sum(map(int.bit_count, data)) == 3


counts = st.integers(-(2**15), 2**15 - 1)


@given(st.lists(counts, min_size=4, max_size=4), st.integers(0, 2**32 - 1), st.integers(0, 2**16 - 1))
def test_frames_on_can_are_what_the_description_of_the_bus_says(dbc, numbers, time_us, count):
    names = {"quaternion": "Quaternion", "rate_of_turn": "RateOfTurn", "acceleration": "Acceleration"}
    names |= {"free_acceleration": "FreeAcceleration", "magnetic_field": "MagneticField"}
    values = {
        item.name: [n * item.unit for n in numbers[: 4 if item.name == "quaternion" else 3]]
        for item in CAN_ITEMS
    }
    data = encode_can({**values, "sample_time_us": [time_us], "packet_counter": [count], "status_word": [5]})
    frames = {frame.identifier: frame.data for frame in unpack_can_records(data)}
    for item in CAN_ITEMS:
        decoded = dbc.get_message_by_name(names[item.name]).decode(frames[item.identifier])
        assert list(decoded.values()) == pytest.approx(values[item.name], rel=1e-9, abs=1e-12)
    by_name = {CAN_TIME: ("SampleTime", time_us), CAN_COUNTER: ("GroupCounter", count)}
    for identifier, (name, value) in by_name.items():
        assert list(dbc.get_message_by_name(name).decode(frames[identifier]).values()) == [value]
    assert frames[CAN_STATUS] == struct.pack(">I", 5)


def test_an_instant_on_can_is_complete_with_acceleration_and_rate_and_a_lost_frame_costs_one():
    def instant(count):
        values = {"acceleration": (0, 0, 9.75), "rate_of_turn": (0.5, 0, 0), "magnetic_field": (0.5, 0, -0.5)}
        return encode_can({**values, "sample_time_us": [10_000 * count], "packet_counter": [count]})

    decoder, records = MtiCanDecoder(), [instant(k) for k in range(3)]
    cut = unpack_can_records(records[1])
    without_rate = b"".join(
        data for frame, data in zip(cut, _split(records[1], cut), strict=True) if frame.identifier != 0x32
    )
    found = decoder.feed(records[0] + without_rate + records[2])
    complete = [each.whole("packet_counter") for each in found if "acceleration" in each.values]
    fields = [each.whole("packet_counter") for each in found if "magnetic_field" in each.values]
    assert (complete, fields) == ([0, 2], [0, 1, 2])
    assert decoder.dropped == Counter(incomplete=1)


def _split(records, frames):
    place = 0
    for frame in frames:
        length = 6 + len(frame.data)
        yield records[place : place + length]
        place += length


def test_sizes_of_numbers():
    assert [number.size for number in NUMBERS] == [4, 4, 6, 8]
    assert decode_items(b"") == Measurement({})
