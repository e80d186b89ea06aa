"""Segments as trackers, against a stand-in for the server that is written from the protocol alone."""

from __future__ import annotations

import asyncio
import socket
import struct

import numpy as np
import pytest

from gateway.body.rig import load_rig
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.geometry import quaternion
from gateway.outputs.settings import OutputsSettings
from gateway.outputs.side_outputs import SideOutputs
from gateway.outputs.slimevr import sensors_of
from gateway.outputs.unity import t_pose
from tests.patience import PATIENCE_S

SKELETON = load_rig("suit_17").skeleton


class StandInServer(asyncio.DatagramProtocol):
    """What a SlimeVR server does with a tracker, in its own reading of the bytes: no real server was run."""

    def __init__(self, flags=1, acknowledges=True):
        self.flags, self.acknowledges = flags, acknowledges
        self.handshakes, self.numbers, self.sensors, self.pongs = [], [], {}, []
        self.rotations, self.accelerations, self.batteries, self.beats = {}, {}, [], 0
        self.tracker = None
        self.is_silent = False
        self.largest = 0

    def connection_made(self, transport):
        self.transport = transport
        self.port = transport.get_extra_info("sockname")[1]

    def say(self, data):
        self.transport.sendto(data, self.tracker)

    def ping(self, token):
        self.say(struct.pack(">IQI", 10, 0, token))

    def beat(self):
        self.say(struct.pack(">IQ", 1, 0))

    def datagram_received(self, data, sender):
        self.largest = max(self.largest, len(data))
        kind, number = struct.unpack_from(">IQ", data)
        if kind == 3:
            assert number == 0
            self.handshakes.append(data[12:])
            if not self.is_silent:
                self.tracker = sender
                self.say(b"\x03Hey OVR =D 5".ljust(64, b"\0"))
            return
        if kind == 10:
            self.pongs.append(struct.unpack_from(">I", data, 12)[0])
            return
        assert number > (self.numbers[-1] if self.numbers else 0)
        self.numbers.append(number)
        if kind == 100:
            place = 12
            while place < len(data):
                (size,) = struct.unpack_from(">H", data, place)
                (inner,) = struct.unpack_from(">I", data, place + 2)
                self.take(inner, data[place + 6 : place + 2 + size])
                place += 2 + size
        else:
            self.take(kind, data[12:])

    def take(self, kind, payload):
        if kind == 0:
            self.beats += 1
        elif kind == 4:
            *linear, sensor = struct.unpack(">3fB", payload)
            self.accelerations[sensor] = linear
        elif kind == 12:
            self.batteries.append(struct.unpack(">2f", payload))
        elif kind == 15:
            self.sensors[payload[0]] = payload[1]
            if self.acknowledges:
                self.say(struct.pack(">I2B", 15, payload[0], payload[1]))
        elif kind == 17:
            sensor, sort, x, y, z, w, _ = struct.unpack(">2B4fB", payload)
            assert sort == 1
            self.rotations[sensor] = (w, x, y, z)
        elif kind == 22:
            self.say(struct.pack(">IQ", 22, 0) + bytes((self.flags,)))
        else:
            raise AssertionError(f"kind {kind}")


@pytest.fixture
async def server():
    _, protocol = await asyncio.get_running_loop().create_datagram_endpoint(
        StandInServer, local_addr=("127.0.0.1", 0)
    )
    yield protocol
    protocol.transport.close()


def frame(sequence, q_wb=None, acceleration=None):
    n = SKELETON.n_segments
    return SkeletonFrame(
        sequence=sequence, time_ns=10_000_000 * sequence,
        q_wb=t_pose(SKELETON) if q_wb is None else q_wb, angular_rate=np.zeros((n, 3)),
        joint_acceleration=np.zeros((n, 3)) if acceleration is None else acceleration,
        p_w=np.zeros((n, 3)), sigma=np.zeros(n), status=np.zeros(n, np.uint8), root=0,
    )  # fmt: skip


def outputs(server, battery=0.8, **more):
    settings = OutputsSettings(slimevr={"port": server.port, "rate": 1000, **more})
    return SideOutputs(settings, SKELETON, "lab", 100.0, lambda: battery)


async def played(side, until, **made):
    """Offer frames until something holds."""
    for sequence in range(int(100 * PATIENCE_S)):
        side.offer(frame(sequence, **made))
        await asyncio.sleep(0.01)
        if until():
            return
    raise AssertionError("it never came")


@pytest.mark.parametrize("flags", [1, 0])
async def test_a_server_sees_every_segment_turn(server, flags):
    server.flags = flags
    rng = np.random.default_rng(1)
    q_wb = np.array([quaternion.normalise(q) for q in rng.normal(size=(SKELETON.n_segments, 4))])
    linear = rng.normal(size=(SKELETON.n_segments, 3))
    sensors = sensors_of(SKELETON, None)
    async with (side := outputs(server)).running():
        await played(
            side, lambda: len(server.accelerations) == len(sensors) and server.batteries, q_wb=q_wb,
            acceleration=linear,
        )  # fmt: skip
        counters = side.counters["slimevr"]
    assert server.sensors.keys() <= sensors.keys()
    assert len(sensors) == 17
    for number, name in sensors.items():
        row = SKELETON.index(name)
        assert server.rotations[number] == pytest.approx(q_wb[row], abs=1e-6)
        expected = quaternion.rotate_inverse(q_wb[row], linear[row])
        assert server.accelerations[number] == pytest.approx(expected, abs=1e-5)
    assert server.batteries[0][1] == pytest.approx(0.8)
    assert counters.published > 0
    assert server.largest <= 1472


async def test_the_handshake_says_who_it_is_and_sensors_until_they_are_acknowledged(server):
    async with (side := outputs(server)).running():
        await played(side, lambda: len(server.sensors) == 17)
        payload = server.handshakes[0]
        *_, version, length = struct.unpack_from(">7IB", payload)
        assert (version, payload[29 : 29 + length]) == (22, b"mocap-gateway")
        assert payload[29 + length] == 0x02  # an address of its own, of nobody's range
        before = server.sensors.copy()
        server.sensors.clear()
        await asyncio.sleep(1.3)
        assert server.sensors == {}
        assert set(before.values()) == {1}
        assert len(server.handshakes) == 1


async def test_pings_and_heartbeats_are_answered(server):
    async with (side := outputs(server)).running():
        await played(side, lambda: server.rotations)
        for token in (1, 0xFFFFFFFF):
            server.ping(token)
        server.beat()
        await played(side, lambda: len(server.pongs) == 2 and server.beats)
    assert server.pongs == [1, 0xFFFFFFFF]


async def test_without_a_server_poses_are_dropped_and_counted_and_it_is_found_when_it_comes(server):
    server.is_silent = True
    async with (side := outputs(server)).running():
        await played(side, lambda: len(server.handshakes) >= 2)
        counters = side.counters["slimevr"]
        assert counters.published == 0
        assert counters.dropped > 50
        server.is_silent = False
        await played(side, lambda: server.rotations)


async def test_a_server_that_falls_silent_is_greeted_anew(server):
    async with (side := outputs(server)).running():
        await played(side, lambda: server.rotations)
        await played(side, lambda: len(server.handshakes) >= 2)  # three seconds of nothing from it


async def test_strangers_are_not_heard(server):
    async with (side := outputs(server)).running():
        await played(side, lambda: server.rotations)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.1", 0))
            stranger.settimeout(0.3)
            stranger.sendto(struct.pack(">IQI", 10, 0, 7), server.tracker)
            with pytest.raises(TimeoutError):
                stranger.recv(64)


async def test_a_segment_without_orientation_is_left_out(server):
    q_wb = t_pose(SKELETON)
    q_wb[SKELETON.index("head")] = np.nan
    async with (side := outputs(server)).running():
        await played(side, lambda: len(server.rotations) >= 16, q_wb=q_wb)
    heads = [number for number, name in sensors_of(SKELETON, None).items() if name == "head"]
    assert heads[0] not in server.rotations


def test_segments_are_chosen_and_unknown_ones_named():
    assert list(sensors_of(SKELETON, ("right_foot", "pelvis")).values()) == ["pelvis", "right_foot"]
    with pytest.raises(OutputError, match=r"has no 'rigth_foot'.*right_foot"):
        sensors_of(SKELETON, ("rigth_foot",))
    with pytest.raises(OutputError, match="0 segments to send"):
        sensors_of(load_rig("robot_arm_4").skeleton, None)


async def test_an_unknown_host_is_named():
    side = SideOutputs(OutputsSettings(slimevr={"host": "no.such.host.invalid"}), SKELETON, "lab", 100.0)
    with pytest.raises(OutputError, match=r"outputs\.slimevr: no such host"):
        await side.open()
