"""From the last byte of a tick to the app: a real pseudo-terminal, a real broker, separate processes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import tempfile
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import yaml

from benchmarks.figures import Figure, Report, table
from devices.emulators.local_broker import mosquitto
from gateway.frames import FloatArray
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber

SECONDS = 12.0
SETTLING_TICKS = 100
LOADS = ((17, 100.0), (64, 100.0), (17, 500.0), (17, 1000.0), (34, 1000.0), (51, 1000.0), (64, 1000.0))
"""Modules and sampling rates tried for the highest load; poses at 100 Hz."""
HELD_LATENCY_MS = 100.0


@dataclass(frozen=True)
class Run:
    """One load on a gateway process."""

    n_modules: int
    rate_hz: float
    latency_ms: FloatArray  # by pose
    lost_poses: int
    cpu_percent: float
    poses_per_s: float
    """As they reach the subscriber."""

    @property
    def is_held(self) -> bool:
        """Whether the gateway kept up: every pose came, and none piled up."""
        return self.lost_poses == 0 and float(np.percentile(self.latency_ms, 99)) < HELD_LATENCY_MS


def run() -> Report:
    """17 modules at 100 Hz, then more until the gateway no longer keeps up."""
    with mosquitto() as (port, _):
        runs = []
        for n_modules, rate_hz in LOADS:
            runs.append(asyncio.run(_measure(port, n_modules, rate_hz)))
            if not runs[-1].is_held:
                break
    base = runs[0]
    held = [r for r in runs if r.is_held]
    best = max((r.n_modules * r.rate_hz for r in held), default=0.0)
    p50, p99 = (float(np.percentile(base.latency_ms, q)) for q in (50, 99))
    report = Report("latency")
    report.figures = [
        Figure(
            "pty_to_mqtt_p50_ms", p50, "ms", "", "last byte written to the port → subscriber, 17 × 100 Hz"
        ),
        Figure("pty_to_mqtt_p99_ms", p99, "ms", "", "the same, 99th percentile"),
        *(figure for r in runs if r.rate_hz == 100.0 for figure in _load_figures(r)),
        Figure(
            "max_samples_per_s_one_core", best, "1/s", "", "modules × rate held without loss, poses at 100 Hz"
        ),
    ]
    report.tables = [_table(runs)]
    return report


def _load_figures(run: Run) -> list[Figure]:
    load = f"{run.n_modules} × {run.rate_hz:g} Hz"
    name = f"{run.n_modules}x{run.rate_hz:g}"
    return [
        Figure(f"cpu_percent_{name}", run.cpu_percent, "%", "", f"of one core, gateway process, {load}"),
        Figure(f"messages_per_s_{name}", run.poses_per_s, "1/s", "", f"poses at the subscriber, {load}"),
    ]


def _table(runs: list[Run]) -> str:
    rows = [
        [
            *(str(r.n_modules), f"{r.rate_hz:g}", f"{r.cpu_percent:.0f}", f"{r.poses_per_s:.0f}"),
            *(f"{np.percentile(r.latency_ms, q):.2f}" for q in (50, 99, 100)),
            *(str(r.lost_poses), "yes" if r.is_held else "no"),
        ]
        for r in runs
    ]
    heads = ["modules", "Hz", "CPU %", "messages/s", "p50 ms", "p99 ms", "max ms", "poses lost", "held"]
    return "### Load on one gateway process (reconstructor `independent`)\n\n" + table(heads, rows)


async def _measure(broker_port: int, n_modules: int, rate_hz: float) -> Run:
    with tempfile.TemporaryDirectory() as folder:
        port = Path(folder) / "suit"
        config = write_config(Path(folder), port, broker_port, n_modules)
        async with process_of(
            "-m", "devices.emulators.paced_writer", str(port), str(n_modules), str(rate_hz), str(SECONDS)
        ) as suit:
            await line_of(suit)
            async with process_of("-m", "gateway", "run", "-c", str(config)) as gateway:
                return await _listen(suit, gateway, broker_port, n_modules, rate_hz)


async def _listen(
    suit: asyncio.subprocess.Process,
    gateway: asyncio.subprocess.Process,
    broker_port: int,
    n_modules: int,
    rate_hz: float,
) -> Run:
    received: list[tuple[int, int]] = []
    async with PoseSubscriber(MqttSettings(port=broker_port), "bench") as poses:
        await await_online(poses)
        process = begin(suit, gateway)

        async def collect() -> None:
            async for pose in poses:
                received.append((pose.pose.t_ns, pose.received_ns))

        collecting = asyncio.create_task(collect())
        await asyncio.sleep(1.0)
        before = sum(process.cpu_times()[:2])
        await asyncio.sleep(SECONDS - 2.0)
        cpu_percent = (sum(process.cpu_times()[:2]) - before) / (SECONDS - 2.0) * 100
        written_ns = np.array((await line_of(suit))["written_ns"])
        await asyncio.sleep(1.0)
        collecting.cancel()
    return _evaluate(np.array(received), written_ns, n_modules, rate_hz, cpu_percent)


async def await_online(poses: PoseSubscriber) -> None:
    """Until the gateway ``bench`` has been online for a second."""
    async with asyncio.timeout(60):
        while poses.states.get("bench") != "online":
            await asyncio.sleep(0.05)
    await asyncio.sleep(1.0)


def begin(suit: asyncio.subprocess.Process, gateway: asyncio.subprocess.Process) -> psutil.Process:
    """Lets a paced writer begin; returns the gateway's process, to be measured."""
    assert suit.stdin is not None
    suit.stdin.write(b"go\n")
    return psutil.Process(gateway.pid)


def _evaluate(
    received: FloatArray, written_ns: FloatArray, n_modules: int, rate_hz: float, cpu_percent: float
) -> Run:
    """Poses belong to ticks by their instants: both count from the first."""
    every = round(rate_hz / 100.0)
    ticks = np.round((received[:, 0] - received[0, 0]) * 1e-9 * rate_hz).astype(int)
    latency_ms = (received[:, 1] - written_ns[ticks]) * 1e-6
    expected = len(written_ns[::every])
    span_s = (received[-1, 1] - received[0, 1]) * 1e-9
    return Run(
        n_modules,
        rate_hz,
        latency_ms[SETTLING_TICKS:],
        expected - len(received),
        cpu_percent,
        (len(received) - 1) / span_s,
    )


def write_config(folder: Path, port: Path, broker_port: int, n_modules: int) -> Path:
    """A configuration, and a rig of as many modules as the load has, on a body with as many segments."""
    segments = [
        {"name": f"segment_{i}", "parent": f"segment_{i - 1}" if i else None, "tip": [0.1, 0, 0]}
        for i in range(n_modules)
    ]
    modules = [{"id": i, "segment": f"segment_{i}"} for i in range(n_modules)]
    (folder / "body.yaml").write_text(yaml.safe_dump({"name": "load", "segments": segments}))
    (folder / "rig.yaml").write_text(yaml.safe_dump({"body": "body.yaml", "modules": modules}))
    settings = {
        "gateway": "bench",
        "links": [{"name": "suit", "url": str(port)}],
        "rig": "rig.yaml",
        "clock": {"mode": "shared"},
        "mqtt": {"port": broker_port, "queue_length": 64},
        "log": {"level": "warning"},
    }
    config = folder / "gateway.yaml"
    config.write_text(yaml.safe_dump(settings))
    return config


@contextlib.asynccontextmanager
async def process_of(*arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """A Python process that is ended with the block."""
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        sys.executable, *arguments, stdin=pipe, stdout=pipe, limit=2**24
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


async def line_of(process: asyncio.subprocess.Process) -> dict[str, list[int]]:
    """The next line that it prints, JSON."""
    assert process.stdout is not None
    return json.loads(await process.stdout.readline())  # type: ignore[no-any-return]
