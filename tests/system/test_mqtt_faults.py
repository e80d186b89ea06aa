"""The MQTT output when the broker is absent, frozen or restarted, or the gateway is killed."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

import aiomqtt
import numpy as np
import pytest

from gateway.outputs import connection, mqtt
from gateway.outputs.failover import BrokerUnreachableError
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from tests.patience import PATIENCE_S

if TYPE_CHECKING:
    from tests.fixtures.brokers import Mosquitto
    from tests.fixtures.poses import PoseSource

Until = Callable[..., Awaitable[None]]
AnnouncedDeath = Callable[[str, MqttSettings], Awaitable[None]]

pytestmark = pytest.mark.system

GATEWAY_THAT_PUBLISHES = """
import asyncio, sys
import numpy as np
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import BridgeInfo
from gateway.outputs.settings import MqttSettings
from gateway.outputs.mqtt import MqttOutput

async def main():
    skeleton = Skeleton("one", ("pelvis",), np.array([-1]), np.zeros((1, 3)), np.zeros((1, 3)))
    info = BridgeInfo(version="0", gateway="victim", reconstructor="inertial", frame_rate=100.0)
    async with MqttOutput(MqttSettings(port=int(sys.argv[1]), keepalive=600), skeleton, info):
        await asyncio.sleep(60)

asyncio.run(main())
"""


QUICK_S = PATIENCE_S / 2
"""Less than anything that waits for a broker takes here: see ``_brokers_are_given_time``."""


async def stopping_s(output: MqttOutput) -> float:
    """How long an output takes to stop, s."""
    began = time.monotonic()
    await output.stop()
    return time.monotonic() - began


def warnings_of(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


async def test_absent_broker_is_reported_once_and_awaited(
    mosquitto: Mosquitto,
    pose_source: PoseSource,
    caplog: pytest.LogCaptureFixture,
    until: Until,
    attempts: list[float],
) -> None:
    caplog.set_level(logging.INFO)
    mosquitto.stop()
    settings = MqttSettings(port=mosquitto.port, queue_length=8)
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        for sequence in range(50):
            output.offer(pose_source.frame(sequence))
        await until(lambda: len(attempts) > 2)  # two have failed
        counters = output.counters
        assert (counters.dropped, counters.queued, counters.published) == (42, 8, 0)
        (warning,) = warnings_of(caplog)
        assert f"no MQTT broker at 127.0.0.1:{mosquitto.port}" in warning
        assert "is mosquitto running?" in warning
        assert "broker: embedded" in warning
        mosquitto.start()
        await until(lambda: output.counters.published == 1)  # the last of them, and no older one
        assert output.counters.dropped == 49
    assert len(warnings_of(caplog)) == 1


async def test_stop_is_quick_without_a_broker(
    unused_port: int, pose_source: PoseSource, until: Until, attempts: list[float]
) -> None:
    output = MqttOutput(MqttSettings(port=unused_port), pose_source.skeleton, pose_source.info())
    await output.start()
    await until(lambda: len(attempts) > 1)
    assert await stopping_s(output) < QUICK_S


async def test_subscriber_says_that_there_is_no_broker(unused_port: int) -> None:
    with pytest.raises(BrokerUnreachableError, match=f"127.0.0.1:{unused_port}.*is mosquitto running"):
        async with PoseSubscriber(MqttSettings(port=unused_port)):
            pass


async def test_silent_broker_is_told_from_an_absent_one(
    mosquitto: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "TIMEOUT_S", 0.2)
    mosquitto.freeze()
    with pytest.raises(BrokerUnreachableError, match="does not answer: is it frozen"):
        async with PoseSubscriber(MqttSettings(port=mosquitto.port)):
            pass


async def test_a_port_that_hangs_up_at_once_does_not_cost_the_time_out(unused_port: int) -> None:
    """A port forwarder takes connections for a broker that is away: each attempt once took two seconds."""
    attempts: list[float] = []

    def hang_up(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        attempts.append(time.monotonic())
        writer.close()

    server = await asyncio.start_server(hang_up, "127.0.0.1", unused_port)
    with pytest.raises(aiomqtt.MqttError, match="hung up"):
        async with connection.broker_connection(MqttSettings(port=unused_port), unused_port, "early"):
            pass
    assert time.monotonic() - attempts[0] < connection.TIMEOUT_S
    server.close()


async def test_frozen_broker_costs_poses_but_no_time_and_no_memory(
    mosquitto: Mosquitto,
    large_pose_source: PoseSource,
    caplog: pytest.LogCaptureFixture,
    until: Until,
    attempts: list[float],
) -> None:
    source = large_pose_source
    settings = MqttSettings(port=mosquitto.port, keepalive=1, queue_length=4)
    output = MqttOutput(settings, source.skeleton, source.info())
    await output.start()
    await until(lambda: output.is_connected)
    mosquitto.freeze()
    frame, offered, longest_turn = source.frame(0), 0, 0.0
    while output.is_connected:  # until the keep-alive, or a full buffer, finds out
        turn = time.monotonic()
        for _ in range(5):
            output.offer(frame)
        offered += 5
        await asyncio.sleep(0.005)
        longest_turn = max(longest_turn, time.monotonic() - turn)
    counters = output.counters
    assert counters.dropped > 100
    assert counters.queued <= 4
    assert counters.published + counters.dropped + counters.queued == offered
    assert counters.published * 80_000 < 8e6  # bytes that the buffers of the sockets took
    assert longest_turn < QUICK_S  # half of what a blocking publish would take
    await until(lambda: len(attempts) > 1)  # now it tries to connect to a broker that does not answer
    await asyncio.sleep(0.1)
    assert await stopping_s(output) < QUICK_S
    assert [w for w in warnings_of(caplog) if "lost the MQTT broker" in w] == warnings_of(caplog)


async def test_stop_is_quick_while_the_broker_is_frozen(
    mosquitto: Mosquitto, large_pose_source: PoseSource, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = large_pose_source
    monkeypatch.setattr(mqtt, "_DRAIN_S", 0.2)
    monkeypatch.setattr(mqtt, "_FAREWELL_S", 0.5)
    settings = MqttSettings(port=mosquitto.port, keepalive=60, queue_length=100)
    output = MqttOutput(settings, source.skeleton, source.info())
    await output.start()
    await until(lambda: output.is_connected)
    mosquitto.freeze()
    frame = source.frame(0)
    for _ in range(100):
        output.offer(frame)
    await asyncio.sleep(0.05)
    assert output.is_connected
    assert await stopping_s(output) < QUICK_S


async def test_recovers_when_a_frozen_broker_thaws(
    mosquitto: Mosquitto, pose_source: PoseSource, until: Until
) -> None:
    settings = MqttSettings(port=mosquitto.port, keepalive=1)
    async with (
        MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
        PoseSubscriber(settings) as poses,
    ):
        await until(lambda: output.is_connected)
        mosquitto.freeze()
        await until(lambda: not output.is_connected)
        mosquitto.thaw()
        await until(lambda: output.is_connected and poses.is_connected)
        await until(lambda: poses.states.get("lab") == "online")
        output.offer(pose_source.frame(7))
        received = await asyncio.wait_for(anext(aiter(poses)), PATIENCE_S)
        assert received.pose.seq == 7


async def test_restarted_broker_knows_everything_again(
    mosquitto: Mosquitto,
    pose_source: PoseSource,
    caplog: pytest.LogCaptureFixture,
    until: Until,
    attempts: list[float],
) -> None:
    caplog.set_level(logging.INFO, logger="gateway.outputs.mqtt")
    settings = MqttSettings(port=mosquitto.port)
    async with (
        MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
        PoseSubscriber(settings) as early,
    ):
        await until(lambda: output.is_connected)
        mosquitto.stop()
        await until(lambda: not output.is_connected)
        mosquitto.start()
        in_vain = len(attempts)
        await until(lambda: output.counters.connections == 2 and early.is_connected)
        assert len(attempts) <= in_vain + 1  # back within one pause, of a second at most
        assert connection.broker_back_off().longest <= 1.0
        async with PoseSubscriber(settings) as late:
            await until(lambda: late.states == {"lab": "online"} and {*late.infos, *late.bodies} == {"lab"})
        output.offer(pose_source.frame(3))
        assert (await asyncio.wait_for(anext(aiter(early)), PATIENCE_S)).pose.seq == 3
    lines = [record.getMessage() for record in caplog.records if record.name == "gateway.outputs.mqtt"]
    assert [line.split(" the MQTT")[0] for line in lines] == ["connected to", "lost", "connected again to"]


async def test_broker_announces_the_death_of_a_killed_gateway(
    mosquitto: Mosquitto, announced_death: AnnouncedDeath
) -> None:
    await announced_death(GATEWAY_THAT_PUBLISHES, MqttSettings(port=mosquitto.port))


async def test_what_cannot_be_encoded_is_dropped_and_the_output_lives_on(
    mosquitto: Mosquitto, pose_source: PoseSource, caplog: pytest.LogCaptureFixture, until: Until
) -> None:
    def broken_health() -> dict[str, object]:
        raise RuntimeError("no statistics today")

    settings = MqttSettings(port=mosquitto.port, health_interval=0.02)
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info(), broken_health) as output:
        await until(lambda: output.is_connected)
        good = pose_source.frame(0)
        object.__setattr__(good, "q_wb", np.zeros((3, 4)))  # 3 rows for 17 segments
        output.offer(good)
        output.offer(good)
        output.offer(pose_source.frame(1))
        await until(lambda: output.counters.published == 1 and len(warnings_of(caplog)) == 2)
        await asyncio.sleep(0.1)
        assert output.counters.dropped == 2
        assert output.counters.connections == 1
    complaints = warnings_of(caplog)
    assert len(complaints) == 2
    assert {"no statistics today" in line for line in complaints} == {True, False}


async def test_nonsense_on_the_topics_is_counted_by_the_subscriber(
    mosquitto: Mosquitto, pose_source: PoseSource, until: Until
) -> None:
    mosquitto.is_for_gateways_only = False
    settings = MqttSettings(port=mosquitto.port)
    async with (
        PoseSubscriber(settings) as poses,
        connection.broker_connection(settings, mosquitto.port, "vandal") as vandal,
    ):
        for payload in (b"", b"{", b"\xff\x00", b'{"t_ns":1}', b"null"):
            await vandal.publish("mocap/lab/pose", payload)
            await vandal.publish("mocap/lab/bridge/state", payload, qos=1)
        # The empty state is none of them: with it a gateway's name is taken off the broker.
        await until(lambda: poses.undecodable == 9)
        assert poses.states == {}
