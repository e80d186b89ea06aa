"""Heat maps of simulated cameras over TCP to MQTT poses, through the whole service."""

from __future__ import annotations

import asyncio
import socket

import numpy as np
import pytest

from devices.links.reconnect import LinkState
from gateway.body.rig import load_rig
from gateway.body.subject_file import write_subject
from gateway.cameras.broker_outlet import BrokerOutlet
from gateway.cameras.serving import Outlet
from gateway.contract.balances import unaccounted
from gateway.contract.topics import CAMERA
from gateway.outputs.connection import broker_connection
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from gateway.recording.video import video_subject, video_suit
from gateway.service.service import Service
from gateway.settings import load_gateway_settings
from tests.running_suit import running
from tests.seen_walk import CAMERAS, seen_walk

pytestmark = [
    pytest.mark.system,
    pytest.mark.slow(reason="compiles the reconstruction from heat maps: a minute"),
]
N = 24


@pytest.fixture(scope="module")
def walk():
    """By instant a message a camera, and the walker's left knee, (N, 3) m."""
    instants, person = seen_walk(N)
    return instants, person.joints[:, person.skeleton.index("left_shank")]


def config_of(tmp_path, instants, links: str, port: int):
    write_subject(tmp_path / "anna.yaml", video_subject("anna", video_suit(CAMERAS, "full", instants)))
    (tmp_path / "gateway.yaml").write_text(
        f"gateway: lab\nrig: anna.yaml\nlinks: [{links}]\n"
        f"mqtt: {{port: {port}, decimals: null, include: [position], queue_length: 100}}\n"
    )
    return tmp_path / "gateway.yaml"


async def heard_of(config, send, n: int):
    """The service, and the first n poses of it that an app receives; ``send(instant)`` publishes one."""
    settings = load_gateway_settings(config)
    service = Service(settings, load_rig(settings.rig, config))
    received = []
    async with asyncio.timeout(200), PoseSubscriber(settings.mqtt, "lab") as poses, running(service):
        sending = asyncio.create_task(send(service))
        async for pose in poses:
            received.append(pose.pose)
            if len(received) == n:
                break
        await sending
        assert unaccounted(service.balances()) == {}
    return service, received


def assert_is_walker(received, knee):
    off = [np.linalg.norm(np.subtract(p.position["left_shank"], knee[p.seq])) for p in received]
    assert [p.seq for p in received] == list(range(len(received)))
    assert np.median(off) < 0.04


async def test_heat_maps_over_tcp_come_out_as_poses(mosquitto, tmp_path, walk):
    instants, knee = walk
    listeners = [socket.create_server(("127.0.0.1", 0)) for _ in CAMERAS]
    outlets = [Outlet(listener) for listener in listeners]
    links = ", ".join(
        f"{{name: {c.name}, url: 'tcp://127.0.0.1:{each.getsockname()[1]}', carries: heat_maps}}"
        for c, each in zip(CAMERAS, listeners, strict=True)
    )

    async def send(service):
        for outlet in outlets:
            await asyncio.to_thread(outlet.wait_for_first)
        for instant in instants:
            for outlet, message in zip(outlets, instant, strict=True):
                outlet.offer(message)
            await asyncio.sleep(0.05)

    config = config_of(tmp_path, instants, links, mosquitto.port)
    service, received = await heard_of(config, send, N - 3)
    for listener in listeners:
        listener.close()
    assert_is_walker(received, knee)
    assert service.statistics()["video"]["dropped"] == {}


async def test_heat_maps_over_mqtt_come_out_as_poses(mosquitto, tmp_path, walk):
    """Among retained, cut off and foreign messages on the same topics."""
    instants, knee = walk
    broker = MqttSettings(port=mosquitto.port)
    outlets = [BrokerOutlet(broker, CAMERA.format(camera=c.name)) for c in CAMERAS]
    async with broker_connection(broker, mosquitto.port, "other") as other:
        await other.publish(CAMERA.format(camera="ring0"), instants[20][0], retain=True)

        async def send(service):
            for outlet in outlets:
                await asyncio.to_thread(outlet.wait_for_first)
            while service.links[0].state is not LinkState.UP:
                await asyncio.sleep(0.05)
            for instant in instants:
                await other.publish(CAMERA.format(camera="ring1"), instant[1][:-1])
                await other.publish(CAMERA.format(camera="x"), b"nothing of ours")
                for outlet, message in zip(outlets, instant, strict=True):
                    outlet.offer(message)
                await asyncio.sleep(0.05)

        link = f"{{name: cameras, url: 'mqtt:///{CAMERA.format(camera='+')}', carries: heat_maps}}"
        config = config_of(tmp_path, instants, link, mosquitto.port)
        service, received = await heard_of(config, send, N - 3)
    for outlet in outlets:
        await asyncio.to_thread(outlet.close)
    assert [outlet.served.sent for outlet in outlets] == [N] * 3
    assert_is_walker(received, knee)
    assert service.statistics()["video"]["dropped"] == {}


async def test_the_command_run_makes_poses_of_a_rig_of_cameras(mosquitto, tmp_path, walk, command):
    """Cameras may serve before the gateway is there, and begin anew: the walk is shown until it is heard."""
    instants, knee = walk
    link = f"{{name: cameras, url: 'mqtt:///{CAMERA.format(camera='+')}', carries: heat_maps}}"
    config = config_of(tmp_path, instants, link, mosquitto.port)
    broker = MqttSettings(port=mosquitto.port)
    outlets = [BrokerOutlet(broker, CAMERA.format(camera=c.name)) for c in CAMERAS]
    process = command("run", "-c", config)
    received = []

    async def show():
        while True:
            for instant in instants:
                for outlet, message in zip(outlets, instant, strict=True):
                    outlet.offer(message)
                await asyncio.sleep(0.05)

    async with asyncio.timeout(240), PoseSubscriber(broker, "lab") as poses:
        showing = asyncio.create_task(show())
        async for pose in poses:
            received.append(pose.pose)
            if len(received) == 2 * N:
                break
        showing.cancel()
    for outlet in outlets:
        await asyncio.to_thread(outlet.close)
    off = [np.linalg.norm(np.subtract(p.position["left_shank"], knee[p.seq])) for p in received[-N:]]
    assert np.median(off) < 0.04
    process.terminate()
    assert await process.ended() == 0
