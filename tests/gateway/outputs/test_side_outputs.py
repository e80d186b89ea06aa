"""Outputs beside MQTT: what they send arrives, what they cannot send is counted, nothing waits."""

from __future__ import annotations

import asyncio
import socket
import time

import numpy as np
import pytest
from pydantic import ValidationError
from pythonosc.osc_packet import OscPacket

from gateway.body.rig import load_rig
from gateway.contract.messages import PoseMessage
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.settings import OutputsSettings
from gateway.outputs.side_outputs import SINKS, LatestOutput, SideOutputs
from gateway.outputs.unity import t_pose
from tests.patience import PATIENCE_S

SKELETON = load_rig("suit_17").skeleton


def frame(sequence):
    n = SKELETON.n_segments
    return SkeletonFrame(
        sequence=sequence, time_ns=10_000_000 * sequence, q_wb=t_pose(SKELETON),
        angular_rate=np.zeros((n, 3)),
        joint_acceleration=np.zeros((n, 3)), p_w=np.zeros((n, 3)), sigma=np.zeros(n),
        status=np.zeros(n, np.uint8), root=0,
    )  # fmt: skip


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        sock.settimeout(PATIENCE_S)
        yield sock


def outputs(**settings):
    return SideOutputs(OutputsSettings(**settings), SKELETON, "lab", 100.0)


def test_every_output_that_can_be_configured_is_made():
    assert set(SINKS) == set(OutputsSettings.model_fields)


def test_all_are_off_unless_configured():
    assert outputs().counters == {}


async def test_udp_json_is_the_pose_message_at_its_rate(receiver):
    port = receiver.getsockname()[1]
    side = outputs(udp_json={"port": port, "rate": 50, "include": ["position"]})
    async with side.running():
        for sequence in range(100):
            side.offer(frame(sequence))
            await asyncio.sleep(0)
        counters = side.counters["udp_json"]
    assert (counters.published, counters.thinned, counters.dropped) == (50, 50, 0)
    poses = [PoseMessage.model_validate_json(receiver.recv(65536)) for _ in range(50)]
    assert [pose.seq for pose in poses] == list(range(0, 100, 2))
    assert set(poses[0].position) == set(SKELETON.segment_names)


async def test_vmc_arrives_as_osc(receiver, until):
    side = outputs(vmc={"port": receiver.getsockname()[1]})
    async with side.running():
        side.offer(frame(0))
        await until(lambda: side.counters["vmc"].published == 1)
    received = [OscPacket(receiver.recv(2048)) for _ in range(2)]
    addresses = [timed.message.address for packet in received for timed in packet.messages]
    assert addresses.count("/VMC/Ext/Bone/Pos") == 17


async def test_nobody_listening_costs_nothing():
    side = outputs(udp_json={"port": 9, "rate": 1000})
    async with side.running():
        began = time.monotonic()
        for sequence in range(50):
            side.offer(frame(sequence))
            await asyncio.sleep(0)
        assert time.monotonic() - began < PATIENCE_S / 3
        counters = side.counters["udp_json"]
    assert counters.published + counters.dropped + counters.queued == 50


class Clogged:
    """A sink whose system takes nothing, then fails."""

    def __init__(self):
        self.sent = 0

    async def open(self):
        pass

    def send(self, _frame):
        self.sent += 1
        if self.sent > 2:
            raise OSError("no route")
        return False

    def close(self):
        pass


async def test_what_waits_gives_way_and_every_loss_is_counted(caplog):
    output = LatestOutput("test", Clogged(), 1000)
    await output.start()
    for sequence in range(10):
        output.offer(frame(sequence))  # nobody runs meanwhile: nine give way
    assert output.counters.queued == 1
    assert output.counters.dropped == 9
    for sequence in range(10, 14):
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        output.offer(frame(sequence))
    await asyncio.sleep(0.01)
    await output.stop()
    counters = output.counters
    assert counters.published == 0
    assert counters.dropped + counters.queued == 14
    assert [record.getMessage() for record in caplog.records] == [
        "output test: a pose could not be sent (no route)"
    ]


async def test_an_unknown_host_is_named():
    side = outputs(vmc={"host": "no-such-host.invalid"})
    with pytest.raises(OutputError, match=r"outputs.vmc: no such host 'no-such-host.invalid'"):
        async with side.running():
            pass


@pytest.mark.parametrize("wrong", [{"port": 0}, {"rate": 0}, {"hots": "x"}])
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(ValidationError):
        OutputsSettings(vmc=wrong)


async def test_an_lsl_stream_is_received_with_its_instants():
    try:
        import pylsl  # noqa: PLC0415
    except (ImportError, RuntimeError, OSError) as error:
        pytest.skip(f"LSL is not there: {error}")
    from devices.link import gateway_time_ns  # noqa: PLC0415

    side = outputs(lsl={"name": "mocap-test", "rate": 1000})
    async with side.running():
        found = await asyncio.to_thread(pylsl.resolve_byprop, "name", "mocap-test", 1, 3.0)
        if not found:
            pytest.skip("LSL finds no stream on this machine: multicast and loopback discovery are closed")
        inlet = pylsl.StreamInlet(found[0])
        await asyncio.to_thread(inlet.open_stream, 5.0)
        sent = frame(1)
        object.__setattr__(sent, "time_ns", gateway_time_ns() - 20_000_000)
        offered = pylsl.local_clock()
        side.offer(sent)
        sample, stamp = await asyncio.to_thread(inlet.pull_sample, 5.0)
    assert found[0].channel_count() == 4 * SKELETON.n_segments
    np.testing.assert_allclose(sample, t_pose(SKELETON).ravel(), atol=1e-6)
    assert offered - stamp == pytest.approx(0.02, abs=0.01)


async def test_absent_lsl_is_one_line(monkeypatch):
    import builtins  # noqa: PLC0415
    import importlib  # noqa: PLC0415

    def refuse(name, *_):
        if name == "pylsl":
            raise RuntimeError("LSL binary library file was not found")
        return builtins.__import__(name)

    monkeypatch.setattr(importlib, "import_module", refuse)
    side = outputs(lsl={})
    with pytest.raises(OutputError, match=r"library file was not found.*pip install .*\[lsl\]"):
        async with side.running():
            pass
