"""x-IMU3 messages: the vectors of the maker's manual, round trips, and bytes that are none."""

import math
import struct
import time

import pytest
import ximu3
from hypothesis import given
from hypothesis import strategies as st

from devices.vendor_protocols.ximu3 import (
    Announcement,
    Answer,
    Battery,
    Inertial,
    Magnetic,
    Radio,
    Temperature,
    Ximu3Decoder,
    encode_announcement,
    encode_binary,
    encode_text,
    read_announcement,
)
from tests.patience import PATIENCE_S

SECOND = bytes.fromhex("40420F0000000000")
single = st.floats(-20.0, 20.0, width=32)
stamps = st.integers(0, 2**63 - 1)


def decoded(data):
    decoder = Ximu3Decoder()
    return decoder.feed(data), decoder


def test_the_manuals_messages_are_read():
    inertial = b"\xc9" + SECOND + struct.pack("<6f", 0, 0, 0, 0, 0, 1) + b"\n"
    field = b"\xcd" + SECOND + struct.pack("<3f", 1, 0, 0) + b"\n"
    note = b"\xce" + SECOND + b"This is a notification message.\n"
    found, decoder = decoded(inertial + field + note)
    assert found == [
        Inertial(1_000_000, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        Magnetic(1_000_000, (1.0, 0.0, 0.0)),
    ]
    assert decoder.unused == 1
    assert not decoder.dropped
    assert encode_binary(b"I", 1_000_000, (0, 0, 0, 0, 0, 1)) == inertial


def test_text_messages_are_read():
    found, _ = decoded(b"I,1000000,0.0000,0.0000,0.5000,0.0000,0.0000,1.0000\r\nM,1000001,1.0,0.0,-0.5\r\n")
    assert found == [
        Inertial(1_000_000, (0.0, 0.0, 0.5), (0.0, 0.0, 1.0)),
        Magnetic(1_000_001, (1.0, 0.0, -0.5)),
    ]


@given(stamps, st.tuples(*[single] * 6), st.lists(st.integers(1, 20)))
def test_whatever_bytes_a_sample_has_it_comes_back_however_it_is_cut(stamp, values, cuts):
    """Ends and escapes inside of numbers are replaced: all bytes of stamps and values occur."""
    data = encode_binary(b"I", stamp, values)
    assert data.count(b"\n") == 1
    decoder, found = Ximu3Decoder(), []
    for cut in [*cuts, len(data)]:
        found += decoder.feed(data[:cut])
        data = data[cut:]
    assert found == [Inertial(stamp, values[:3], values[3:])]


@given(stamps, st.tuples(*[single] * 3))
def test_text_comes_back_to_four_places(stamp, values):
    ((sample,), _) = decoded(encode_text(b"M", stamp, values))
    assert sample.time_us == stamp
    assert sample.field == pytest.approx(values, abs=5.1e-5)


@given(st.binary(max_size=400))
def test_bytes_that_are_none_raise_nothing_and_cost_no_sample_after_them(noise):
    good = encode_binary(b"I", 7, (1, 2, 3, 0, 0, 1))
    found, _ = decoded(noise + b"\n" + good)
    assert found[-1] == Inertial(7, (1.0, 2.0, 3.0), (0.0, 0.0, 1.0))


def test_a_single_stamp_out_of_line_is_damage_and_two_are_a_device_that_began_anew():
    def sample(stamp):
        return encode_binary(b"I", stamp, (0, 0, 0, 0, 0, 1))

    decoder = Ximu3Decoder()
    stamps = [10**9, 10**9 + 10_000, 10**15, 10**9 + 20_000, 300_000, 310_000, 320_000]
    found = decoder.feed(b"".join(map(sample, stamps)))
    assert [message.time_us for message in found] == [10**9, 10**9 + 10_000, 10**9 + 20_000, 310_000, 320_000]
    assert decoder.dropped == {"leap_in_time": 2}


def test_state_of_the_device_and_answers_are_read():
    data = encode_binary(b"B", 7, (96.0, 4.05, 0.0)) + encode_text(b"W", 8, (70, -65))
    data += encode_text(b"T", 9, (37.75,)) + b'{"ping":{"name":"Hand","sn":"64F0EDBF"}}\r\n'
    found, decoder = decoded(data)
    assert found == [
        Battery(7, 96.0, pytest.approx(4.05)),
        Radio(8, 70.0, -65.0),
        Temperature(9, 37.75),
        Answer("ping", {"name": "Hand", "sn": "64F0EDBF"}),
    ]
    assert not decoder.dropped


ports = st.integers(0, 65535)
levels = st.one_of(st.none(), st.integers(0, 100))
words = st.text(min_size=1, max_size=64)


@given(st.builds(Announcement, words, words, st.ip_addresses().map(str), ports, ports, ports, levels, levels))
def test_announcements_come_back(announced):
    assert read_announcement(encode_announcement(announced)) == announced


@given(st.binary(max_size=200))
def test_no_datagram_on_the_discovery_port_raises(data):
    assert read_announcement(data) is None


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (encode_binary(b"I", 7, (1, 2, 3, 0, 0)), "bad_length"),
        (encode_binary(b"I", 7, (2101, 0, 0, 0, 0, 1)), "rate_beyond_sensor"),
        (encode_binary(b"I", 7, (0, 0, 0, 0, 26, 1)), "force_beyond_sensor"),
        (encode_binary(b"M", 7, (0, -101, 1)), "field_beyond_sensor"),
        (encode_binary(b"I", 7, (0, 0, 0, 0, math.nan, 1)), "not_finite"),
        (encode_binary(b"B", 7, (101, 4, 0)), "implausible_status"),
        (encode_binary(b"M", 2**63, (1, 0, 0)), "leap_in_time"),
        (b'{"ping":', "bad_json"),
        (b'{"ping":1,"time":2}', "bad_json"),
        (b"\xc9\xdb\x00" + b"\x00" * 30 + b"\n", "bad_stuffing"),
        (b"I,7,1,2,3,4,5,x\n", "bad_number"),
        (b"I,7,1,2,3\n", "bad_length"),
        (b"what is this?\n", "unknown_kind"),
        (b"x" * 5000, "too_long"),
    ],
)
def test_what_cannot_be_is_dropped_and_counted_by_reason(message, reason):
    found, decoder = decoded(message if message.endswith(b"\n") or len(message) > 4096 else message + b"\n")
    assert found == []
    assert decoder.dropped == {reason: 1}


def test_the_makers_own_library_reads_what_is_encoded_here(tmp_path):
    """Through a file as its software logs it; stamps and values hold bytes that are replaced on the wire."""
    path, samples = tmp_path / "log.ximu3", [(10, 219), (2_570, 56_330), (3_000_000, 1)]
    inertial = [encode_binary(b"I", stamp, (x / 256, 0, 0, 0, 0, 1)) for stamp, x in samples]
    path.write_bytes(b"".join(inertial) + encode_binary(b"M", 5, (1, 0, 0.5)))
    connection, seen = ximu3.Connection(ximu3.FileConnectionConfig(str(path))), []
    connection.add_inertial_callback(lambda message: seen.append((message.timestamp, message.gyroscope_x)))
    connection.add_magnetometer_callback(lambda message: seen.append((message.timestamp, message.z)))
    connection.add_receive_error_callback(seen.append)
    connection.open()
    deadline = time.monotonic() + PATIENCE_S
    while len(seen) <= len(samples) and time.monotonic() < deadline:
        time.sleep(0.01)
    connection.close()
    assert seen == [*((stamp, x / 256) for stamp, x in samples), (5, 0.5)]
