"""Faults of the gateway's own process: stopped as by a suspended host, and a configuration that is broken.

The gateway runs as its users run it, ``mocap-gateway run``; poses and health are read from the broker.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiomqtt
import yaml

from benchmarks.fault_bench import METHOD, WHOLE_LIMIT_S, WHOLE_POSES, Broker, Outcome
from devices.emulators import IDEAL, EmulatedSuit, SuitSettings, SuitTraffic
from devices.emulators.transports import PtyTransport
from gateway.emulation.simulation import suit_17

START_S = 60.0
STOPPED_S = 3.0
LONGEST_WAIT_S = 15.0
_WHOLE = {"measured", "interpolated", "held"}


class GatewayProcess:
    """A running gateway, and what the broker has of it."""

    def __init__(self, process: asyncio.subprocess.Process, config: Path) -> None:
        self.process = process
        self.config = config
        self.whole_at: list[float] = []
        """Monotonic times at which whole poses came, s."""
        self.poses = 0
        self.health: dict[str, Any] = {}
        self.health_count = 0

    def take(self, topic: str, payload: bytes) -> None:
        """A message of the gateway."""
        if topic.endswith("/pose"):
            self.poses += 1
            if set(json.loads(payload)["status"].values()) <= _WHOLE:
                self.whole_at.append(time.monotonic())
        elif topic.endswith("/bridge/health"):
            self.health, self.health_count = json.loads(payload), self.health_count + 1

    async def whole_again_s(self) -> float:
        """Seconds until ``WHOLE_POSES`` whole poses have come; counts from the first of them."""
        since, begun = time.monotonic(), len(self.whole_at)
        while len(self.whole_at) < begun + WHOLE_POSES:
            if time.monotonic() - since > LONGEST_WAIT_S:
                return float("inf")
            await asyncio.sleep(0.005)
        return self.whole_at[begun] - since

    async def outcome(self, name: str, recovery_s: float) -> Outcome:
        """With what the next health message says."""
        count, deadline = self.health_count, time.monotonic() + LONGEST_WAIT_S
        while self.health_count == count and time.monotonic() < deadline:
            await asyncio.sleep(0.02)
        accounting = self.health.get("accounting", {})
        parts = {**accounting["samples_sent"]["parts"], **accounting["readings"]["parts"]}
        lost = {part: n for part, n in parts.items() if n and part not in ("received", "taken")}
        left_over = sum(abs(balance["unaccounted"]) for balance in accounting.values())
        return Outcome(name, recovery_s, WHOLE_LIMIT_S, lost, left_over)


@contextlib.asynccontextmanager
async def _running() -> AsyncIterator[GatewayProcess]:
    _, motion = suit_17()
    traffic = SuitTraffic(motion, SuitSettings(has_relay=True), IDEAL, seed=1)
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        port, config = Path(folder) / "suit", Path(folder) / "gateway.yaml"
        settings = {
            "links": [{"name": "suit", "url": str(port)}],
            "rig": "suit_17",
            "reconstructor": METHOD,
            "mqtt": {"port": broker.port, "health_interval": 1},
        }
        config.write_text(yaml.safe_dump(settings))
        suit = asyncio.create_task(EmulatedSuit(traffic, PtyTransport(port)).run())
        command = [sys.executable, "-m", "gateway", "run", "-c", str(config)]
        process = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.DEVNULL)
        gateway = GatewayProcess(process, config)
        listening = asyncio.create_task(_listen(broker.port, gateway))
        try:
            async with asyncio.timeout(START_S):
                while len(gateway.whole_at) < 200:
                    await asyncio.sleep(0.05)
            yield gateway
        finally:
            for task in (listening, suit):
                task.cancel()
            await asyncio.gather(listening, suit, return_exceptions=True)
            process.kill()
            await process.wait()


async def _listen(port: int, gateway: GatewayProcess) -> None:
    async with aiomqtt.Client("127.0.0.1", port) as client:
        for topic in ("mocap/gateway1/pose", "mocap/gateway1/bridge/health"):
            await client.subscribe(topic)
        async for message in client.messages:
            if isinstance(message.payload, bytes):
                gateway.take(str(message.topic), message.payload)


async def host_suspended() -> Outcome:
    """The process stands still for three seconds while the suit sends."""
    async with _running() as gateway:
        gateway.process.send_signal(signal.SIGSTOP)
        await asyncio.sleep(STOPPED_S)
        gateway.process.send_signal(signal.SIGCONT)
        recovery_s = await gateway.whole_again_s()
        return await gateway.outcome(f"gateway's process stopped for {STOPPED_S:g} s", recovery_s)


async def broken_reload() -> Outcome:
    """The configuration is read anew while it is broken: the old one stays, and no pose is missing."""
    async with _running() as gateway:
        good = gateway.config.read_text()
        gateway.config.write_text(good.replace("suit_17", "suit_71"))
        gateway.process.send_signal(signal.SIGHUP)
        poses = gateway.poses
        await asyncio.sleep(2.0)
        is_alive = gateway.process.returncode is None and gateway.poses > poses
        recovery_s = await gateway.whole_again_s() if is_alive else float("inf")
        gateway.config.write_text(good)
        return await gateway.outcome("configuration broken at reload", recovery_s)


PROCESS_FAULTS = (host_suspended, broken_reload)
"""All of them, in the order of the table."""
