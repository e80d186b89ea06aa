"""Every fault in turn on a running gateway: how soon poses are whole again, and what was lost.

A suit of 17 modules at 100 Hz on a pseudo-terminal, a real broker, the service, all but the broker in this
process. ``FAULT_CYCLES`` in the environment: how often the broker is killed and the cable pulled under load.
"""

from __future__ import annotations

import asyncio
import os
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.fault_bench import Bench, Broker, rss_mb
from benchmarks.figures import Figure, Report, table
from devices.emulators.fault_plan import FaultPlan
from devices.link import gateway_time_ns

CYCLES = int(os.environ.get("FAULT_CYCLES", "5"))
BEGIN_S = 4.0
"""When a fault begins: the gateway has settled by then."""
WATCHED_S = 3.5
"""How long it is watched after the fault's end."""
LONGEST_WAIT_S = 10.0
"""Longer than that is no recovery."""

FAULTS: tuple[dict[str, Any], ...] = (
    {"kind": "bit_errors", "lasts": 1.0, "share": 0.1},
    {"kind": "loss", "lasts": 1.0, "share": 0.3},
    {"kind": "duplication", "lasts": 1.0, "share": 0.3},
    {"kind": "reordering", "lasts": 1.0, "share": 0.3, "delay": 0.03},
    {"kind": "burst", "lasts": 0.4},
    {"kind": "stall", "lasts": 1.0},
    {"kind": "slow_drip", "lasts": 1.0, "bytes_per_s": 2000.0},
    {"kind": "noise", "lasts": 1.0, "bytes_per_s": 5000.0},
    {"kind": "reset", "lasts": 0.3, "module": 2},
    {"kind": "clock_jump", "by": 5.0, "module": 3},
    {"kind": "clock_jump", "by": -5.0, "module": 3},
    {"kind": "stuck", "lasts": 1.0, "module": 1},
    {"kind": "saturated", "lasts": 1.0, "module": 1},
    {"kind": "id_conflict", "lasts": 1.0, "module": 6, "takes": 5},
    {"kind": "unplug", "lasts": 1.0},
)


class Outcome(NamedTuple):
    """What one fault did."""

    name: str
    recovery_s: float
    lost: int
    unaccounted: int


def run() -> Report:
    """All faults, then cycles of the broker and of the cable."""
    outcomes = [asyncio.run(_fault(fault)) for fault in FAULTS]
    broker, broker_rss = asyncio.run(_broker_cycles())
    cable, cable_rss = asyncio.run(_cable_cycles())
    everything = [*outcomes, broker, cable]
    report = Report("faults")
    unplugged = max(o.recovery_s for o in everything if o.name.startswith("unplug"))
    report.figures = [
        Figure("recover_link_s", unplugged, "s", "<=1", "cable plugged in again → poses whole, the worst"),
        Figure(
            "recover_broker_s",
            broker.recovery_s,
            "s",
            "<=2",
            f"broker listens → pose out, worst of {CYCLES}",
        ),
        Figure(
            "unaccounted_samples", sum(o.unaccounted for o in everything), "1", "<=0", "over all faults below"
        ),
        Figure(
            "rss_growth_mb",
            max(broker_rss, cable_rss),
            "MB",
            "<5",
            f"over {CYCLES} cycles but the first two",
        ),
    ]
    rows = [[o.name, f"{o.recovery_s:.2f}", str(o.lost), str(o.unaccounted)] for o in everything]
    heads = ["fault", "recovery, s", "packets lost", "unaccounted"]
    report.tables = ["### Every fault: from its end until poses are whole\n\n" + table(heads, rows)]
    return report


async def _fault(fault: dict[str, Any]) -> Outcome:
    plan = FaultPlan.model_validate({"faults": [{**fault, "at": BEGIN_S}]})
    end_s = BEGIN_S + fault.get("lasts", 0.0)
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        async with Bench(broker.port, plan, Path(folder)) as bench:
            await bench.until(end_s + WATCHED_S)
            recovery_s = bench.watch.recovered_s(bench.suit.instant_ns(end_s))
            detail = "".join(f" {key} {value}" for key, value in fault.items() if key != "kind")
            return Outcome(fault["kind"] + detail, recovery_s, bench.lost, bench.left_over)


async def _broker_cycles() -> tuple[Outcome, float]:
    """The broker is killed and started again, under load."""
    worst, begun_rss = 0.0, 0.0
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        async with Bench(broker.port, FaultPlan(), Path(folder)) as bench:
            await bench.until(BEGIN_S)
            for cycle in range(CYCLES):
                broker.kill()
                while bench.service.mqtt.is_connected:
                    await asyncio.sleep(0.005)
                await asyncio.sleep(0.3)
                broker.start()
                begun, published = time.monotonic(), bench.service.mqtt.counters.published
                while bench.service.mqtt.counters.published <= published:
                    await asyncio.sleep(0.005)
                worst = max(worst, time.monotonic() - begun)
                begun_rss = rss_mb() if cycle == 1 else begun_rss
            growth = rss_mb() - begun_rss
            return Outcome(f"broker killed {CYCLES} ×", worst, bench.lost, bench.left_over), growth


async def _cable_cycles() -> tuple[Outcome, float]:
    """The cable is pulled and plugged in again, under load; the terminal may have another name then."""
    worst, begun_rss = 0.0, 0.0
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        async with Bench(broker.port, FaultPlan(), Path(folder)) as bench:
            await bench.until(BEGIN_S)
            for cycle in range(CYCLES):
                await bench.suit.transport.close()
                await asyncio.sleep(0.3)
                await bench.suit.transport.open()
                since_ns = gateway_time_ns()
                bench.watch.whole.clear()
                give_up_ns = since_ns + round(LONGEST_WAIT_S * 1e9)
                while (recovery_s := bench.watch.recovered_s(since_ns)) == float("inf"):
                    if gateway_time_ns() > give_up_ns:
                        break
                    await asyncio.sleep(0.02)
                worst = max(worst, recovery_s)
                begun_rss = rss_mb() if cycle == 1 else begun_rss
            growth = rss_mb() - begun_rss
            return Outcome(f"unplugged {CYCLES} × for 0.3 s", worst, bench.lost, bench.left_over), growth
