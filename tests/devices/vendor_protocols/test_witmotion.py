"""Packets of WitMotion devices: those of the manual, round trips, and bytes that are none."""

from __future__ import annotations

import json
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.vendor_protocols.witmotion import (
    ACCELERATION,
    ANGLE,
    ANGULAR_RATE,
    FIELD,
    QUATERNION,
    RANGE_DEG_S,
    RANGE_G,
    REGISTERS,
    SAVE,
    TIME,
    UNLOCK,
    Inertial,
    Magnetic,
    Quaternion,
    Values,
    WitMotionCanDecoder,
    WitMotionDecoder,
    counts,
    encode,
    encode_can,
    encode_write,
    read_writes,
)

numbers = st.lists(st.integers(-(2**15), 2**15 - 1), min_size=3, max_size=3)


def instant(force=(0, 0, 2048), rate=(10, -20, 30), field=(1, 2, 3), celsius=2500):
    return (
        encode(ACCELERATION, [*force, celsius])
        + encode(ANGULAR_RATE, [*rate, 0])
        + encode(ANGLE, [1, 2, 3, 4])
        + encode(FIELD, [*field, 0])
    )


def test_packets_and_commands_are_those_of_the_documents():
    assert encode(ACCELERATION, [0, 0, 2048, 0x1234]).hex(" ") == "55 51 00 00 00 00 00 08 34 12 f4"
    assert encode_write(*UNLOCK).hex() == "ffaa6988b5"
    assert encode_write(*SAVE).hex() == "ffaa000000"
    assert encode_write(0x27, 0x3A).hex() == "ffaa273a00"


def test_what_a_real_device_measured_at_rest_reads_as_one_g(recording_set):
    """Bluetooth frames hold the same numbers in the same units; its serial packets are made of them."""
    captured = json.loads((recording_set("live_captures") / "witmotion_ble" / "data.json").read_text())[
        "data"
    ]
    decoder = WitMotionDecoder()
    for frame in captured:
        data = bytes(int(each, 16) for each in frame)
        assert data[:2] == b"\x55\x61"
        values = struct.unpack("<9h", data[2:])
        (found,) = decoder.feed(
            encode(ACCELERATION, [*values[:3], 0]) + encode(ANGULAR_RATE, [*values[3:6], 0])
        )
        assert sum(each**2 for each in found.specific_force) ** 0.5 == pytest.approx(1.0, abs=0.01)
        assert found.angular_rate == (0, 0, 0)
        assert counts(found.specific_force, RANGE_G) == list(values[:3])


@given(numbers, numbers, numbers, st.lists(st.integers(1, 30)))
def test_an_instant_comes_back_however_its_bytes_are_cut(force, rate, field, cuts):
    data, decoder, found = instant(force, rate, field), WitMotionDecoder(), []
    for cut in [*cuts, len(data)]:
        found += decoder.feed(data[:cut])
        data = data[cut:]
    inertial, magnetic = found
    assert counts(inertial.specific_force, RANGE_G) == force
    assert counts(inertial.angular_rate, RANGE_DEG_S) == rate
    assert (inertial.celsius, magnetic.field) == (25.0, tuple(field))
    assert not decoder.dropped
    assert decoder.unused == 1


@given(numbers, numbers, numbers)
def test_an_instant_comes_back_over_can(force, rate, field):
    decoder = WitMotionCanDecoder(0x51)
    data = [encode_can(kind, each, 0x51) for kind, each in ((ACCELERATION, force), (ANGULAR_RATE, rate))]
    inertial, magnetic = decoder.feed(
        b"".join([*data, encode_can(FIELD, field, 0x51), encode_can(FIELD, field)])
    )
    assert counts(inertial.specific_force, RANGE_G) == force
    assert counts(inertial.angular_rate, RANGE_DEG_S) == rate
    assert magnetic.field == tuple(field)
    assert decoder.unused == 1  # of another device on the bus


def test_registers_and_orientations_are_handed_on():
    decoder = WitMotionDecoder()
    found = decoder.feed(encode(REGISTERS, [9, 6, 0xFFFF, 4]) + encode(QUATERNION, [0, 32767, 0, 0]))
    assert found[0] == Values((9, 6, 0xFFFF, 4))
    assert isinstance(found[1], Quaternion)
    assert decoder.feed(encode(QUATERNION, [3, 4, 0, 0])) == []
    assert decoder.dropped == {"not_a_rotation": 1}


def test_an_instant_that_began_before_it_was_listened_to_is_no_loss():
    decoder = WitMotionDecoder()
    rest = encode(ANGULAR_RATE, [0, 0, 0, 0]) + encode(FIELD, [1, 2, 3, 0])
    assert decoder.feed(rest) == []
    assert decoder.dropped == {}
    assert decoder.unused == 2
    inertial, *_ = decoder.feed(instant())
    assert inertial.n_incomplete == 0
    assert decoder.feed(rest) == []
    assert decoder.dropped == {"incomplete": 1}


@pytest.mark.parametrize(
    ("damaged", "reason"),
    [
        (b"\x55\x51" + bytes(9), "bad_checksum"),
        (b"\x01\x02\x55\x20", "noise"),
        (encode(ACCELERATION, [0, 0, 2048, -5000]), "temperature_beyond_sensor"),
        (encode(TIME, [0x0D18, 0, 0, 0]), "no_date"),
        (2 * encode(ACCELERATION, [0, 0, 2048, 2500]), "incomplete"),
    ],
)
def test_what_cannot_be_is_dropped_and_counted_by_reason(damaged, reason):
    decoder = WitMotionDecoder()
    assert decoder.feed(damaged) == []
    assert reason in decoder.dropped
    assert len(decoder.feed(instant() + instant())) >= 3  # and what follows is read


def test_instants_that_lack_a_packet_are_told_with_the_next_one():
    decoder, whole = WitMotionDecoder(), instant()
    without_force = whole[11:]
    without_rate = whole[:11] + whole[22:]
    found = decoder.feed(whole + without_force + without_rate + whole)
    inertial = [each for each in found if isinstance(each, Inertial)]
    assert [each.n_incomplete for each in inertial] == [0, 2]
    assert sum(isinstance(each, Magnetic) for each in found) == 2  # no field for an instant that is not
    assert decoder.dropped == {"incomplete": 2}


@given(st.binary(max_size=300))
def test_no_bytes_raise(data):
    for decoder in (WitMotionDecoder(), WitMotionCanDecoder()):
        decoder.feed(data)
    read_writes(data)


def test_writes_of_a_host_are_read_however_they_are_cut():
    data, found, rest = b"\x00" + encode_write(*UNLOCK) + encode_write(3, 9) + b"\xff", [], b""
    for at in range(len(data)):
        writes, rest = read_writes(rest + data[at : at + 1])
        found += writes
    assert found == [UNLOCK, (3, 9)]
    assert rest == b"\xff"
