"""Datagrams of SlimeVR by hand-written bytes, and both ends of the conversation."""

from __future__ import annotations

import struct

import pytest

from devices.vendor_protocols import slimevr as wire
from devices.vendor_protocols.slimevr import (
    Acceleration,
    Battery,
    Features,
    Greeting,
    Handshake,
    Kind,
    Pong,
    Rotation,
    SensorInfo,
    SettingDone,
    Signal,
    SlimevrDecoder,
    Temperature,
)
from devices.vendor_protocols.slimevr_tracker import TrackerSession

IDENTITY = Handshake(22, "0.7.2", "a4e57c000001", 13, 4, 2)
HEAD = "000000{:02x} 0000000000000005"
ONE, HALF = "3f800000", "3f000000"
VECTORS = [
    # the vector of a tracker that calls itself "Test", with MAC "ferris"
    (3, "00000009 00000004 00000001 00000001 00000002 00000003 00000007 04 54657374 666572726973",
     [Handshake(7, "Test", b"ferris".hex(), 4, 9, 1)]),
    # a newer one says more behind
    (3, "00000004 0000000d 00000002" + "00000000" * 3 + "00000016 03 302e37 a4e57c000001 01 0178",
     [Handshake(22, "0.7", "a4e57c000001", 13, 4, 2)]),
    (3, "00000000" * 6 + "00000011 00 000000000000", [Handshake(17, "", "")]),
    (0, "", []),
    (1, "00000000 00000000 00000000" + ONE, [Rotation(5, 0, (1.0, 0.0, 0.0, 0.0))]),
    (16, HALF * 4, [Rotation(5, 1, (0.5, 0.5, 0.5, 0.5))]),
    (17, "02 01 3f19999a 00000000 3f4ccccd 00000000 03",
     [Rotation(5, 2, (0.0, pytest.approx(0.6), 0.0, pytest.approx(0.8)))]),
    (17, "02 02 3f19999a 00000000 3f4ccccd 00000000 03", []),
    (4, "3f800000 c0000000 41200000 01", [Acceleration(5, 1, (1.0, -2.0, 10.0))]),
    (4, "3f800000 c0000000 41200000", [Acceleration(5, 0, (1.0, -2.0, 10.0))]),
    (23, "01 0000 0000 8000 0000 0080 ff80 0540",
     [Rotation(5, 1, (0.0, 0.0, 0.0, -1.0)), Acceleration(5, 1, (1.0, -1.0, 10.5))]),
    (10, "deadbeef", [Pong(0xDEADBEEF)]),
    (12, "40800000 3f000000", [Battery(4.0, 0.5)]),
    (12, "3f000000", [Battery(0.0, 0.5)]),
    (15, "01 02 0d 0003 00 00 00", [SensorInfo(1, 2, 13, 3)]),
    (15, "00 01", [SensorInfo(0, 1, 0, 0)]),
    (19, "ff c4", [Signal(-60)]),
    (20, "00 41f80000", [Temperature(0, 31.0)]),
    (22, "06", [Features(6)]),
    (24, "00 0001", [SettingDone(0, 1)]),
    (100, "0010 00000004 3f800000 00000000 00000000" "0005 00000016 04"
     .replace("0010 00000004 3f800000 00000000 00000000", "0011 00000004 3f800000 00000000 00000000 01"),
     [Acceleration(5, 1, (1.0, 0.0, 0.0)), Features(4)]),
    (101, "03 13 ff c4 02 16 06", [Signal(-60), Features(6)]),
]  # fmt: skip


def datagram(kind, payload):
    return bytes.fromhex(HEAD.format(kind) + payload)


@pytest.mark.parametrize(("kind", "payload", "found"), VECTORS)
def test_every_kind_is_read_as_its_bytes_say(kind, payload, found):
    decoder = SlimevrDecoder()
    data = datagram(kind, payload)
    assert decoder.feed(data) == found
    assert not decoder.dropped
    for size in range(len(data)):  # cut short anywhere, it is dropped or is another whole message
        SlimevrDecoder().feed(data[:size])


DROPPED = [
    ("bad_length", bytes(7)),
    ("bad_length", datagram(17, "00 01 3f800000")),
    ("bad_length", datagram(100, "ffff 00000004")),
    ("bad_length", datagram(100, "0002 0000")),
    ("bad_header", b"\x01" + datagram(17, "")[1:]),
    ("unknown_kind", datagram(99, "00")),
    ("not_a_rotation", datagram(1, ONE * 4)),
    ("not_a_rotation", datagram(1, "00000000" * 4)),
    ("not_finite", datagram(1, "7fc00000" * 4)),
    ("acceleration_beyond_sensor", datagram(4, "45000000 00000000 00000000 00")),
    ("not_finite", datagram(4, "7f800000 00000000 00000000 00")),
    ("implausible_status", datagram(12, "40800000 41000000")),
]


@pytest.mark.parametrize(("reason", "data"), DROPPED)
def test_what_cannot_be_is_dropped_by_name(reason, data):
    decoder = SlimevrDecoder()
    assert decoder.feed(data) == []
    assert decoder.dropped == {reason: 1}


def turned(number):
    return wire.encode(Kind.ROTATION_DATA, number, wire.rotation_data(0, (1.0, 0.0, 0.0, 0.0)))


def accepted(numbers):
    decoder = SlimevrDecoder()
    return [number for number in numbers if decoder.feed(turned(number))], decoder.dropped


def test_numbers_that_do_not_follow_wait_until_they_agree():
    assert accepted([5, 6, 6, 8, 7, 9]) == ([5, 6, 8, 9], {"repeated": 1, "out_of_order": 1})
    # one damaged number costs what it claims to follow on, for three datagrams
    assert accepted([5, 505, 6, 7, 8, 9]) == ([5, 505, 8, 9], {"out_of_order": 2})
    assert accepted([5, 9005, 6, 7]) == ([5, 6, 7], {"leap_in_number": 1})
    assert accepted([9000, 1, 2, 3, 4])[0] == [9000, 3, 4]


def test_datagrams_that_have_not_come_are_counted_whatever_came_between():
    decoder = SlimevrDecoder()
    for number in (5, 6, 9, 10, 12):
        decoder.feed(turned(number) if number % 2 else wire.encode(Kind.HEARTBEAT, number))
    assert decoder.missed == 3


def test_a_handshake_begins_the_numbers_anew():
    decoder = SlimevrDecoder()
    decoder.feed(turned(900))
    decoder.feed(wire.encode(Kind.HANDSHAKE, 0, wire.handshake(IDENTITY)))
    assert decoder.feed(turned(1))


def test_sixteen_bits_hold_the_ends_of_their_range():
    parts = wire.rotation_and_acceleration(0, (1.0, 0.0, 0.0, 0.0), (300.0, -300.0, 0.004))
    turn, linear = SlimevrDecoder().feed(wire.encode(23, 1, parts))
    assert turn.orientation == (32767 / 32768, 0.0, 0.0, 0.0)
    assert linear.acceleration == (32767 / 128, -256.0, 1 / 128)


def session():
    return TrackerSession(IDENTITY, [SensorInfo(0, 1, 13, 2)])


def connected(flags=1, now_s=0.0):
    made = session()
    assert made.due(now_s) is not None
    (features,) = made.receive(wire.GREETING, now_s)
    assert SlimevrDecoder().feed(features) == [Features(4)]
    made.receive(wire.encode(Kind.FEATURES, 0, bytes((flags,))), now_s)
    return made


def test_a_tracker_asks_every_second_until_it_is_greeted():
    made = session()
    assert [made.due(t) is not None for t in (0.0, 0.5, 1.0, 1.9, 2.0)] == [True, False, True, False, True]
    assert made.data([(17, b"")]) == []
    assert (
        made.receive(wire.encode(Kind.ROTATION), 2.0) == []
    )  # of somebody else: no answer before a greeting
    made.receive(wire.GREETING, 2.1)
    assert made.is_connected
    assert made.due(4.0) is None


def test_a_tracker_says_what_its_sensors_are_until_that_is_acknowledged():
    made = connected()
    ((kind, payload),) = made.presentations(0.0)
    assert SlimevrDecoder().feed(wire.encode(kind, 1, payload)) == [SensorInfo(0, 1, 13, 2)]
    assert made.presentations(0.9) == []
    assert made.presentations(1.0)
    made.receive(wire.acknowledge(0, 1), 1.5)
    assert made.presentations(2.1) == []


def test_a_tracker_answers_and_begins_again_when_its_server_is_gone():
    made = connected()
    ping = wire.ping(77)
    assert made.receive(ping, 1.0) == [ping]
    (beat,) = made.receive(wire.encode(Kind.ROTATION), 2.0)
    assert struct.unpack(">IQ", beat)[0] == Kind.HEARTBEAT
    assert made.due(4.9) is None
    assert made.due(5.1) is not None
    assert not made.is_connected


@pytest.mark.parametrize(("flags", "n_datagrams"), [(0, 2), (1, 1)])
def test_data_are_bundled_for_a_server_that_takes_bundles(flags, n_datagrams):
    made = connected(flags)
    parts = [
        (Kind.ROTATION_DATA, wire.rotation_data(0, (1.0, 0.0, 0.0, 0.0))),
        (Kind.ACCELERATION, wire.acceleration(0, (1.0, 2.0, 3.0))),
    ]
    sent = made.data(parts)
    assert len(sent) == n_datagrams
    decoder = SlimevrDecoder()
    found = [type(message) for data in sent for message in decoder.feed(data)]
    assert found == [Rotation, Acceleration]


def test_a_bundle_never_exceeds_what_a_network_takes_whole():
    made = connected()
    parts = [(Kind.ROTATION_DATA, wire.rotation_data(k, (1.0, 0.0, 0.0, 0.0))) for k in range(100)]
    sent = made.data(parts)
    assert len(sent) > 1
    assert max(map(len, sent)) <= 1472
    decoder = SlimevrDecoder()
    assert [m.sensor for data in sent for m in decoder.feed(data)] == list(range(100))


def test_what_no_server_sends_is_nothing():
    assert wire.read_from_server(b"") is None
    assert wire.read_from_server(b"\x01\x02\x03\x04") is None
    assert wire.read_from_server(bytes((0, 0, 0, 10))) is None
    assert wire.read_from_server(b"\x03Hey OVR =D 5") == Greeting()
