"""Highest load that the running service holds in real time, one core to itself, and what gives way first.

``mocap-gateway run`` as users run it, recording and publishing every pose, on the last core; the suit (bytes
made beforehand), the broker and this measurement on the others. A load is held when for ``SECONDS`` nothing
is lost, dropped or given up, in one of ``TRIES``: others on the machine hold anything up now and then. Give
it priority there: ``sudo chrt -r 1 …``.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import tempfile
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import aiomqtt
import psutil
import yaml

from benchmarks.figures import Figure, Report, table
from benchmarks.latency import cores_apart, line_of, process_of, write_config
from devices.emulators.local_broker import mosquitto
from gateway.service import readiness

METHODS = ("independent", "joint")
MODULES = (17, 63)
RATES_HZ = (100, 200, 300, 400, 500, 600, 800, 1000, 1250, 1500, 2000)
WANTED = {("joint", 17): ">=1000", ("joint", 63): ">=500"}
"""Rates, Hz."""
SECONDS = 10.0
TRIES = 3
SETTLING_S = 2.0
"""Clocks and filters begin, pages are touched for the first time."""
START_S = 120.0
HEALTH_INTERVAL_S = 0.5
ALL = 0.98
"""Of the rate, poses that must come: the suit's program may be too slow, too."""
_WELL = {
    "samples_sent": {"received"},
    "packets_decoded": {"received"},
    "readings": {"taken"},
    "instants": {"frames"},
    "frames": {"reconstructed"},
    "output_mqtt": {"published", "queued"},
    "recorded_chunks": {"written", "waiting"},
}
"""Parts of the balances that are no drop; ``link_…_bytes`` has ``handed`` and ``waiting``."""


@dataclass(frozen=True)
class Outcome:
    """What became of one load."""

    poses_hz: float
    cpu_percent: float
    """Of the core."""
    worst_lag_ms: float
    gave_way: tuple[str, ...]
    """What was lost, dropped or given up, in order; nothing: held."""


class HealthWatch:
    """Health messages of one gateway, as they come."""

    def __init__(self) -> None:
        self.newest: dict[str, Any] = {}
        self.gave_way: dict[str, None] = {}
        self._before: dict[str, int] = {}
        self.is_judging = False

    def take(self, health: dict[str, Any]) -> None:
        """Notes what has been lost, dropped or given up since the message before."""
        self.newest = health
        drops = _drops(health)
        if self.is_judging:
            self.gave_way |= dict.fromkeys(name for name, n in drops.items() if n > self._before.get(name, 0))
        self._before = drops


def _frames(health: dict[str, Any]) -> int:
    """Poses so far."""
    return int(health["accounting"]["frames"]["total"])


def _drops(health: dict[str, Any]) -> dict[str, int]:
    """What has been given up (0 or 1), and what was dropped, by name."""
    drops = {f"gives up {name}": 1 for name in health["statistics"]["load"]["shed"]}
    for name, balance in health["accounting"].items():
        well = _WELL.get(name, {"handed", "waiting"})
        drops |= {f"{name}: {part}": n for part, n in balance["parts"].items() if part not in well}
    return drops


def run() -> Report:
    """Rates upwards for every number of modules and either method, until one is not held."""
    report, rows = Report("held"), []
    with mosquitto() as (broker_port, broker), cores_apart(broker.pid) as core:
        for method in METHODS:
            subprocess.run(readiness.command(method), check=True)  # else another one would run meanwhile
            for n in MODULES:
                held, first = 0, ""
                for rate_hz in RATES_HZ:
                    for _ in range(TRIES):
                        found = asyncio.run(outcome(method, n, rate_hz, broker_port, core))
                        print(" | ".join(_row(method, n, rate_hz, found)), flush=True)
                        if not found.gave_way:
                            break
                    rows.append(_row(method, n, rate_hz, found))
                    if found.gave_way:
                        first = found.gave_way[0]
                        break
                    held = rate_hz
                note = (
                    f"{method}, {n} modules, one core; beyond it first: {first or 'nothing that was tried'}"
                )
                wanted = WANTED.get((method, n), "")
                report.figures.append(Figure(f"held_live_{method}_{n}_hz", held, "Hz", wanted, note))
    heads = ["method", "modules", "rate, Hz", "samples/s", "poses/s", "core, %", "worst lag, ms", "gave way"]
    report.tables = [
        f"## Every load\n\nEach for {SECONDS:g} s; the best of up to {TRIES} tries.\n\n{table(heads, rows)}"
    ]
    return report


async def outcome(method: str, n: int, rate_hz: float, broker_port: int, core: int) -> Outcome:
    """One load, for ``SECONDS``."""
    with tempfile.TemporaryDirectory() as folder:
        port = Path(folder) / "suit"
        config = _config(Path(folder), port, broker_port, method, n, rate_hz)
        seconds = SECONDS + SETTLING_S + 1.0
        writer = ("-m", "devices.emulators.paced_writer", str(port), str(n), str(rate_hz), str(seconds))
        async with process_of(*writer) as suit, _listening(broker_port) as watch:
            await line_of(suit)
            async with process_of("-m", "gateway", "run", "-c", str(config)) as gateway:
                os.sched_setaffinity(gateway.pid, {core})
                async with asyncio.timeout(START_S):
                    while not watch.newest:
                        await asyncio.sleep(0.05)
                assert suit.stdin is not None
                suit.stdin.write(b"\n")
                await asyncio.sleep(SETTLING_S)
                return await _judged(watch, psutil.Process(gateway.pid), rate_hz)


async def _judged(watch: HealthWatch, process: psutil.Process, rate_hz: float) -> Outcome:
    """What ``SECONDS`` from now show."""
    begun, begun_s, watch.is_judging = watch.newest, _cpu_s(process), True
    await asyncio.sleep(SECONDS)
    load = watch.newest["statistics"]["load"]
    between_s = (watch.newest["t_ns"] - begun["t_ns"]) * 1e-9
    poses_hz = (_frames(watch.newest) - _frames(begun)) / between_s
    if poses_hz < ALL * rate_hz:
        watch.gave_way["fewer poses than asked for"] = None  # whoever is too slow: nothing is shown then
    return Outcome(
        poses_hz,
        100.0 * (_cpu_s(process) - begun_s) / SECONDS,
        load["worst_lag_ms"],
        tuple(watch.gave_way),
    )


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def _config(folder: Path, port: Path, broker_port: int, method: str, n: int, rate_hz: float) -> Path:
    config = write_config(folder, port, broker_port, n)
    settings = yaml.safe_load(config.read_text())
    settings["mqtt"]["health_interval"] = HEALTH_INTERVAL_S
    settings["assembly"] = {"rate_hz": rate_hz}
    settings["reconstructor"] = method
    settings["recording"] = {"folder": str(folder / "recordings"), "at_start": True, "min_free_mb": 100}
    config.write_text(yaml.safe_dump(settings))
    return config


@contextlib.asynccontextmanager
async def _listening(broker_port: int) -> AsyncIterator[HealthWatch]:
    watch = HealthWatch()

    async def listen(client: aiomqtt.Client) -> None:
        async for message in client.messages:
            if isinstance(message.payload, bytes):
                watch.take(json.loads(message.payload))

    async with aiomqtt.Client("127.0.0.1", broker_port) as client:
        await client.subscribe("mocap/bench/bridge/health")
        listening = asyncio.create_task(listen(client))
        try:
            yield watch
        finally:
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)


def _row(method: str, n: int, rate_hz: float, found: Outcome) -> list[str]:
    figures = (f"{found.poses_hz:.0f}", f"{found.cpu_percent:.0f}", f"{found.worst_lag_ms:.0f}")
    return [method, f"{n}", f"{rate_hz:g}", f"{n * rate_hz:.0f}", *figures, ", ".join(found.gave_way) or "–"]
