"""A whole gateway in the test's event loop, on a real broker, and an app that listens to it."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from devices.links.reconnect import LinkState, ReconnectingLink
from gateway.body.rig import load_rig
from gateway.outputs import connection, mqtt
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber, ReceivedPose
from gateway.service.service import Service
from gateway.settings import (
    AssemblySettings,
    ClockSettings,
    GatewaySettings,
    LinkSettings,
)
from tests.patience import PATIENCE_S
from tests.running_suit import running


@pytest.fixture(autouse=True)
def _brokers_are_given_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A broker of a busy machine, and the messages at its end, may be late; by so much that nothing that
    waits for a broker that never answers would pass for quick."""
    monkeypatch.setattr(connection, "TIMEOUT_S", PATIENCE_S)
    monkeypatch.setattr(mqtt, "_DRAIN_S", PATIENCE_S)
    monkeypatch.setattr(mqtt, "_FAREWELL_S", PATIENCE_S)


@pytest.fixture
def attempts(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Grows by the instant of every attempt of an MQTT output to reach its broker, s."""
    made: list[float] = []
    connect = mqtt.broker_connection

    def noted(*arguments: Any, **options: Any) -> Any:
        made.append(time.monotonic())
        return connect(*arguments, **options)

    monkeypatch.setattr(mqtt, "broker_connection", noted)
    return made


@dataclass
class RunningGateway:
    """A service and all poses that an app has received from it."""

    service: Service
    received: list[ReceivedPose] = field(default_factory=list)

    async def until_link_is_up(self) -> None:
        """Until the gateway has opened its only link."""
        (link,) = self.service.links
        assert isinstance(link, ReconnectingLink)
        async with asyncio.timeout(PATIENCE_S):
            while link.state is not LinkState.UP:
                await asyncio.sleep(0.01)

    async def until_quiet(self, sent_bytes: int = 0) -> None:
        """Until the gateway has read so many bytes, and the app has all poses of what was read."""
        (link,) = self.service.links
        assert isinstance(link, ReconnectingLink)
        before: tuple[object, ...] = ()
        since = time.monotonic()
        while time.monotonic() - since < PATIENCE_S:
            published = self.service.mqtt.counters.published
            frames = self.service.pipeline.skeleton_frames
            now = (link.counts.taken, link.counts.waiting, frames, published, len(self.received))
            has_all = now[0] >= sent_bytes and now[1] == 0 and len(self.received) == published > 0
            if has_all and now == before:
                return
            before = now
            await asyncio.sleep(_QUIET_S)
        pytest.fail(f"{sent_bytes} bytes sent; taken, waiting, frames, published, received: {before}")


_QUIET_S = 0.3
"""For what lies on a bus, or in a thread, where it cannot be counted."""


@pytest.fixture
def gateway_on(mosquitto: Any) -> Callable[..., Any]:
    """``async with gateway_on(url, rig, reconstructor, rate_hz) as running``: lossless settings."""

    @contextlib.asynccontextmanager
    async def start(
        url: str, rig: str, reconstructor: str = "independent", rate_hz: float = 100.0
    ) -> AsyncIterator[RunningGateway]:
        settings = GatewaySettings(
            gateway="lab",
            links=[LinkSettings(name="suit", url=url)],
            rig=rig,
            reconstructor=reconstructor,
            clock=ClockSettings(mode="shared"),
            assembly=AssemblySettings(rate_hz=rate_hz, max_wait_ms=10_000, hold_ms=60_000),
            mqtt=MqttSettings(port=mosquitto.port, queue_length=10_000, decimals=None),
        )
        gateway = RunningGateway(Service(settings, load_rig(rig)))
        gateway.service.load.observe = lambda *_: False  # nothing is given up on a machine that is too busy
        async with running(gateway.service) as serving, PoseSubscriber(settings.mqtt, "lab") as poses:
            collecting = asyncio.create_task(_collect(poses, gateway.received))
            while not gateway.service.mqtt.is_connected and not serving.done():
                await asyncio.sleep(0.01)
            yield gateway
            collecting.cancel()

    return start


async def _collect(poses: PoseSubscriber, received: list[ReceivedPose]) -> None:
    async for pose in poses:
        received.append(pose)  # noqa: PERF401 - an endless stream: what has come must show at once


@pytest.fixture
def announced_death(until: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
    """``await announced_death(program, settings)``: a killed ``victim`` goes offline for those who listen and
    for those who come later. The program, in Python, is given the broker's port."""

    async def check(program: str, settings: MqttSettings) -> None:
        async with PoseSubscriber(settings) as watcher:
            victim = await asyncio.create_subprocess_exec(sys.executable, "-c", program, str(settings.port))
            try:
                await until(lambda: watcher.states.get("victim") == "online")
            finally:
                victim.kill()
                await victim.wait()
            await until(lambda: watcher.states["victim"] == "offline")
        async with PoseSubscriber(settings) as late_comer:
            await until(lambda: late_comer.states == {"victim": "offline"})

    return check
