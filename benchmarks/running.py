"""What ``mocap-gateway run`` does as a process: the first pose, a stop of a minute, a flood of datagrams.

Gateway, suit, broker and whoever floods are processes of their own, as with their users; poses and health are
read from the broker. How busy the machine was besides is part of the report.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
import socket
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiomqtt
import orjson
import yaml

from benchmarks.fault_bench import Broker
from benchmarks.figures import Figure, Report, table
from devices.free_ports import free_port

RATE_HZ = 100.0
STOPPED_S = 60.0
WATCHED_S = 12.0
STEADY_S = 5.0
FLOODED_S = 15.0
FLOOD_HZ = 20_000
CALM_AFTER_S = 45.0
"""Watched after a flood: stages come back one by one."""
START_S = 600.0
BACK_LIMIT_S = 1.0
STOPPED_ON = ("pty", "tcp", "udp")
METHOD = "joint"
_UP = 0.95
"""Of the rate: as many poses in a second are all of them."""


@dataclass
class Observed:
    """What the broker has of a gateway."""

    poses: list[tuple[float, float]] = field(default_factory=list)
    """When it came, monotonic, and how old it was then, s."""
    health: list[tuple[float, dict[str, Any]]] = field(default_factory=list)
    methods: list[tuple[float, str]] = field(default_factory=list)
    """From when on the poses are made by which method."""

    def between(self, begin_s: float, end_s: float) -> list[tuple[float, float]]:
        """The poses that came in that time."""
        return [each for each in self.poses if begin_s <= each[0] < end_s]

    def stages(self, begin_s: float) -> list[int]:
        """Load stages told since then."""
        return [health["statistics"]["load"]["stage"] for at, health in self.health if at >= begin_s]

    def is_steady(self) -> bool:
        """Whether poses of the method have come at their rate for some seconds."""
        now_s = time.monotonic()
        if not self.methods or self.methods[-1][1] != METHOD or now_s - self.methods[-1][0] < STEADY_S:
            return False
        return len(self.between(now_s - STEADY_S, now_s)) >= _UP * RATE_HZ * STEADY_S


@dataclass
class Running:
    """A gateway, its suit and what is heard of it."""

    gateway: asyncio.subprocess.Process
    begun_s: float
    observed: Observed
    port: int
    """Of the link, where it has one."""
    broker_port: int

    async def steady(self) -> None:
        """Raises ``TimeoutError`` where poses do not come at their rate at last."""
        async with asyncio.timeout(START_S):
            while not self.observed.is_steady():
                await asyncio.sleep(0.1)


@contextlib.asynccontextmanager
async def running(
    medium: str, environment: Mapping[str, str] | None = None, tree: Path | None = None
) -> AsyncIterator[Running]:
    """``run`` and ``emulate`` on a medium: pty, tcp or udp. environment: of ``run``, tree: where that is."""
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        config, pty, port = Path(folder) / "gateway.yaml", Path(folder) / "suit", free_port()
        url = str(pty) if medium == "pty" else f"{medium}://127.0.0.1:{port}"
        config.write_text(
            yaml.safe_dump(
                {
                    "links": [{"name": "suit", "url": url}],
                    "rig": "suit_17",
                    "reconstructor": METHOD,
                    "mqtt": {"port": broker.port, "health_interval": 1},
                }
            )
        )
        place = ["--link", str(pty)] if medium == "pty" else ["--port", str(port)]
        suit = await _process("emulate", "--rig", "suit_17", "--on", medium, *place)
        observed = Observed()
        listening = asyncio.create_task(_listen(broker.port, observed))
        begun_s = time.monotonic()
        gateway = await _process("run", "-c", str(config), environment=environment, tree=tree)
        try:
            yield Running(gateway, begun_s, observed, port, broker.port)
        finally:
            listening.cancel()
            for process in (gateway, suit):
                if process.returncode is None:
                    process.kill()
                await process.wait()
            await asyncio.gather(listening, return_exceptions=True)


async def _process(
    *arguments: str, environment: Mapping[str, str] | None = None, tree: Path | None = None
) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "gateway", *arguments,
        env=os.environ | (environment or {}), cwd=tree,
        stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip


async def _listen(port: int, observed: Observed) -> None:
    async with aiomqtt.Client("127.0.0.1", port) as client:
        for name in ("pose", "bridge/health", "bridge/info"):
            await client.subscribe(f"mocap/gateway1/{name}")
        async for message in client.messages:
            now_s, content = time.monotonic(), orjson.loads(message.payload)  # type: ignore[arg-type]
            match str(message.topic).rpartition("/")[2]:
                case "pose":
                    observed.poses.append((now_s, (time.time_ns() - content["t_ns"]) * 1e-9))
                case "health":
                    observed.health.append((now_s, content))
                case "info":
                    observed.methods.append((now_s, content["reconstructor"]))


def run() -> Report:
    """All three."""
    report = Report("running")
    load = os.getloadavg()[0]
    asyncio.run(_first_poses(report))
    rows = [asyncio.run(_stopped(report, medium)) for medium in STOPPED_ON]
    heads = [
        "link",
        "first pose after, s",
        f"{RATE_HZ:g}/s from, s",
        "poses in each second after",
        "load stages",
    ]
    text = f"## Stopped for {STOPPED_S:g} s by a signal; `{METHOD}`, 17 modules, {RATE_HZ:g} Hz"
    report.tables.append(f"{text}\n\n{table(heads, rows)}")
    asyncio.run(_flooded(report))
    loads = f"{load:.1f} before, {os.getloadavg()[0]:.1f} after"
    report.tables.insert(0, f"Load average of the machine: {loads}, on {os.cpu_count()} cores.")
    return report


async def _first_poses(report: Report) -> None:
    """From ``run`` to poses, with no kernel compiled yet, and again with all of them."""
    with tempfile.TemporaryDirectory() as cache:
        for name in ("cold", "warm"):
            async with running("pty", {"NUMBA_CACHE_DIR": cache}) as it:
                observed = it.observed
                async with asyncio.timeout(START_S):
                    while not observed.poses or all(method != METHOD for _, method in observed.methods):
                        await asyncio.sleep(0.1)
                first_s = observed.poses[0][0] - it.begun_s
                method_s = next(at for at, method in observed.methods if method == METHOD) - it.begun_s
            load = os.getloadavg()[0]
            what = f"from `run` to the first pose, {name} cache of kernels; load average {load:.1f}"
            report.figures.append(Figure(f"running_first_pose_{name}_s", first_s, "s", "", what))
            what = f"the same to poses by `{METHOD}`"
            report.figures.append(Figure(f"running_method_{name}_s", method_s, "s", "", what))


async def _stopped(report: Report, medium: str) -> list[str]:
    """The process stands still for a minute while the suit sends."""
    async with running(medium) as it:
        await it.steady()
        it.gateway.send_signal(signal.SIGSTOP)
        await asyncio.sleep(STOPPED_S)
        it.gateway.send_signal(signal.SIGCONT)
        since_s = time.monotonic()
        await asyncio.sleep(WATCHED_S)
        observed = it.observed
    first_s = next(at for at, _ in observed.poses if at >= since_s) - since_s
    back_s = full_rate_s(observed, since_s)
    report.figures.append(
        Figure(
            f"running_back_{medium}_s", back_s, "s", f"<={BACK_LIMIT_S:g}",
            f"stopped for {STOPPED_S:g} s, link {medium}: from catching up to the first second at full rate",
        )
    )  # fmt: skip
    counts = [len(observed.between(since_s + k, since_s + k + 1)) for k in range(int(WATCHED_S))]
    stages = ", ".join(map(str, dict.fromkeys(observed.stages(since_s))))
    return [medium, f"{first_s:.2f}", f"{back_s:.2f}", " ".join(map(str, counts)), stages]


def full_rate_s(observed: Observed, since_s: float) -> float:
    """Seconds from when what had waited was worked off, a pose is no older than a quarter of a second, until
    the beginning of the first second in which all poses come; infinite: never."""
    caught_up_s = next((at for at, age_s in observed.poses if at >= since_s and age_s < 0.25), float("inf"))
    at_s, end_s = caught_up_s, observed.poses[-1][0]
    while at_s + 1.0 < end_s:
        if len(observed.between(at_s, at_s + 1.0)) >= _UP * RATE_HZ:
            return at_s - caught_up_s
        at_s += 0.05
    return float("inf")


def flood(port: int, seconds: float, rate_hz: float) -> int:
    """Send datagrams that are no wire frames at a rate, as far as the machine lets; how many were sent."""
    sent, begun_s = 0, time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        while (now_s := time.monotonic() - begun_s) < seconds:
            while sent < now_s * rate_hz:
                stranger.sendto(b"\x07" * 40, ("127.0.0.1", port))
                sent += 1
            time.sleep(0.001)
    return sent


async def _flooded(report: Report) -> None:
    """A stranger sends datagrams to the suit's port."""
    async with running("udp") as it:
        await it.steady()
        before_s = time.monotonic()
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            sending = pool.apply_async(flood, (it.port, FLOODED_S, FLOOD_HZ))
            sent = await asyncio.to_thread(sending.get)
        end_s = time.monotonic()
        await asyncio.sleep(CALM_AFTER_S)
        observed = it.observed
    begin_s = end_s - FLOODED_S
    calm, flooded = observed.between(before_s - STEADY_S, before_s), observed.between(begin_s, end_s)
    ages_ms = sorted(1e3 * age_s for _, age_s in flooded) or [float("inf")]
    load = [health["statistics"]["load"] for at, health in observed.health if begin_s <= at < end_s + 1.0]
    before = f"poses meanwhile; before: {len(calm) / STEADY_S:.0f}"
    figures = [
        ("running_flood_sent_hz", sent / FLOODED_S, "1/s", "datagrams of 40 bytes, no wire frames"),
        ("running_flood_poses_hz", len(flooded) / FLOODED_S, "1/s", before),
        ("running_flood_age_ms", ages_ms[len(ages_ms) // 2], "ms", "age of a pose when it came, median"),
        ("running_flood_age_p99_ms", ages_ms[int(0.99 * len(ages_ms))], "ms", "the same, 99 of 100"),
        ("running_flood_stage", max((each["stage"] for each in load), default=0), "-", "highest load stage"),
        ("running_flood_lag_ms", max((each["lag_ms"] for each in load), default=0), "ms", "greatest told"),
        ("running_flood_back_s", full_rate_s(observed, end_s), "s", "from its end to full rate"),
    ]  # fmt: skip
    report.figures += [Figure(name, float(value), unit, "", what) for name, value, unit, what in figures]
    seconds = range(int(FLOODED_S + CALM_AFTER_S))
    counts = [str(len(observed.between(begin_s + k, begin_s + k + 1))) for k in seconds]
    stages = [str(stage) for stage in observed.stages(begin_s)]
    text = f"## Flooded with {FLOOD_HZ} datagrams a second for {FLOODED_S:g} s, then let alone; `{METHOD}`"
    rows = [["poses", " ".join(counts)], ["load stage", " ".join(stages)]]
    report.tables.append(f"{text}\n\n{table(['in each second', 'from its beginning on'], rows)}")
