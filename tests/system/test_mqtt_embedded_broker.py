"""The broker that the gateway brings along, in its own process."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TYPE_CHECKING

import aiomqtt
import psutil
import pytest
from amqtt.adapters import StreamReaderAdapter, StreamWriterAdapter

from gateway.outputs.broker_process import BrokerProcess, EmbeddedBrokerError
from gateway.outputs.connection import broker_connection
from gateway.outputs.embedded_broker import _Broker, broker_config
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from tests.patience import PATIENCE_S

if TYPE_CHECKING:
    from tests.fixtures.poses import PoseSource

Until = Callable[..., Awaitable[None]]
AnnouncedDeath = Callable[[str, MqttSettings], Awaitable[None]]

pytestmark = pytest.mark.system

PARENT_WITH_A_BROKER = """
import asyncio, json
from gateway.outputs.broker_process import BrokerProcess

async def main():
    broker = BrokerProcess(0)
    await broker.start()
    print(json.dumps({"pid": broker.pid, "port": broker.port}), flush=True)
    await asyncio.sleep(60)

asyncio.run(main())
"""

CLIENT_WITH_A_WILL = """
import asyncio, sys
import aiomqtt

async def main():
    will = aiomqtt.Will("mocap/victim/bridge/state", '{"state":"offline"}', qos=1, retain=True)
    async with aiomqtt.Client("127.0.0.1", int(sys.argv[1]), will=will, keepalive=600) as client:
        await client.publish("mocap/victim/bridge/state", '{"state":"online"}', qos=1, retain=True)
        await asyncio.sleep(60)

asyncio.run(main())
"""


@pytest.fixture
async def broker() -> AsyncIterator[BrokerProcess]:
    process = BrokerProcess(0)
    await process.start()
    yield process
    await process.stop()


def settings_for(broker: BrokerProcess) -> MqttSettings:
    return MqttSettings(port=broker.port)


async def test_first_run_needs_nothing_but_the_gateway(
    pose_source: PoseSource, until: Until, attempts: list[float]
) -> None:
    settings = MqttSettings(broker="embedded", port=0)
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        await until(lambda: output.is_connected)
        assert len(attempts) == 1  # as soon as the broker listens, and not after a pause between attempts
        here = settings.model_copy(update={"port": output.port})
        async with PoseSubscriber(here) as poses:
            await until(lambda: poses.states == {"lab": "online"} and "lab" in poses.bodies)
            for sequence in range(20):
                output.offer(pose_source.frame(sequence))
                received = await asyncio.wait_for(anext(aiter(poses)), PATIENCE_S)
                assert received.pose.seq == sequence
            await output.stop()
            assert poses.states == {"lab": "offline"}


async def test_last_will_reaches_subscribers_and_late_comers(
    broker: BrokerProcess, announced_death: AnnouncedDeath
) -> None:
    await announced_death(CLIENT_WITH_A_WILL, settings_for(broker))


async def test_subscriber_ignores_what_it_did_not_ask_for(
    broker: BrokerProcess, pose_source: PoseSource, until: Until
) -> None:
    settings = settings_for(broker)
    async with broker_connection(settings, broker.port, "noisy") as noisy:
        await noisy.subscribe("#")
        await noisy.publish("ret/kept", b"kept", qos=1, retain=True)
        await noisy.publish("mocap/hall/bridge/state", b'{"state":"online"}', qos=1, retain=True)
        async with (
            MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
            PoseSubscriber(settings, "lab") as poses,
        ):
            await until(lambda: output.is_connected and poses.states == {"lab": "online"})
            await asyncio.sleep(0.1)
            assert poses.states == {"lab": "online"}
            assert poses.undecodable == 0


async def test_what_is_retained_goes_to_those_who_asked_for_it(broker: BrokerProcess) -> None:
    """``mosquitto_sub -t 'mocap/+/pose' -C 1`` beside other subscribers is to print a pose."""
    settings = settings_for(broker)
    async with broker_connection(settings, broker.port, "first") as first:
        await first.subscribe("#")
        await first.publish("mocap/lab/bridge/state", b"online", qos=1, retain=True)
        await first.publish("mocap/lab/kept", b"kept", qos=1, retain=True)
        async with broker_connection(settings, broker.port, "second") as second:
            await second.subscribe([("mocap/+/kept", 0), ("mocap/+/pose", 0)])
            await first.publish("mocap/lab/pose", b"pose", qos=1)
            async with asyncio.timeout(PATIENCE_S):
                heard = [(await anext(second.messages)).topic.value for _ in range(2)]
    assert heard == ["mocap/lab/kept", "mocap/lab/pose"]


async def test_listens_on_loopback_only_and_publishes_nothing_of_its_own(broker: BrokerProcess) -> None:
    assert broker.pid is not None
    listening = [c.laddr for c in psutil.Process(broker.pid).net_connections() if c.status == "LISTEN"]
    assert [(address.ip, address.port) for address in listening] == [("127.0.0.1", broker.port)]
    async with broker_connection(settings_for(broker), broker.port, "reader") as reader:
        await reader.subscribe([("$SYS/#", 0), ("#", 0)])
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await anext(aiter(reader.messages))


async def test_websocket_clients_are_served_too(unused_port: int) -> None:
    broker = BrokerProcess(0, websocket_port=unused_port)
    await broker.start()
    try:
        async with aiomqtt.Client("127.0.0.1", unused_port, transport="websockets") as browser:
            await browser.subscribe("mocap/#")
            async with broker_connection(settings_for(broker), broker.port, "gateway") as gateway:
                await gateway.publish("mocap/lab/pose", b"here")
            message = await asyncio.wait_for(anext(aiter(browser.messages)), PATIENCE_S)
            assert message.payload == b"here"
    finally:
        await broker.stop()


async def test_busy_port_is_one_clear_line(broker: BrokerProcess, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(EmbeddedBrokerError, match=f"port {broker.port} is taken.*broker: external"):
        await BrokerProcess(broker.port).start()
    with pytest.raises(EmbeddedBrokerError, match=f"WebSocket port {broker.port} is taken"):
        await BrokerProcess(0, websocket_port=broker.port).start()
    assert capfd.readouterr() == ("", "")


async def test_dies_with_the_gateway(until: Until) -> None:
    command = (sys.executable, "-c", PARENT_WITH_A_BROKER)
    parent = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)
    try:
        assert parent.stdout is not None
        child = psutil.Process(json.loads(await parent.stdout.readline())["pid"])
        assert child.is_running()
    finally:
        parent.kill()
        await parent.wait()
    await until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)


async def test_comes_back_when_it_dies(
    pose_source: PoseSource, caplog: pytest.LogCaptureFixture, until: Until
) -> None:
    caplog.set_level(logging.WARNING)
    settings = MqttSettings(broker="embedded", port=0)
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        await until(lambda: output.is_connected)
        port = output.port
        children = psutil.Process().children()
        (victim,) = [c for c in children if "gateway.outputs.embedded_broker" in c.cmdline()]
        os.kill(victim.pid, signal.SIGKILL)
        await until(lambda: output.counters.connections == 2)
        assert output.port == port
        async with PoseSubscriber(settings.model_copy(update={"port": port})) as poses:
            await until(lambda: poses.states == {"lab": "online"})
    assert "the embedded broker ended (exit code -9): starting it again" in caplog.text


@pytest.mark.parametrize("is_clean", [True, False])
async def test_who_has_gone_is_forgotten(until: Until, is_clean: bool) -> None:
    """Ever new client ids leave nothing behind, sessions that ask to be kept neither."""
    broker = _Broker(broker_config(), None, ())

    async def take_client(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await broker.external_connected(StreamReaderAdapter(reader), StreamWriterAdapter(writer), "default")

    server = await asyncio.start_server(take_client, "127.0.0.1", 0)
    await broker.start()
    port = server.sockets[0].getsockname()[1]
    for number in range(20):
        name = f"client{number}"
        async with aiomqtt.Client("127.0.0.1", port, identifier=name, clean_session=is_clean) as client:
            await client.subscribe(f"topic/{number}")
            assert name in broker.sessions
    await until(lambda: not broker.sessions)
    assert not broker.subscriptions
    server.close()
    await broker.shutdown()
