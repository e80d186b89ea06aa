"""``python -m benchmarks.soak --minutes 20``: random faults, recorded all the while.

Ends with 1, and says why, unless all of this holds: balances are even at every look (ten a second), memory
grew by less than 5 MB after the warm-up, no descriptor and no task is left over.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import sys
import tempfile
from pathlib import Path
from typing import Any

import psutil

from benchmarks.faults import FAULTS, Bench, Broker, rss_mb
from devices.emulators.fault_plan import FaultPlan

LARGEST_GROWTH_MB = 5.0
LOOK_S = 0.1
WARM_UP_S = 20.0
"""First faults of every kind, buffers filled, code compiled."""
QUIET_S = (1.0, 4.0)
"""Between two faults."""
KILL_BROKER_S = 45.0


def schedule(seed: int, seconds: float) -> FaultPlan:
    """Faults one after another, at random, until a little before the end."""
    rng = random.Random(seed)
    faults: list[dict[str, Any]] = []
    at = 4.0
    while at < seconds - 5.0:
        fault = dict(rng.choice(FAULTS))
        faults.append({**fault, "at": round(at, 3)})
        at += fault.get("lasts", 0.0) + rng.uniform(*QUIET_S)
    return FaultPlan.model_validate({"seed": seed, "faults": faults})


async def soak(seed: int, seconds: float) -> dict[str, Any]:
    """Run it; the report."""
    process, uneven, longest_queue = psutil.Process(), 0, 0
    plan = schedule(seed, seconds)
    warm_up_s = min(WARM_UP_S, seconds / 3)
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        before = process.num_fds(), len(asyncio.all_tasks())
        async with Bench(broker.port, plan, Path(folder)) as bench:
            bench.service.recording.start("soak")
            warm_mb, next_kill = 0.0, KILL_BROKER_S
            while (now_s := bench.motion_s) < seconds:
                await asyncio.sleep(LOOK_S)
                uneven += bench.left_over != 0
                longest_queue = max(longest_queue, bench.service.mqtt.counters.queued)
                if not warm_mb and now_s > warm_up_s:
                    warm_mb = rss_mb()
                if now_s > next_kill:
                    next_kill += KILL_BROKER_S
                    broker.kill()
                    await asyncio.sleep(0.5)
                    await asyncio.to_thread(broker.start)
            grown_mb = rss_mb() - warm_mb
            balances = {balance.name: balance.summary() for balance in bench.service.balances()}
            poses = bench.service.pipeline.skeleton_frames
        await asyncio.sleep(0.5)
        after = process.num_fds(), len(asyncio.all_tasks())
    return {
        "seconds": seconds,
        "seed": seed,
        "faults": dict(sorted(bench.faulty.counts.items())),
        "poses": poses,
        "uneven_looks": uneven,
        "rss_growth_mb": round(grown_mb, 2),
        "descriptors_left": after[0] - before[0],
        "tasks_left": after[1] - before[1],
        "longest_output_queue": longest_queue,
        "accounting": balances,
    }


def complaints(report: dict[str, Any]) -> list[str]:
    """What does not hold."""
    found = []
    if report["uneven_looks"]:
        found.append(f"balances were uneven at {report['uneven_looks']} looks")
    if report["rss_growth_mb"] >= LARGEST_GROWTH_MB:
        found.append(f"memory grew by {report['rss_growth_mb']} MB: at most {LARGEST_GROWTH_MB:g}")
    if report["descriptors_left"] > 0:
        found.append(f"{report['descriptors_left']} descriptors were left open")
    if report["tasks_left"] > 0:
        found.append(f"{report['tasks_left']} tasks were left running")
    if report["poses"] < 50 * report["seconds"]:
        found.append(f"only {report['poses']} poses came in {report['seconds']:g} s")
    return found


def main() -> int:
    """Parse, run, tell."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    report = asyncio.run(soak(arguments.seed, arguments.minutes * 60.0))
    print(json.dumps(report, indent=2))
    for complaint in complaints(report):
        print(f"soak: {complaint}", file=sys.stderr)
    return 1 if complaints(report) else 0


if __name__ == "__main__":
    sys.exit(main())
