"""Commands that show what gateways publish, before a cluster of real brokers, one of which dies."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TYPE_CHECKING, Any

import pytest

from gateway.fleet.cluster import READER
from gateway.outputs.mqtt import MqttOutput

if TYPE_CHECKING:
    from tests.fixtures.clusters import GuardedCluster
    from tests.fixtures.poses import PoseSource

pytestmark = pytest.mark.system

Until = Callable[..., Awaitable[None]]
FIRST = 0
"""The node whose address is given by --host and --port: the one that dies."""


def addresses(cluster: GuardedCluster) -> list[str]:
    settings = cluster.settings(READER, FIRST)
    further = [f"--failover={address}" for address in settings.failover]
    return ["--port", str(settings.port), *further, "--username", READER, *_password(cluster)]


def _password(cluster: GuardedCluster) -> list[str]:
    return ["--password-file", str(cluster.settings(READER, FIRST).password_file)]


@contextlib.asynccontextmanager
async def publishing(cluster: GuardedCluster, source: PoseSource) -> AsyncIterator[MqttOutput]:
    """A gateway at a node that stays, which publishes at 20 Hz."""

    async def publish(output: MqttOutput) -> None:
        for sequence in range(1_000_000):
            output.offer(source.frame(sequence))
            await asyncio.sleep(0.05)

    async with MqttOutput(cluster.settings("lab", FIRST + 2), source.skeleton, source.info()) as output:
        task = asyncio.create_task(publish(output))
        try:
            yield output
        finally:
            task.cancel()


async def test_poses_go_on_in_watch_when_its_node_dies(
    cluster: GuardedCluster, pose_source: PoseSource, command: Any
) -> None:
    async with publishing(cluster, pose_source):
        watch = command("watch", *addresses(cluster), "--json")

        def newest() -> int:
            whole = watch.output.rpartition("\n")[0].splitlines()
            return int(json.loads(whole[-1])["seq"]) if whole else -1

        await watch.until_so(lambda: newest() > 20, "poses")
        cluster.nodes[FIRST].kill()
        last = newest()
        await watch.until_so(lambda: newest() > last + 60, "poses over another node")


async def test_the_overview_goes_on_when_its_node_dies(
    cluster: GuardedCluster, pose_source: PoseSource, command: Any
) -> None:
    async with publishing(cluster, pose_source):
        watch = command("fleet", "watch", *addresses(cluster))
        await watch.until_it_says(r"1 gateways, 1 online, [1-9]\d* poses/s")
        cluster.nodes[FIRST].kill()
        before = len(watch.output)
        # The first lines may still count poses from before.
        await watch.until_so(
            lambda: len(re.findall(r"1 online, [1-9]\d* poses/s", watch.output[before:])) > 2,
            "poses over another node",
        )
    await watch.until_it_says(r"1 gateways, 0 online")


async def test_the_page_of_a_body_goes_on_when_its_node_dies(
    cluster: GuardedCluster,
    pose_source: PoseSource,
    command: Any,
    chromium: str,
    unused_port: int,
) -> None:
    shown_page = pytest.importorskip("tests.shown_page", reason="the extra 'viewer' is not installed")
    async with publishing(cluster, pose_source) as output:
        view = command("view", *addresses(cluster), "--gateway", "lab", "--page-port", unused_port)
        await view.until_it_says("live page")
        async with shown_page.browser_of(chromium) as browser:
            page = await shown_page.new_page(browser)
            await page.goto(f"http://127.0.0.1:{unused_port}")
            await page.get_by_text("lab: online").wait_for()
            cluster.nodes[FIRST].kill()
            await asyncio.gather(output.stop(), page.get_by_text("lab: offline").wait_for())


@pytest.mark.parametrize("words", [["watch", "--once"], ["fleet", "list", "--seconds", "1"]])
async def test_a_node_that_is_away_is_passed_over(
    cluster: GuardedCluster, pose_source: PoseSource, command: Any, words: list[str]
) -> None:
    cluster.nodes[FIRST].kill()
    async with publishing(cluster, pose_source) as output:
        while not output.is_connected:
            await asyncio.sleep(0.05)
        running = command(*words, *addresses(cluster))
        await running.until_it_says("lab")


@pytest.mark.parametrize("address", ["broker2", "broker2:0", "broker2:70000", ":1883", "mqtt://broker2:1883"])
def test_an_address_that_is_none_is_told_with_its_option(command: Any, address: str) -> None:
    running = command("fleet", "list", "--failover", address)
    assert running.wait() == 2
    assert f"--failover {address!r}: HOST:PORT is wanted, such as broker2:1883" in running.errors
