"""A gateway before a cluster of real brokers, one of which dies or falls silent."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import signal
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aiomqtt
import orjson
import pytest

from gateway.outputs.connection import broker_connection, unique_identifier
from gateway.outputs.failover import BrokerTurns
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.settings import LateSettings, MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from tests.patience import loop_lateness

if TYPE_CHECKING:
    from tests.fixtures.brokers import Mosquitto
    from tests.fixtures.clusters import GuardedCluster
    from tests.fixtures.poses import PoseSource

Until = Callable[..., Awaitable[None]]
RATE_HZ = 50
RECOVER_S = 2.0


def test_addresses_are_tried_in_turn():
    turns = BrokerTurns(MqttSettings(host="a", port=1, failover=("b:2", "c:3")), 1)
    tried, all_failed = [], []
    for _ in range(4):
        tried.append(turns.settings.host)
        all_failed.append(turns.failed())
    assert (tried, all_failed) == (["a", "b", "c", "a"], [False, False, True, False])


@contextlib.asynccontextmanager
async def offering(output: MqttOutput, source: PoseSource) -> AsyncIterator[list[int]]:
    """Offers a pose every 20 ms; yields the numbers of those offered."""
    offered: list[int] = []

    async def offer() -> None:
        while True:
            output.offer(source.frame(len(offered)))
            offered.append(len(offered))
            await asyncio.sleep(1 / RATE_HZ)

    task = asyncio.create_task(offer())
    try:
        yield offered
    finally:
        task.cancel()


@contextlib.asynccontextmanager
async def heard(
    settings: MqttSettings, topic: str, subscribed: asyncio.Event | None = None
) -> AsyncIterator[list[aiomqtt.Message]]:
    """All messages of a filter, from the beginning, or as soon as there is a broker.

    subscribed: set once they are asked for, which is not waited for then."""
    messages: list[aiomqtt.Message] = []
    is_awaited = subscribed is None
    asked = subscribed or asyncio.Event()

    async def listen() -> None:
        while True:
            with contextlib.suppress(aiomqtt.MqttError):
                async with broker_connection(settings, settings.port, unique_identifier("test")) as client:
                    await client.subscribe(topic, qos=1)
                    asked.set()
                    async for message in client.messages:
                        messages.append(message)  # noqa: PERF401 - others look at it meanwhile
            await asyncio.sleep(0.01)

    task = asyncio.create_task(listen())
    try:
        if is_awaited:
            await asked.wait()
        yield messages
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@pytest.mark.system
@pytest.mark.parametrize("how", ["kill", "freeze"])
async def test_poses_go_on_within_two_seconds_and_what_is_missing_comes_late(
    cluster: GuardedCluster, pose_source: PoseSource, tmp_path: Path, until: Until, how: str
) -> None:
    late = LateSettings(folder=tmp_path / "late", rate=500)
    arrived: list[tuple[float, int]] = []
    async with (
        PoseSubscriber(cluster.settings(first=1)) as poses,
        heard(cluster.settings(first=2), "mocap/lab/pose/late") as belated,
        MqttOutput(cluster.settings("lab", late=late), pose_source.skeleton, pose_source.info()) as output,
        offering(output, pose_source) as offered,
        loop_lateness() as lateness,
    ):

        async def read() -> None:
            async for received in poses:
                arrived.append((time.monotonic(), received.pose.seq))  # noqa: PERF401

        reading = asyncio.create_task(read())
        await until(lambda: len(arrived) > 2 * RATE_HZ)
        node = cluster.nodes[0]
        if how == "kill":
            node.kill()
        else:
            os.kill(node.pid, signal.SIGSTOP)
        lost_s, already = time.monotonic(), len(arrived)
        await until(lambda: arrived[-1][0] - lost_s > RECOVER_S + 1 and len(arrived) > already + RATE_HZ)
        longest = max(later[0] - one[0] for one, later in itertools.pairwise(arrived))
        assert longest < RECOVER_S + 4 * lateness.worst_s
        assert poses.states == {"lab": "online"}
        last = offered[-1] - RATE_HZ
        wanted = set(range(last))

        def got() -> set[int]:
            return {seq for _, seq in arrived} | {orjson.loads(each.payload)["seq"] for each in belated}

        try:
            await until(lambda: wanted <= got())
        except TimeoutError:
            pytest.fail(f"neither live nor late: {sorted(wanted - got())}")
        if how == "freeze":
            os.kill(node.pid, signal.SIGCONT)
            await until(lambda: poses.overtaken > 0)  # what it had taken, and hands on as if it were live
        reading.cancel()
        assert_in_order(seq for _, seq in arrived)


def assert_in_order(numbers: Iterable[int]) -> None:
    assert all(one < later for one, later in itertools.pairwise(numbers))


@pytest.mark.system
@pytest.mark.parametrize("cut_off", [0, 1, 2], ids=["where poses go", "the one that stands by", "another"])
async def test_nodes_that_do_not_hear_each_other_both_get_poses(
    cluster: GuardedCluster, pose_source: PoseSource, tmp_path: Path, until: Until, cut_off: int
) -> None:
    """Readers are at each node: those who are cut off read another one too."""
    routes = cluster.routes
    assert routes is not None
    late = LateSettings(folder=tmp_path / "late", rate=500)
    arrived: dict[int, list[tuple[float, int]]] = {0: [], 1: [], 2: []}
    output = MqttOutput(cluster.settings("lab", late=late), pose_source.skeleton, pose_source.info())

    async def read(node: int, poses: PoseSubscriber) -> None:
        async for received in poses:
            arrived[node].append((time.monotonic(), received.pose.seq))

    async with contextlib.AsyncExitStack() as stack:
        readers = [
            await stack.enter_async_context(PoseSubscriber(cluster.settings(first=node))) for node in arrived
        ]
        reading = [asyncio.create_task(read(node, poses)) for node, poses in enumerate(readers)]
        for task in reading:
            stack.callback(task.cancel)
        settings = cluster.settings(first=(cut_off + 1) % 3)
        belated = await stack.enter_async_context(heard(settings, "mocap/lab/pose/late"))
        await stack.enter_async_context(output)
        offered = await stack.enter_async_context(offering(output, pose_source))
        await until(lambda: all(len(each) > 3 * RATE_HZ for each in arrived.values()))
        lateness = await stack.enter_async_context(loop_lateness())
        routes.cut(cut_off)
        cut_s = time.monotonic()
        others = [numbers for node, numbers in arrived.items() if node != cut_off]
        await until(lambda: all(each[-1][0] - cut_s > RECOVER_S + 2 for each in others))
        for each in others:
            longest = max(later[0] - one[0] for one, later in itertools.pairwise(each))
            assert longest < RECOVER_S + 4 * lateness.worst_s
        # Its readers subscribe elsewhere, which a cluster that chooses a leader lets wait.
        await until(lambda: arrived[cut_off][-1][0] - cut_s > RECOVER_S + 2)
        routes.cut(None)
        last = offered[-1]
        await until(lambda: all(each[-1][1] > last + RATE_HZ for each in arrived.values()))

        def missing(node: int) -> set[int]:
            came = {seq for _, seq in arrived[node]} | {orjson.loads(each.payload)["seq"] for each in belated}
            return set(range(min(seq for _, seq in arrived[node]), last)) - came

        await until(lambda: not any(missing(node) for node in arrived if node != cut_off))
        for numbers in arrived.values():
            assert_in_order(seq for _, seq in numbers)
        for node in arrived:
            async with heard(cluster.settings(first=node), "mocap/lab/bridge/state") as kept:
                await until(lambda kept=kept: kept and kept[-1].payload == b'{"state":"online"}')


@pytest.mark.system
async def test_poses_that_a_full_queue_gives_up_come_late(
    mosquitto: Mosquitto, pose_source: PoseSource, tmp_path: Path, until: Until
) -> None:
    """A broker that is frozen takes what its socket holds; then the queue runs over."""
    late = LateSettings(folder=tmp_path / "late", rate=2000)
    settings = MqttSettings(port=mosquitto.port, late=late)
    live: list[int] = []
    async with (
        heard(MqttSettings(port=mosquitto.port), "mocap/lab/pose/late") as belated,
        PoseSubscriber(MqttSettings(port=mosquitto.port)) as poses,
        MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
    ):

        async def read() -> None:
            async for received in poses:
                live.append(received.pose.seq)  # noqa: PERF401

        reading = asyncio.create_task(read())
        await until(lambda: output.is_connected)
        for seq in range(3000):
            if seq == 500:
                mosquitto.freeze()
            if seq == 2500:
                mosquitto.thaw()
            output.offer(pose_source.frame(seq))
            await asyncio.sleep(0.001)
        await until(
            lambda: (
                {*range(live[0], 2900)} <= {*live} | {orjson.loads(each.payload)["seq"] for each in belated}
            )
        )
        reading.cancel()
        assert_in_order(live)
        counters = output.counters
        assert counters.dropped == 0
        assert counters.published + counters.queued + counters.late == 3000


@pytest.mark.system
async def test_one_broker_that_was_away_gets_poses_late_on_a_topic_of_their_own(
    mosquitto: Mosquitto,
    pose_source: PoseSource,
    tmp_path: Path,
    until: Until,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = MqttSettings(port=mosquitto.port, late=LateSettings(folder=tmp_path, rate=1000))
    may_connect = asyncio.Event()
    may_connect.set()

    @contextlib.asynccontextmanager
    async def when_allowed(*named: Any, **options: Any) -> AsyncIterator[aiomqtt.Client]:
        """The gateway's connection, which waits for the reader: who comes later gets no late pose."""
        await may_connect.wait()
        async with broker_connection(*named, **options) as client:
            yield client

    monkeypatch.setattr("gateway.outputs.mqtt.broker_connection", when_allowed)
    async with (
        MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output,
        offering(output, pose_source) as offered,
    ):
        await until(lambda: output.is_connected)
        may_connect.clear()
        mosquitto.stop()
        await until(lambda: not output.is_connected)
        first_away = offered[-1] + 1
        await until(lambda: offered[-1] > first_away + RATE_HZ)
        last_away = offered[-1]
        async with heard(settings, "mocap/lab/#", may_connect) as messages:
            mosquitto.start()
            away = set(range(first_away, last_away))
            belated: list[dict[str, object]] = []

            def all_came() -> bool:
                belated[:] = [
                    orjson.loads(each.payload)
                    for each in messages
                    if each.topic.value == "mocap/lab/pose/late"
                ]
                return away <= {each["seq"] for each in belated}

            await until(all_came)
            live = {
                orjson.loads(each.payload)["seq"] for each in messages if each.topic.value == "mocap/lab/pose"
            }
            assert not live & away
            assert all(each["instance"] == output.instance for each in belated)
        counters = output.counters
        total = counters.published + counters.dropped + counters.queued + counters.late
        assert total == len(offered)


@pytest.mark.system
async def test_a_gateway_may_publish_its_own_topics_and_nobody_elses(
    cluster: GuardedCluster, pose_source: PoseSource, until: Until
) -> None:
    """And an overview may ask, but make no poses."""
    async with heard(cluster.settings(), "mocap/#") as messages:
        for user in ("lab", "overview"):
            settings = cluster.settings(user, first=1)
            async with broker_connection(settings, settings.port, unique_identifier("test")) as client:
                for topic in ("mocap/ward/pose", "mocap/lab/pose", "mocap/lab/bridge/request/gateway/info"):
                    await client.publish(topic, user.encode())
        await until(lambda: len(messages) >= 3)
        await asyncio.sleep(0.3)
        assert sorted((each.topic.value, each.payload) for each in messages) == [
            ("mocap/lab/bridge/request/gateway/info", b"lab"),
            ("mocap/lab/bridge/request/gateway/info", b"overview"),
            ("mocap/lab/pose", b"lab"),
        ]


@pytest.mark.system
async def test_a_second_gateway_of_one_name_is_told_by_both_on_two_nodes(
    cluster: GuardedCluster, pose_source: PoseSource, until: Until, caplog: pytest.LogCaptureFixture
) -> None:
    one = MqttOutput(cluster.settings("lab", health_interval=0.3), pose_source.skeleton, pose_source.info())
    other = MqttOutput(
        cluster.settings("lab", first=1, health_interval=0.3), pose_source.skeleton, pose_source.info()
    )
    async with one, other:
        await until(lambda: one.twin == other.instance and other.twin == one.instance)
    assert any("another gateway publishes on mocap/lab" in record.message for record in caplog.records)


@pytest.mark.system
async def test_no_node_there_is_told_and_awaited(pose_source: PoseSource) -> None:
    settings = MqttSettings(port=9, failover=("127.0.0.1:10", "127.0.0.1:11"))
    async with MqttOutput(settings, pose_source.skeleton, pose_source.info()) as output:
        output.offer(pose_source.frame(1))
        await asyncio.sleep(1)
        assert output.is_running
        assert output.counters.queued == 1
