"""The first start: what an installation compiles, the first pose with that and without, and short commands.

Everything runs in a copy of this tree in a folder of its own, with kernels of its own, in the environment
that is installed: nothing is fetched. Beside the figures stand floors of the same run, so that they say
something on any machine.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import llvmlite.binding as llvm

from benchmarks.figures import Figure, Report, table
from benchmarks.running import METHOD, START_S, running
from gateway.cli.main import _Commands
from gateway.support.processor import CPU_FEATURES, CPU_NAME, target_name

TREE = Path(__file__).parents[1]
PACKAGES = ("gateway", "devices", "firmware_protocol", "config")
REPEATS = 3
"""Of a short command; the quickest counts."""
TRIES = 2
"""Of a first pose; each is told, the quicker counts."""
ALTERNATIONS = 3
FRAMES = 300
SOLVE_NOTHING = (
    ("config", "check", "config/gateway.yaml"),
    ("config", "schema"),
    ("recordings", "config"),
    ("health", "--port", "1"),
    ("kernels", "status"),
    ("doctor", "-c", "config/gateway.yaml", "--listen", "0"),
)
"""Commands that open no port for long and solve nothing; those that fail here do so at their end."""

COMPILES = "import numba; numba.njit(lambda x: x * x + 1.0)(2.0)"
IMPORTS = "import numpy; from pydantic import BaseModel"
FIRST_MESSAGE = """
import asyncio, sys, aiomqtt, numba, numpy, pydantic
async def publish():
    async with aiomqtt.Client("127.0.0.1", int(sys.argv[1])) as client:
        await client.publish("floor", b"0" * 1600)
asyncio.run(publish())
"""
FRAME = """
import sys, time
import gateway
import numpy as np
from gateway.body.rig import load_rig
from gateway.emulation.rig import dress, move_about
from gateway.emulation.simulation import ideal_frames
from gateway.reconstruction import RootMode, RootSettings, create_reconstructor
suit = load_rig("suit_17")
body = dress(suit)
motion = move_about(body, suit.skeleton.name, 1)
times_ns = np.arange(int(sys.argv[2])) * 10_000_000
frames = list(ideal_frames(suit, body, motion, times_ns, True))
reconstructor = create_reconstructor(sys.argv[1], suit, 0.01, RootSettings(RootMode.FIXED))
best_s = float("inf")
for _ in range(5):
    reconstructor.reset()
    begun_s = time.perf_counter()
    for frame in frames:
        reconstructor.update(frame)
    best_s = min(best_s, time.perf_counter() - begun_s)
print(best_s / len(frames) * 1e6)
"""


@dataclass(frozen=True)
class Copy:
    """A copy of the tree, with kernels of its own."""

    folder: Path

    def environment(self, kernels: str = "kernels") -> dict[str, str]:
        """Return what a process there runs with. kernels: folder of them."""
        return {
            "PYTHONPATH": str(self.folder),
            "NUMBA_CACHE_DIR": str(self.folder / kernels),
            "PYTHONDONTWRITEBYTECODE": "",  # else all sources are compiled again for every command
        }

    def seconds(
        self, arguments: Sequence[str], more: Mapping[str, str] | None = None, is_checked: bool = True
    ) -> float:
        """Return how long the interpreter takes for something there."""
        begun_s = time.perf_counter()
        subprocess.run(
            [sys.executable, *arguments],
            cwd=self.folder,
            env=os.environ | self.environment() | (more or {}),
            stdout=subprocess.DEVNULL,
            stderr=None if is_checked else subprocess.DEVNULL,
            check=is_checked,
        )
        return time.perf_counter() - begun_s


def run() -> Report:
    """All of them."""
    report = Report("start")
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for package in PACKAGES:
            ignored = shutil.ignore_patterns("__pycache__", "ready_kernels")
            shutil.copytree(TREE / package, copy.folder / package, ignore=ignored)
        report.figures += _install(copy)
        report.figures += asyncio.run(_first_poses(copy))
        report.figures += _commands(report, copy)
        report.figures += _fixed_target(copy)
    loads = f"{load:.1f} before, {os.getloadavg()[0]:.1f} after"
    report.tables.insert(0, f"Load average of the machine: {loads}, on {os.cpu_count()} cores.")
    return report


def _install(copy: Copy) -> Iterator[Figure]:
    """What ``make install`` does beside fetching: compile, into bytecode and kernels."""
    floor_s = min(copy.seconds(["-c", COMPILES]) for _ in range(REPEATS))
    seconds = copy.seconds(["-m", "gateway", "kernels", "build"])
    files = [path for path in (copy.folder / "kernels").rglob("*") if path.is_file()]
    what = f"`kernels build` for {target_name()}, {len(os.sched_getaffinity(0))} processes side by side"
    yield Figure("install_own_work_s", seconds, "s", "<=60", what)
    yield Figure(
        "floor_compile_one_s", floor_s, "s", "", "floor: Numba imported, one function of a line compiled"
    )
    size = sum(path.stat().st_size for path in files) / 1e6
    yield Figure("kernels_ready_mb", size, "MB", "", f"{len(files)} files")


async def _first_poses(copy: Copy) -> list[Figure]:
    """From ``run`` to the first pose by the method, with the kernels of the installation and without any."""
    ready = [await _first_pose(copy, "kernels") for _ in range(TRIES)]
    without = [await _first_pose(copy, f"none{k}") for k in range(TRIES)]
    runs = "; ".join(f"{method_s:.1f} s" for _, method_s, _ in ready)
    figures = [
        Figure(
            "first_pose_cold_s", min(method_s for _, method_s, _ in ready), "s", "<=10",
            f"from `run` to the first pose by `{METHOD}`, kernels ready; runs: {runs}",
        ),
        Figure(
            "floor_first_message_s", min(floor_s for *_, floor_s in ready), "s", "",
            "floor: a process that imports numba, numpy, pydantic and aiomqtt, and publishes one message",
        ),
    ]  # fmt: skip
    for name, at, what in (
        ("first_pose_without_kernels_s", 0, "the first pose of any method, nothing compiled before"),
        ("method_without_kernels_s", 1, f"the first by `{METHOD}` then"),
    ):
        runs = "; ".join(f"{each[at]:.1f} s" for each in without)
        figures.append(Figure(name, min(each[at] for each in without), "s", "", f"{what}; runs: {runs}"))
    return figures


async def _first_pose(copy: Copy, kernels: str) -> tuple[float, float, float]:
    """Seconds to the first pose, to the first by the method, and those of the floor."""
    async with running("pty", copy.environment(kernels), copy.folder) as it:
        observed = it.observed
        async with asyncio.timeout(START_S):
            while not any(method == METHOD for _, method in observed.methods):
                await asyncio.sleep(0.02)
            since_s = next(at for at, method in observed.methods if method == METHOD)
            while not observed.poses or observed.poses[-1][0] < since_s:
                await asyncio.sleep(0.02)
        first_s = observed.poses[0][0] - it.begun_s
        method_s = next(at for at, _ in observed.poses if at >= since_s) - it.begun_s
        it.gateway.kill()
        await it.gateway.wait()
        floor_s = await asyncio.to_thread(copy.seconds, ["-c", FIRST_MESSAGE, str(it.broker_port)])
    return first_s, method_s, floor_s


def _commands(report: Report, copy: Copy) -> Iterator[Figure]:
    """Help of the whole, then help of each subcommand and what solves nothing."""

    def quickest(arguments: Sequence[str]) -> float:
        return min(copy.seconds(arguments, is_checked=False) for _ in range(REPEATS))

    yield Figure("floor_python_s", quickest(["-c", "pass"]), "s", "", "floor: the interpreter alone")
    yield Figure("floor_imports_s", quickest(["-c", IMPORTS]), "s", "", "floor: numpy and pydantic imported")
    yield Figure("help_s", quickest(["-m", "gateway", "--help"]), "s", "<=0.3", "`mocap-gateway --help`")
    commands = [*((name, "--help") for name in _Commands.lazy), *SOLVE_NOTHING]
    seconds = {" ".join(command): quickest(["-m", "gateway", *command]) for command in commands}
    worst = max(seconds, key=seconds.__getitem__)
    yield Figure("subcommand_worst_s", seconds[worst], "s", "<=0.6", f"the slowest of them: `{worst}`")
    rows = [
        [f"`{name}`", f"{seconds[name]:.2f}"]
        for name in sorted(seconds, key=seconds.__getitem__, reverse=True)
    ]
    report.tables.append(f"## Commands that solve nothing\n\n{table(['command', 's'], rows)}")


def _fixed_target(copy: Copy) -> Iterator[Figure]:
    """The time of a frame, kernels compiled for the fixed target and for this processor, in turns."""
    native = {CPU_NAME: llvm.get_host_cpu_name(), "NUMBA_CACHE_DIR": str(copy.folder / "native")}
    fixed_us, native_us = [], []
    for _ in range(ALTERNATIONS):
        fixed_us.append(_frame_us(copy, {}))
        native_us.append(_frame_us(copy, native))
    cost = (min(fixed_us) / min(native_us) - 1.0) * 100.0
    both = f"{min(fixed_us):.1f} µs for {target_name()}, {min(native_us):.1f} µs for {native[CPU_NAME]}"
    what = f"a frame of `{METHOD}`, 17 segments: {both}"
    yield Figure("fixed_target_cost_percent", cost, "%", "", what)


def _frame_us(copy: Copy, more: Mapping[str, str]) -> float:
    inherited = {name: value for name, value in os.environ.items() if name not in (CPU_NAME, CPU_FEATURES)}
    done = subprocess.run(
        [sys.executable, "-c", FRAME, METHOD, str(FRAMES)],
        cwd=copy.folder,
        env=inherited | copy.environment() | more,
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout)
