"""Receiver's bytes to readings: against the emulator's truth, and damaged at will."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.emulators.gnss_receiver import FORMATS, GnssEmulation, gnss_traffic
from devices.geodesy import LocalPlane, earth_centred, geodetic
from devices.link import Chunk
from gateway.frames import Quantity
from gateway.sources.gnss.receiver import GnssParams, GnssReceiver
from gateway.sources.gnss.sentences import GnssDecoder, GnssDefect

START_NS = 1_760_000_000_000_000_000


def path(t):
    return np.array([np.sin(t), 2.0 * t, 1.0]), np.array([np.cos(t), 2.0, 0.0])


def readings_of(emulation, seconds, host_ahead_ns=0):
    receiver = GnssReceiver(GnssParams(60, round(emulation.latency_s * 1e9), emulation.origin))
    readings = []
    for sent in islice(gnss_traffic(path, START_NS, emulation, 1), round(seconds * emulation.rate_hz)):
        arrived_ns = START_NS + host_ahead_ns + round(sent.time_s * 1e9)
        readings += receiver.receive(Chunk(sent.data, arrived_ns, "gnss"))
    return receiver, readings


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("host_ahead_s", [0.0, 3.7])
def test_positions_and_velocities_are_those_of_the_motion_at_the_time_given(kind, host_ahead_s):
    """Though the host's clock is wrong and arrivals jitter: readings are in the gateway's time."""
    emulation = GnssEmulation(kind=kind, jitter_s=0.04)
    ahead_ns = round(host_ahead_s * 1e9)
    _, readings = readings_of(emulation, 20.0, ahead_ns)
    for quantity, column, limit in ((Quantity.POSITION, 0, 0.012), (Quantity.VELOCITY, 1, 0.035)):
        ours = [r for r in readings[20:] if r.quantity is quantity]
        off = [r.value[:2] - path((r.time_ns - ahead_ns - START_NS) * 1e-9)[column][:2] for r in ours]
        assert len(ours) > 180
        assert np.std(off) < limit
        assert np.abs(np.mean(off, axis=0)).max() < 0.012  # 2 m/s: dated within 6 ms
        assert 0.2 < np.std(off) / ours[0].sigma[0] < 1.5


@pytest.mark.parametrize("kind", FORMATS)
def test_without_fix_nothing_is_read_and_the_statistics_say_so(kind):
    emulation = GnssEmulation(kind=kind, dropout=(2.0, 100.0))
    receiver, readings = readings_of(emulation, 4.0)
    assert max(r.time_ns for r in readings) < START_NS + 2_000_000_000
    statistics = receiver.statistics()
    assert statistics["state"] == "no fix"
    assert statistics["fixes"] == 19
    assert statistics["messages_without_fix"] >= 20


@pytest.mark.parametrize("kind", FORMATS)
def test_a_flipped_byte_is_counted_and_costs_one_message(kind):
    emulation = GnssEmulation(kind=kind)
    sent = [s.data for s in islice(gnss_traffic(path, START_NS, emulation, 1), 10)]
    damaged = bytearray(sent[4])
    damaged[-20] ^= 1
    decoder = GnssDecoder()
    whole = len([f for data in sent for f in GnssDecoder().feed(data) if f.place])
    fixes = [f for i, data in enumerate(sent) for f in decoder.feed(bytes(damaged) if i == 4 else data)]
    assert len([f for f in fixes if f.place]) == whole - 1
    assert decoder.dropped[GnssDefect.CHECKSUM] == 1


@pytest.mark.parametrize("kind", FORMATS)
def test_how_the_bytes_are_cut_into_chunks_does_not_matter(kind):
    data = b"".join(s.data for s in islice(gnss_traffic(path, START_NS, GnssEmulation(kind=kind), 1), 5))
    decoder = GnssDecoder()
    assert GnssDecoder().feed(data) == [f for i in range(len(data)) for f in decoder.feed(data[i : i + 1])]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=40), st.sampled_from([b"$", b"\xb5\x62", b"$GNGGA,1,*00\r\n"]))))
def test_any_bytes_are_survived_and_the_next_message_is_read(pieces):
    decoder = GnssDecoder()
    for piece in pieces:
        decoder.feed(piece)
    good = next(gnss_traffic(path, START_NS, GnssEmulation(), 1)).data
    assert any(fix.place for fix in decoder.feed(good * 12))  # a false UBX head may swallow up to 1 kB


@given(
    st.floats(-89.9, 89.9),
    st.floats(-180, 180),
    st.floats(-100, 9000),
    st.lists(st.floats(-5e3, 5e3), min_size=3, max_size=3),
)
def test_there_and_back_on_the_ellipsoid(latitude, longitude, height, enu):
    plane = LocalPlane(latitude, longitude, height)
    assert plane.enu(*geodetic(plane, np.array(enu))) == pytest.approx(enu, abs=1e-4)


def test_earth_centred_of_a_published_point():
    """On the equator, at the pole, and the semi-minor axis 6 356 752.3142 m of WGS 84."""
    assert earth_centred(0.0, 90.0, 10.0) == pytest.approx([0.0, 6378147.0, 0.0], abs=1e-6)
    assert earth_centred(90.0, 0.0, 0.0) == pytest.approx([0.0, 0.0, 6356752.3142], abs=1e-4)


def test_without_gst_the_hdop_tells_the_accuracy():
    line = b"$GNGGA,101112.20,4806.00000,N,01130.00000,E,1,9,0.9,500.1,M,47.0,M,,"
    line += b"*%02X\r\n" % np.bitwise_xor.reduce(np.frombuffer(line[1:], np.uint8))
    (fix,) = GnssDecoder().feed(line)
    assert fix.place == pytest.approx((48.1, 11.5, 547.1))
    assert fix.place_sigma == pytest.approx((1.591, 1.591, 3.375), abs=1e-3)
