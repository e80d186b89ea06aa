"""From the last byte of a tick to the app: a real pseudo-terminal, a real broker, separate processes.

The gateway has the last core to itself, as far as others on the machine let it; the suit, the broker and this
measurement have the others.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import yaml

from benchmarks.figures import Figure, Report, table
from devices.emulators.local_broker import mosquitto
from gateway.frames import FloatArray
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber, ReceivedPose
from gateway.service import readiness

METHOD = "joint"
SECONDS = 12.0
FLOOR_SECONDS = 22.0
FLOOR_RUNS = 2
"""Of the gateway and of the floor each, in turn; the least of each counts."""
SETTLING_TICKS = 100
LOADS = ((17, 100.0), (64, 100.0), (17, 500.0), (17, 1000.0), (34, 1000.0), (51, 1000.0), (64, 1000.0))
"""Modules and sampling rates tried for the highest load; poses at 100 Hz."""
RUNS_IN_A_ROW = 2
"""Of each load, all of which it must hold."""
HELD_LATENCY_MS = 10.0
"""99 of 100 poses come within it, where a load is held."""


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
    wakeups_per_s: float
    """How often a thread of the process went to sleep and was woken."""
    turns_per_s: float
    """Of the event loop."""
    rss_mb: float
    """Memory of the process at the end."""
    last_pose: bytes

    @property
    def is_held(self) -> bool:
        """Whether the gateway kept up: every pose came, and none piled up."""
        return self.lost_poses == 0 and self.percentile_ms(99) < HELD_LATENCY_MS

    def percentile_ms(self, q: float) -> float:
        """Latency that ``q`` % of the poses are below, ms."""
        return float(np.percentile(self.latency_ms, q))


@dataclass(frozen=True)
class Load:
    """What is measured: a suit, and the program at the other end of its port."""

    broker_port: int
    n_modules: int
    rate_hz: float
    seconds: float
    core: int
    """What the program runs on."""
    floor_pose: bytes | None = None
    """The floor program runs, and publishes poses like this one; None: the gateway."""


def run() -> Report:
    """17 modules at 100 Hz, then more until the gateway no longer keeps up; then beside the floor."""
    subprocess.run(readiness.command(METHOD), check=True)  # else another method would run meanwhile
    with mosquitto() as (port, broker), cores_apart(broker.pid) as core:
        runs, best = [], 0.0
        for n_modules, rate_hz in LOADS:
            load = Load(port, n_modules, rate_hz, SECONDS, core)
            runs += [asyncio.run(_measure(load)) for _ in range(RUNS_IN_A_ROW)]
            if not all(run.is_held for run in runs[-RUNS_IN_A_ROW:]):
                break
            best = max(best, n_modules * rate_hz)
        beside = _beside_floor(Load(port, 17, 100.0, FLOOR_SECONDS, core), runs[0].last_pose)
    report = Report("latency")
    report.figures = [
        Figure(
            "pty_to_mqtt_p50_ms",
            runs[0].percentile_ms(50),
            "ms",
            note="last byte written to the port → subscriber, 17 × 100 Hz",
        ),
        Figure("pty_to_mqtt_p99_ms", runs[0].percentile_ms(99), "ms", "", "the same, 99th percentile"),
        *(figure for r in runs[::RUNS_IN_A_ROW] if r.rate_hz == 100.0 for figure in _load_figures(r)),
        Figure(
            "max_samples_per_s_one_core",
            best,
            "1/s",
            ">=64000",
            f"modules × rate, poses at 100 Hz: none lost, 99 of 100 within {HELD_LATENCY_MS:g} ms, "
            f"{RUNS_IN_A_ROW} runs in a row",
        ),
        Figure("service_rss_mb", runs[0].rss_mb, "MB", "", "memory of the gateway, 17 × 100 Hz"),
        *_floor_figures(*beside),
    ]
    report.tables = [_table(runs), _floor_table(*beside)]
    return report


@contextlib.contextmanager
def cores_apart(broker_pid: int) -> Iterator[int]:
    """Give a core for the gateway; this process, what it starts and the broker keep to the others.

    Raises ``SystemExit`` on a machine with one core.
    """
    cores = os.sched_getaffinity(0)
    *others, last = sorted(cores)
    if not others:
        raise SystemExit("this suite needs two cores: the gateway has one to itself")
    for pid in (0, broker_pid):
        os.sched_setaffinity(pid, others)
    try:
        yield last
    finally:
        os.sched_setaffinity(0, cores)


def _beside_floor(load: Load, pose: bytes) -> tuple[list[Run], list[Run]]:
    """Runs of the gateway and of the floor, in turn."""
    gateways, floors = [], []
    for _ in range(FLOOR_RUNS):
        gateways.append(asyncio.run(_measure(load)))
        floors.append(asyncio.run(_measure(replace(load, floor_pose=pose))))
    return gateways, floors


def _floor_figures(gateways: list[Run], floors: list[Run]) -> list[Figure]:
    def least(of: Callable[[Run], float]) -> tuple[float, float]:
        return min(map(of, gateways)), min(map(of, floors))

    cpu, floor_cpu = least(lambda r: r.cpu_percent)
    p99, floor_p99 = least(lambda r: r.percentile_ms(99))
    _, floor_rss_mb = least(lambda r: r.rss_mb)
    wakeups, floor_wakeups = least(lambda r: r.wakeups_per_s)
    turns, floor_turns = least(lambda r: r.turns_per_s)
    return [
        Figure("cpu_ratio_floor_17x100", cpu / floor_cpu, "", "<=1.5", "processor time, gateway over floor"),
        Figure("cpu_percent_floor_17x100", floor_cpu, "%", "", "of one core, the floor's"),
        Figure("pty_to_mqtt_p99_ratio_floor", p99 / floor_p99, "", "<=2", "99th percentile over the floor's"),
        Figure("pty_to_mqtt_p99_floor_ms", floor_p99, "ms", "", "of the floor"),
        Figure("wakeups_per_s_17x100", wakeups, "1/s", "", "threads of the gateway that slept were woken"),
        Figure("wakeups_per_s_floor_17x100", floor_wakeups, "1/s", "", "the same, of the floor"),
        Figure("loop_turns_per_s_17x100", turns, "1/s", "", "turns of the gateway's event loop"),
        Figure("loop_turns_per_s_floor_17x100", floor_turns, "1/s", "", "the same, of the floor"),
        Figure("floor_rss_mb", floor_rss_mb, "MB", "", "memory of the floor"),
    ]


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
            *(f"{r.percentile_ms(q):.2f}" for q in (50, 99, 100)),
            *(f"{r.rss_mb:.0f}", str(r.lost_poses), "yes" if r.is_held else "no"),
        ]
        for r in runs
    ]
    heads = ["modules", "Hz", "CPU %", "messages/s", "p50 ms", "p99 ms", "max ms"]
    heads += ["memory MB", "poses lost", "held"]
    return f"## Load on one gateway process (reconstructor `{METHOD}`)\n\n" + table(heads, rows)


def _floor_table(gateways: list[Run], floors: list[Run]) -> str:
    pairs = zip(gateways, floors, strict=True)
    programs = [each for pair in pairs for each in zip(("gateway", "floor"), pair, strict=True)]
    rows = [
        [
            program,
            *(f"{r.cpu_percent:.1f}", *(f"{r.percentile_ms(q):.2f}" for q in (50, 99, 100))),
            *(f"{r.wakeups_per_s:.0f}", f"{r.turns_per_s:.0f}", str(r.lost_poses)),
        ]
        for program, r in programs
    ]
    heads = ["program", "CPU %", "p50 ms", "p99 ms", "max ms", "wake-ups/s", "loop turns/s", "poses lost"]
    return f"""## Beside the floor, 17 × 100 Hz, in turn

The floor (`benchmarks/floor_program.py`) reads the same port and publishes payloads of the same size on the
same topic through the same client library, as often; it decodes nothing.

{table(heads, rows)}"""


async def _measure(load: Load) -> Run:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        port = folder / "suit"
        writer = (str(port), str(load.n_modules), str(load.rate_hz), str(load.seconds))
        async with process_of("-m", "devices.emulators.paced_writer", *writer) as suit:
            await line_of(suit)
            program = _program(folder, port, load)
            async with process_of("-m", "benchmarks.counted_loop", *program) as measured:
                os.sched_setaffinity(measured.pid, {load.core})
                return await _listen(suit, measured, load)


def _program(folder: Path, port: Path, load: Load) -> tuple[str, ...]:
    """The module to be run, and its arguments."""
    if load.floor_pose is None:
        return ("gateway", "run", "-c", str(write_config(folder, port, load.broker_port, load.n_modules)))
    pose = folder / "pose.json"
    pose.write_bytes(load.floor_pose)
    return ("benchmarks.floor_program", str(port), str(load.broker_port), str(load.rate_hz), str(pose))


async def _listen(suit: asyncio.subprocess.Process, measured: asyncio.subprocess.Process, load: Load) -> Run:
    received: list[ReceivedPose] = []
    async with PoseSubscriber(MqttSettings(port=load.broker_port), "bench") as poses:
        await await_online(poses)
        process = begin(suit, measured)

        async def collect() -> None:
            async for pose in poses:
                received.append(pose)

        collecting = asyncio.create_task(collect())
        await asyncio.sleep(1.0)
        before = await _spent(process, measured)
        await asyncio.sleep(load.seconds - 2.0)
        spent = (await _spent(process, measured) - before) / (load.seconds - 2.0)
        rss_mb = process.memory_info().rss / 1e6
        written_ns = np.array((await line_of(suit))["written_ns"])
        await asyncio.sleep(1.0)
        collecting.cancel()
    return _evaluate(received, written_ns, load, spent, rss_mb)


async def _spent(process: psutil.Process, measured: asyncio.subprocess.Process) -> FloatArray:
    """Processor time in s, wake-ups, and turns of the event loop so far."""
    assert measured.stdin is not None
    cpu_s = sum(process.cpu_times()[:2])
    measured.stdin.write(b"\n")
    return np.array([cpu_s, _wakeups(process.pid), (await line_of(measured))["turns"]])


def _wakeups(pid: int) -> int:
    """How often threads of a process gave their processor up to wait, and so were woken."""
    heads = [task / "status" for task in Path(f"/proc/{pid}/task").iterdir()]
    words = [head.read_text().split() for head in heads]
    return sum(int(each[each.index("voluntary_ctxt_switches:") + 1]) for each in words)


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
    received: list[ReceivedPose], written_ns: FloatArray, load: Load, spent: FloatArray, rss_mb: float
) -> Run:
    """Poses belong to ticks by their instants: both count from the first. spent: a second."""
    every = round(load.rate_hz / 100.0)
    t_ns = np.array([each.pose.t_ns for each in received])
    received_ns = np.array([each.received_ns for each in received])
    ticks = np.round((t_ns - t_ns[0]) * 1e-9 * load.rate_hz).astype(int)
    latency_ms = (received_ns - written_ns[ticks]) * 1e-6
    cpu, wakeups, turns = spent.tolist()
    return Run(
        load.n_modules,
        load.rate_hz,
        latency_ms[SETTLING_TICKS:],
        len(written_ns[::every]) - len(received),
        100.0 * cpu,
        (len(received) - 1) / float((received_ns[-1] - received_ns[0]) * 1e-9),
        wakeups,
        turns,
        rss_mb,
        received[-1].payload,
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
        "reconstructor": METHOD,
        "clock": {"mode": "shared"},
        "mqtt": {"port": broker_port, "queue_length": 64},
        "log": {"level": "warning"},
    }
    config = folder / "gateway.yaml"
    config.write_text(yaml.safe_dump(settings))
    return config


@contextlib.asynccontextmanager
async def process_of(*arguments: str, tree: Path | None = None) -> AsyncIterator[asyncio.subprocess.Process]:
    """A Python process that is ended with the block. tree: a clone whose packages it takes,
    as an absolute path."""
    pipe = asyncio.subprocess.PIPE
    environment = environment_of(tree)
    process = await asyncio.create_subprocess_exec(
        sys.executable, *arguments, stdin=pipe, stdout=pipe, limit=2**24, cwd=tree, env=environment
    )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()


def environment_of(tree: Path | None) -> dict[str, str] | None:
    """The environment of a process that takes its packages from another clone; None: as here."""
    return None if tree is None else os.environ | {"PYTHONPATH": str(tree)}


async def line_of(process: asyncio.subprocess.Process) -> dict[str, Any]:
    """The next line that it prints, JSON."""
    assert process.stdout is not None
    return json.loads(await process.stdout.readline())  # type: ignore[no-any-return]
