"""SlimeVR trackers as a source: what they felt is made again of what they fused; who they are, who not."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from devices.link import Chunk, SentChunk
from devices.vendor_protocols import slimevr as wire
from devices.vendor_protocols.slimevr import Battery, Handshake, Kind, SensorInfo
from gateway.body.rig import load_rig
from gateway.contract.balances import joined, unaccounted
from gateway.frames import ANGULAR_RATE, MAGNETIC_FIELD, SPECIFIC_FORCE
from gateway.geometry import quaternion
from gateway.sources.module_table import ModuleTable
from gateway.sources.slimevr import SlimevrLinkSettings, SlimevrSource
from gateway.sources.source import SourceContext

MAC, KEY = "a4e57c000007", "a4:e5:7c:00:00:07"
SENDER = "192.168.1.40:51234"
INTERVAL_NS = 10_000_000
TURN = np.array([0.6, -1.1, 0.8])  # rad/s, sensor axes
LINEAR = (0.5, -0.25, 1.5)
DELAY_NS = 3_000_000


class Port:
    """A source with one link, and a tracker that sends to it."""

    def __init__(self, trackers=None, version=wire.VERSION, mac=MAC):
        settings = SlimevrLinkSettings(
            name="trackers", url="udp://0.0.0.0:6969", trackers={KEY: 7} if trackers is None else trackers
        )
        self.modules = ModuleTable()
        context = SourceContext(load_rig("single"), self.modules, links={"trackers": settings})
        self.source = SlimevrSource(context)
        self.source.add_link("trackers", "slimevr")
        self.device = self.source.devices["trackers"]
        self.handshake = wire.handshake(Handshake(version, "0.7.2", mac))
        self.now_ns = 1_000_000_000
        self.number = 0
        self.q = np.array([0.8, 0.2, -0.4, 0.4])
        self.rows = []

    def receive(self, data, sender=SENDER):
        for batch in self.source.receive(Chunk(data, self.now_ns + DELAY_NS, "trackers", sender)):
            self.rows += list(batch.samples)

    def shake(self, sender=SENDER):
        self.receive(wire.encode(Kind.HANDSHAKE, 0, self.handshake), sender)
        self.number = 0

    def move(self, samples, sender=SENDER, lost=(), sensor=0, bundled=True, linear=LINEAR, turn=TURN):
        for k in range(samples):
            self.now_ns += INTERVAL_NS
            self.q = quaternion.multiply(self.q, quaternion.from_rotation_vector(turn * INTERVAL_NS * 1e-9))
            parts = [(Kind.ROTATION_DATA, wire.rotation_data(sensor, tuple(self.q)))]
            if linear is not None:
                parts.append((Kind.ACCELERATION, wire.acceleration(sensor, linear)))
            for data in self.datagrams(parts, bundled):
                if k not in lost:
                    self.receive(data, sender)

    def datagrams(self, parts, bundled):
        if bundled:
            self.number += 1
            return [wire.encode_bundle(self.number, parts)]
        found = []
        for kind, payload in parts:
            self.number += 1
            found.append(wire.encode(kind, self.number, payload))
        return found

    def dropped(self):
        return dict(self.device.dropped)

    def assert_accounted(self):
        balances = joined([*self.modules.balances(), *self.source.balances()])
        assert unaccounted(balances).keys() == {"readings"}  # no stage takes them here


@pytest.mark.parametrize("bundled", [True, False])
@pytest.mark.parametrize("version", [22, 17])
def test_what_was_felt_is_made_again_of_what_was_fused(bundled, version):
    port = Port(version=version)
    port.shake()
    linear = LINEAR if version == 22 else (-LINEAR[1], LINEAR[0], LINEAR[2])
    port.move(200, bundled=bundled, linear=linear)
    measured = np.array([row["measured"] for row in port.rows])
    assert len(measured) >= 185
    np.testing.assert_allclose(measured[:, ANGULAR_RATE], np.tile(TURN, (len(measured), 1)), rtol=1e-4)
    final = quaternion.multiply(port.q, quaternion.from_rotation_vector(-TURN * INTERVAL_NS * 1e-9))
    up = quaternion.rotate_inverse(final, np.array([0.0, 0.0, 1.0]))  # of the sample before the newest
    np.testing.assert_allclose(measured[-1, SPECIFIC_FORCE], np.array(LINEAR) + 9.80665 * up, atol=2e-4)
    assert np.isnan(measured[:, MAGNETIC_FIELD]).all()
    assert {int(row["module"]) for row in port.rows} == {7}
    assert np.diff([row["sequence"] for row in port.rows]).tolist() == [1] * (len(port.rows) - 1)
    assert port.dropped() == {}
    port.assert_accounted()


def test_lost_samples_are_counted_and_bridged_by_the_turn_over_them():
    port = Port()
    port.shake()
    port.move(400, lost={200, 201, 300})
    assert port.modules.records[7].lost == 3
    np.testing.assert_allclose(
        np.array([row["measured"][ANGULAR_RATE] for row in port.rows]), np.tile(TURN, (len(port.rows), 1)),
        rtol=1e-4,
    )  # fmt: skip
    port.assert_accounted()


def test_messages_of_other_kinds_between_are_no_lost_samples():
    port = Port()
    port.shake()
    for _ in range(10):
        port.move(40)
        for data in port.datagrams([(Kind.BATTERY, wire.battery(Battery(3.9, 0.6)))], bundled=False):
            port.receive(data)
    assert port.modules.records[7].lost == 0
    assert port.modules.records[7].health.battery_percent == 60


def test_an_orientation_that_leaps_gives_no_rate():
    port = Port()
    port.shake()
    port.move(100)
    port.q = quaternion.multiply(np.array([0.7071, 0, 0, 0.7071]), port.q)  # its heading was set anew
    port.move(100)
    rates = np.array([row["measured"][ANGULAR_RATE] for row in port.rows])
    assert np.abs(rates - TURN).max() < 1e-3
    assert port.dropped() == {"leap_in_orientation": 1}
    port.assert_accounted()


def test_a_tracker_that_begins_anew_goes_on_under_its_number():
    port = Port()
    port.shake()
    port.move(100)
    port.shake("192.168.1.40:60000")
    port.move(100, sender="192.168.1.40:60000")
    assert len(port.device.trackers) == 1
    assert port.modules.records[7].received == 200
    assert port.modules.records[7].duplicates == 0
    port.assert_accounted()


def test_two_sensors_of_a_tracker_are_two_modules():
    port = Port(trackers={KEY: 7, f"{KEY}/1": 8})
    port.shake()
    for _ in range(100):
        before = port.now_ns
        port.move(1)
        port.now_ns = before
        port.move(1, sensor=1)
    assert set(port.modules.records) == {7, 8}
    assert port.modules.records[7].lost == port.modules.records[8].lost == 0


def test_strangers_have_no_say():
    port = Port()
    port.move(10)
    assert port.dropped() == {"before_handshake": 10}
    port.receive(b"\x00\x00\x00\x11nonsense", "10.0.0.9:5")
    stranger = Port(mac="0123456789ab")
    stranger.shake()
    stranger.move(10)
    assert stranger.rows == []
    assert stranger.dropped() == {"no_number": 10}
    (found,) = [each for each in stranger.device.findings(100.0) if "has no number" in each.found]
    assert "01:23:45:67:89:ab" in found.remedy


def test_so_many_that_announce_themselves_take_no_room():
    port = Port()
    port.shake()
    for n in range(300):
        shaken = wire.encode(Kind.HANDSHAKE, 0, wire.handshake(Handshake(22, "x", f"{n + 1:012x}")))
        port.receive(shaken, f"10.0.{n // 250}.{n % 250}:7")
    assert len(port.device.trackers) <= 64
    assert SENDER in port.device.trackers
    assert len(port.device.due(port.now_ns)) <= 256 + 2 * 64


def test_a_phone_without_handshake_is_known_by_its_address():
    port = Port(trackers={"192.168.1.40": 3})
    port.move(100)
    assert {int(row["module"]) for row in port.rows} == {3}


def said(port):
    return [wire.read_from_server(data) for data, _ in port.device.due(port.now_ns)]


def test_a_tracker_is_greeted_answered_and_kept_up():
    port = Port()
    port.shake()
    greeting, beat, ping = said(port)
    assert greeting == wire.Greeting()
    assert (beat.kind, ping.kind) == (Kind.ROTATION, Kind.PING)
    assert said(port) == []
    for data in port.datagrams([(Kind.SENSOR_INFO, wire.sensor_info(SensorInfo(0, 1, 13, 2)))], False):
        port.receive(data)
    for data in port.datagrams([(Kind.FEATURES, b"\x04")], False):
        port.receive(data)
    assert said(port) == [wire.FromServer(15, b"\x00\x01"), wire.FromServer(22, b"\x03")]
    port.now_ns += 500_000_000
    assert [each.kind for each in said(port)] == [Kind.ROTATION, Kind.PING]
    port.now_ns += 20_000_000_000
    assert said(port) == []  # silent for long


def test_pings_tell_the_delay_on_the_way():
    port = Port()
    port.shake()
    for _ in range(60):
        port.move(50)
        for data, _ in port.device.due(port.now_ns):
            port.source.sent(SentChunk(data, port.now_ns - 3_000_000, "trackers"))
            if data[3] == Kind.PING:
                port.receive(data)  # arrives DELAY_NS after now: 6 ms round trip
    figures = port.modules.records[7].clock.figures()
    assert figures.bound_us == pytest.approx(3000, abs=400)
    times = np.array([row["time_ns"] for row in port.rows])
    sampled = port.now_ns - INTERVAL_NS  # the newest that is complete
    assert abs(times[-1] - sampled) < 500_000


def test_a_recording_that_begins_later_tells_trackers_by_the_pings_they_return():
    live, later = Port(version=17), Port(version=17)
    live.shake()
    live.move(10)
    ping = next(data for data, _ in live.device.due(live.now_ns) if data[3] == Kind.PING)
    later.receive(ping)  # returned and never sent: of nobody
    assert later.dropped() == {"before_handshake": 1}
    later.source.sent(SentChunk(ping, later.now_ns, "trackers"))
    later.receive(ping)
    assert later.device.trackers[SENDER].key == MAC
    later.move(2)
    later.receive(ping)
    assert later.modules.records[7].received == 2


@pytest.mark.parametrize(
    ("trackers", "named"),
    [
        ({"kitchen": 1}, "is no tracker"),
        ({KEY: 300}, "0 to 254"),
        ({KEY: 1, "192.168.1.4": 1}, "another tracker's"),
        ({f"{KEY}/x": 1}, "no number of a sensor"),
    ],
)
def test_a_bad_tracker_in_the_configuration_is_named(trackers, named):
    with pytest.raises(ValidationError, match=named):
        SlimevrLinkSettings(name="trackers", url="udp://0.0.0.0:6969", trackers=trackers)


def test_the_doctor_hears_what_is_wrong():
    port = Port(trackers={KEY: 7, "192.168.1.99": 8})
    port.shake()
    port.move(100, linear=None)
    found = [each.found for each in port.device.findings(200.0)]
    assert any("module 8) sends no orientations" in each for each in found)
    assert any("sends no acceleration" in each for each in found)
    assert any("sends 100 orientations a second for 200 poses" in each for each in found)
