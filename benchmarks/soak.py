"""``python -m benchmarks.soak --minutes 20``: random faults on a running gateway, recorded all the while.

Ends with 1, and says why, unless all of this holds: balances are even at every look (ten a second), memory
grew by less than 5 MB after the warm-up, no descriptor and no task is left over, and poses equal those of a
fault-free run wherever their inputs were intact (see ``benchmarks.soak_reference``).

``--shape single`` (or ``local``, ``lone``) runs a rig of one module, one of which only the local device is
heard, or 1 of 17 modules, without faults but for the broker's, and judges the same but for the poses: what
only grows where nobody waits for anybody grows there.

``python -m benchmarks soak --write-docs`` puts the report of ``SOAK_MINUTES`` into the documentation.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import random
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from benchmarks.fault_bench import Bench, Broker, Wiring, rss_mb
from benchmarks.faults import FAULTS
from benchmarks.figures import Figure, Report, table
from benchmarks.soak_simulated import simulated
from benchmarks.soak_watch import SoakWatch
from devices.emulators.faults.fault_plan import FaultPlan

LARGEST_GROWTH_MB = 5.0
LARGEST_ANGLE_DEG = 5.0
"""Of 99.9 % of the poses of segments that have been intact for longest: estimators remember for long."""
LARGEST_RATE = 0.5
"""rad/s, of 99 % of all intact ones: rates have no memory, and differ by the instants' error alone."""
LOOK_S = 0.1
MEMORY_S = 5.0
MEMORY_LOOKS = 12
WARM_UP_S = 60.0
"""First faults of most kinds, buffers filled, code compiled."""
BUSY_SHARE = 0.01
"""Of the time in which the machine may have been too busy for the emulated suit. Beyond it what arrives when
is not what the fault-free run had, and simulated time is judged; what real time had is told beside it."""
REAL_TIME, SIMULATED_TIME = "real time", "simulated time"
QUIET_S = (1.0, 4.0)
"""Between two faults."""
LONG_QUIET_S = 30.0
"""Now and then, and once at least, so that estimators settle."""
LONG_QUIET_SHARE = 0.1
KILL_BROKER_S = 45.0


class Shape(NamedTuple):
    """A suit of which somebody is silent."""

    meaning: str
    rig: str
    silent: frozenset[int]
    makes_poses: bool


SHAPES = {
    "single": Shape("a rig of one module", "single", frozenset(), True),
    "local": Shape("a rig of which only the local device is heard", "single_placed", frozenset({1}), False),
    "lone": Shape("1 of 17 modules", "suit_17", frozenset(range(1, 17)), True),
}


def schedule(seed: int, seconds: float) -> FaultPlan:
    """Faults one after another, at random, until a little before the end."""
    rng = random.Random(seed)
    faults: list[dict[str, Any]] = []
    at, has_rested = 4.0, False
    while at < seconds - 5.0:
        fault = dict(rng.choice(FAULTS))
        faults.append({**fault, "at": round(at, 3)})
        at += fault.get("lasts", 0.0) + rng.uniform(*QUIET_S)
        rests = rng.random() < LONG_QUIET_SHARE or (not has_rested and at > 0.5 * seconds)
        at += LONG_QUIET_S if rests else 0.0
        has_rested |= rests and at > 2 * LONG_QUIET_S
    return FaultPlan.model_validate({"seed": seed, "faults": faults})


async def soak(seed: int, seconds: float) -> dict[str, Any]:
    """Run it; the report."""
    process = psutil.Process()
    plan = schedule(seed, seconds)
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        before = process.num_fds(), len(asyncio.all_tasks())
        async with Bench(broker.port, plan, Path(folder)) as bench:
            watch = SoakWatch(Path(folder) / "poses.track", plan, bench)
            bench.service.recording.start("soak")
            seen = await _look_on(bench, broker, seconds)
            balances = {balance.name: balance.summary() for balance in bench.service.balances()}
            poses = bench.service.pipeline.skeleton_frames
            failures, suit_s = bench.failures, bench.faulty.reached_s
            suit_late_s = bench.suit.counts.worst_lateness_s
        in_real_time = await watch.compared()
        await asyncio.sleep(0.5)
        after = process.num_fds(), len(asyncio.all_tasks())
    was_busy = watch.busy_share > BUSY_SHARE
    compared = simulated(plan, seconds) if was_busy else in_real_time
    return {
        "seconds": seconds,
        "seed": seed,
        "faults": dict(sorted(bench.faulty.counts.items())),
        "poses": poses,
        "failures": failures,
        "suit_s": round(suit_s, 1),
        "suit_late_s": round(suit_late_s, 2),
        "busy_share": round(watch.busy_share, 4),
        **seen,
        "descriptors_left": after[0] - before[0],
        "tasks_left": after[1] - before[1],
        "latency_ms": watch.latency_ms(),
        "compared_in": SIMULATED_TIME if was_busy else REAL_TIME,
        "compared": compared,
        "compared_in_real_time": in_real_time,
        "accounting": balances,
    }


async def soak_shape(name: str, seconds: float) -> dict[str, Any]:
    """Run a suit of a shape without faults; the report."""
    shape, plan, process = SHAPES[name], FaultPlan(), psutil.Process()
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        before = process.num_fds(), len(asyncio.all_tasks())
        wiring = Wiring.of_rig(Path(folder), shape.rig, shape.silent)
        async with Bench(broker.port, plan, Path(folder), wiring=wiring) as bench:
            bench.service.recording.start("soak")
            seen = await _look_on(bench, broker, seconds)
            balances = {balance.name: balance.summary() for balance in bench.service.balances()}
            poses, failures = bench.service.pipeline.skeleton_frames, bench.failures
            suit_s = bench.faulty.reached_s
        await asyncio.sleep(0.5)
        after = process.num_fds(), len(asyncio.all_tasks())
    return {
        "shape": name,
        "suit": shape.meaning,
        "seconds": seconds,
        "poses": poses,
        "failures": failures,
        "suit_s": round(suit_s, 1),
        **seen,
        "descriptors_left": after[0] - before[0],
        "tasks_left": after[1] - before[1],
        "accounting": balances,
    }


async def _look_on(bench: Bench, broker: Broker, seconds: float) -> dict[str, Any]:
    """Let it run, kill the broker now and then, and note what is to stay bounded."""
    uneven = longest_queue = kills = 0
    memory_mb: list[float] = []
    memory_due, kill_due = min(WARM_UP_S, seconds / 3), KILL_BROKER_S
    while (now_s := bench.motion_s) < seconds:
        await asyncio.sleep(LOOK_S)
        uneven += bench.left_over != 0
        longest_queue = max(longest_queue, bench.service.mqtt.counters.queued)
        if now_s > memory_due:
            memory_due += MEMORY_S
            memory_mb.append(round(rss_mb(), 2))
        if now_s > kill_due:
            kill_due += KILL_BROKER_S
            kills += 1
            broker.kill()
            await asyncio.sleep(0.5)
            await asyncio.to_thread(broker.start)
    return {
        "uneven_looks": uneven,
        "broker_kills": kills,
        "longest_output_queue": longest_queue,
        "rss_growth_mb": _growth_mb(memory_mb),
        "rss_mb": memory_mb,
    }


def _growth_mb(memory_mb: list[float]) -> float:
    """Between the first and the last looks after the warm-up; medians, since it goes up and down."""
    n = min(MEMORY_LOOKS, max(1, len(memory_mb) // 2))
    return round(statistics.median(memory_mb[-n:]) - statistics.median(memory_mb[:n]), 2)


def complaints(report: dict[str, Any]) -> list[str]:
    """What does not hold."""
    found = _unbounded(report)
    shape = SHAPES.get(report.get("shape", ""))
    if (shape is None or shape.makes_poses) and report["poses"] < 50 * report["suit_s"]:
        found.append(f"only {report['poses']} poses came of {report['suit_s']:g} s of the suit")
    return found + (_differences(report) if shape is None else [])


def _unbounded(report: dict[str, Any]) -> list[str]:
    """Of tasks, balances, memory and descriptors."""
    found = []
    for name, error in report["failures"].items():
        found.append(f"the {name} ended before its time: {error}")
    if report["uneven_looks"]:
        found.append(f"balances were uneven at {report['uneven_looks']} looks")
    if report["rss_growth_mb"] >= LARGEST_GROWTH_MB:
        found.append(f"memory grew by {report['rss_growth_mb']} MB: at most {LARGEST_GROWTH_MB:g}")
    if report["descriptors_left"] > 0:
        found.append(f"{report['descriptors_left']} descriptors were left open")
    if report["tasks_left"] > 0:
        found.append(f"{report['tasks_left']} tasks were left running")
    return found


def _differences(report: dict[str, Any]) -> list[str]:
    """From a fault-free run."""
    found = []
    longest_intact = report["compared"][-1]
    if not longest_intact["count"]:
        found.append("no segment was intact for long enough to be compared")
    if longest_intact["p99.9_deg"] > LARGEST_ANGLE_DEG:
        found.append(
            f"poses of intact segments are {longest_intact['p99.9_deg']} degrees (99.9 %) from a fault-free "
            f"run: at most {LARGEST_ANGLE_DEG:g}"
        )
    is_busy = report["compared_in"] == REAL_TIME and report["busy_share"] > BUSY_SHARE
    rate = (longest_intact if is_busy else report["compared"][0])["p99_rad_s"]
    if rate > LARGEST_RATE:
        found.append(f"rates of intact segments are {rate} rad/s (99 %) from it")
    return found


def run() -> Report:
    """A soak of ``SOAK_MINUTES`` (20) for the documentation."""
    found = asyncio.run(soak(1, 60.0 * float(os.environ.get("SOAK_MINUTES", "20"))))
    minutes = found["seconds"] / 60.0
    report = Report("soak")
    report.figures = [
        Figure("soak_minutes", minutes, "min", "", "17 modules at 100 Hz, one fault after another"),
        Figure("soak_uneven", found["uneven_looks"], "1", "<=0", "looks at the balances, ten a second"),
        Figure("soak_rss_growth_mb", found["rss_growth_mb"], "MB", "<5", "after the first minute"),
        Figure(
            "soak_left_over",
            found["descriptors_left"] + found["tasks_left"],
            "1",
            "<=0",
            "of descriptors and tasks",
        ),
        Figure(
            "soak_equal_deg",
            found["compared"][-1]["p99.9_deg"],
            "°",
            f"<={LARGEST_ANGLE_DEG:g}",
            "99.9 % of poses intact for 20 s, from a fault-free run's",
        ),
        Figure(
            "soak_suit_late_s",
            found["suit_late_s"],
            "s",
            "",
            "the emulated suit itself sent so late at worst: the machine was too busy for it",
        ),
        Figure(
            "soak_latency_p50_ms",
            found["latency_ms"]["p50"],
            "ms",
            "",
            "sample's instant → pose to the outputs, faults included",
        ),
        Figure(
            "soak_latency_p99_ms",
            found["latency_ms"]["p99"],
            "ms",
            "",
            "the same; suit, gateway and others on two cores",
        ),
    ]
    report.tables = [_faults_table(found), _compared_table(found), _balances_table(found)]
    for complaint in complaints(found):
        report.tables.append(f"**Does not hold:** {complaint}")
    return report


def _faults_table(found: dict[str, Any]) -> str:
    rows = [[kind, str(count)] for kind, count in found["faults"].items()]
    rows += [["broker killed", str(found["broker_kills"])]]
    return "## What befell it\n\n" + table(
        ["fault", "transmissions (noise: bytes; modules, broker: times)"], rows
    )


def _compared_table(found: dict[str, Any]) -> str:
    heads = [
        "intact for, s",
        "poses of segments",
        "median, °",
        "99 %, °",
        "99.9 %, °",
        "largest, °",
        "rate 99 %, rad/s",
    ]
    keys = ("p50_deg", "p99_deg", "p99.9_deg", "p100_deg", "p99_rad_s")
    rows = [
        [f"≥ {row['intact_s']:g}", str(row["count"]), *(f"{row[key]:.2f}" for key in keys)]
        for row in found["compared"]
    ]
    title = "## Against a fault-free run, by how long a segment's inputs were intact"
    return f"{title}\n\nIn {found['compared_in']}.\n\n{table(heads, rows)}"


def _balances_table(found: dict[str, Any]) -> str:
    rows = [
        [
            name,
            str(b["total"]),
            ", ".join(f"{part} {n}" for part, n in b["parts"].items() if n),
            str(b["unaccounted"]),
        ]
        for name, b in found["accounting"].items()
    ]
    return "## Where everything went\n\n" + table(
        ["balance", "total", "what became of it", "unaccounted"], rows
    )


def main() -> int:
    """Parse, run, tell."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--shape", choices=SHAPES, help="a suit of which somebody is silent, without faults")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s")
    seconds = arguments.minutes * 60.0
    run_it = soak_shape(arguments.shape, seconds) if arguments.shape else soak(arguments.seed, seconds)
    report = asyncio.run(run_it)
    print(json.dumps(report, indent=2))
    for complaint in complaints(report):
        print(f"soak: {complaint}", file=sys.stderr)
    return 1 if complaints(report) else 0


if __name__ == "__main__":
    sys.exit(main())
