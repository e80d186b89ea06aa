"""Every fault in turn on a running gateway: how soon poses are whole again, and what was lost.

A suit of 17 modules at 100 Hz on a pseudo-terminal, a real broker, the service, all but the broker in this
process. ``FAULT_CYCLES`` in the environment: how often the broker is killed and the cable pulled under load.
"""

from __future__ import annotations

import asyncio
import math
import os
import tempfile
import time
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fault_bench import (
    BROKER_LIMIT_S,
    LINK_LIMIT_S,
    SAMPLES_LIMIT_S,
    WHOLE_LIMIT_S,
    Bench,
    Broker,
    Outcome,
    Wiring,
    rss_mb,
)
from benchmarks.fault_bus import BUS_FAULTS
from benchmarks.fault_process import PROCESS_FAULTS
from benchmarks.fault_surroundings import SURROUNDINGS
from benchmarks.figures import Figure, Report, table
from devices.emulators.faults.fault_plan import FaultPlan
from devices.link import gateway_time_ns
from gateway.body.skeleton import LocalDevice
from gateway.frames import Quantity

CYCLES = int(os.environ.get("FAULT_CYCLES", "5"))
BEGIN_S = 4.0
"""When a fault begins: the gateway has settled by then."""
WATCHED_S = 3.5
"""How long it is watched after the fault's end."""
LINK_FAULTS = ("unplug", "USB", "bus-off")
"""Words in the names of faults that take the link down."""
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
    {"kind": "unplug", "lasts": 5.0},
)


SEVERAL: dict[str, tuple[dict[str, Any], ...]] = {
    "USB re-enumeration: three times away for 0.1 s": tuple(
        {"kind": "unplug", "at": BEGIN_S + 0.4 * k, "lasts": 0.1} for k in range(3)
    ),
    "host suspended: 1 s lost, module clocks 60 s ahead": (
        {"kind": "stall", "at": BEGIN_S, "lasts": 1.0},
        *({"kind": "clock_jump", "at": BEGIN_S + 0.5, "module": m, "by": 60.0} for m in range(17)),
    ),
}
"""Faults made of several."""

WAIST = LocalDevice(Quantity.POSITION, 0, np.zeros(3), 60)
"""A local measuring device on the root, for the fault that only such a one can have."""
NOT_FINITE = ({"kind": "not_finite", "at": BEGIN_S, "lasts": 1.0, "module": WAIST.device},)


def run() -> Report:
    """All faults, then cycles of the broker and of the cable."""
    to_do = [partial(_one, fault) for fault in FAULTS]
    to_do += [partial(_planned, name, faults) for name, faults in SEVERAL.items()]
    to_do.append(partial(_planned, "local measuring device says NaN for 1 s", NOT_FINITE, [WAIST]))
    outcomes = [_outcome_of(fault()) for fault in (*to_do, *BUS_FAULTS, *SURROUNDINGS, *PROCESS_FAULTS)]
    broker, broker_rss = asyncio.run(_cycles(f"broker killed {CYCLES} ×", BROKER_LIMIT_S, _kill_broker))
    cable, cable_rss = asyncio.run(_cycles(f"unplugged {CYCLES} × for 0.3 s", LINK_LIMIT_S, _pull_cable))
    everything = [*outcomes, broker, cable]
    cut = [outcome for outcome in everything if any(word in outcome.name for word in LINK_FAULTS)]
    report = Report("faults")
    report.figures = [
        _worst("recover_link_s", LINK_LIMIT_S, cut, "", "cable plugged in, bus-off ended → poses whole"),
        _worst("recover_broker_s", BROKER_LIMIT_S, everything, "broker", "broker listens → pose out"),
        _worst(
            "recover_module_s", SAMPLES_LIMIT_S, everything, "module", "module back → instant of its pose"
        ),
        Figure(
            "unaccounted_samples", sum(o.unaccounted for o in everything), "1", "<=0", "over all faults below"
        ),
        Figure("faults_failed", sum(not o.passes for o in everything), "1", "<=0", "of the rows below"),
        Figure(
            "rss_growth_mb",
            max(broker_rss, cable_rss),
            "MB",
            "<5",
            f"over {CYCLES} cycles of broker and cable, but the first two",
        ),
    ]
    heads = ["fault", "recovery, s", "at most, s", "lost, and to what", "unaccounted", "verdict"]
    title = "## Every fault: from its end until poses are whole\n\n"
    report.tables = [title + table(heads, [_row(o) for o in everything])]
    return report


def _outcome_of(doing: Coroutine[Any, Any, Outcome]) -> Outcome:
    """The outcome, printed too: all of them take minutes."""
    outcome = asyncio.run(doing)
    print(" | ".join(_row(outcome)), flush=True)
    return outcome


def _worst(name: str, limit_s: float, outcomes: list[Outcome], word: str, what: str) -> Figure:
    """The longest recovery of the faults whose limit this is and whose name has the word in it."""
    of_it = [o.recovery_s for o in outcomes if o.limit_s == limit_s and word in o.name and not o.note]
    return Figure(name, max(of_it), "s", f"<={limit_s:g}", f"{what}, the worst of all faults below")


def _row(outcome: Outcome) -> list[str]:
    if outcome.note:
        return [outcome.name, "–", "–", outcome.note, "–", "not done"]
    lost = ", ".join(f"{what} {count}" for what, count in outcome.lost.items()) or "nothing"
    verdict = "pass" if outcome.passes else "FAILS"
    recovery = "never" if math.isinf(outcome.recovery_s) else f"{outcome.recovery_s:.3f}"
    return [outcome.name, recovery, f"{outcome.limit_s:g}", lost, str(outcome.unaccounted), verdict]


async def _one(fault: dict[str, Any]) -> Outcome:
    detail = "".join(f" {key} {value}" for key, value in fault.items() if key != "kind")
    return await _planned(fault["kind"] + detail, ({**fault, "at": BEGIN_S},))


async def _planned(
    name: str, faults: tuple[dict[str, Any], ...], local: Sequence[LocalDevice] = ()
) -> Outcome:
    """Faults of a plan. Those of a module are judged by that module alone, and by instants.

    local: devices that the suit has beside its modules.
    """
    plan = FaultPlan.model_validate({"faults": faults})
    end_s = max(fault.at + fault.lasts for fault in plan.faults)
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        wiring = Wiring.by_cable(Path(folder), local)
        async with Bench(broker.port, plan, Path(folder), wiring=wiring) as bench:
            await bench.until(BEGIN_S)
            bench.begin()
            await bench.until(end_s + WATCHED_S)
            end_ns = bench.suit.instant_ns(end_s)
            module = faults[0].get("module") if len(faults) == 1 else None
            if module in bench.service.pipeline.suit.module_ids:
                back_s = bench.watch.back_s(end_ns, bench.segment_of(module))
                return bench.outcome(name, back_s, SAMPLES_LIMIT_S)
            limit_s = LINK_LIMIT_S if any(word in name for word in LINK_FAULTS) else WHOLE_LIMIT_S
            return bench.outcome(name, bench.watch.recovered_s(end_ns), limit_s)


async def _cycles(
    name: str, limit_s: float, cycle: Callable[[Bench, Broker], Awaitable[float]]
) -> tuple[Outcome, float]:
    """The same again and again, under load. cycle: does it once; the seconds to its recovery.

    With the growth of memory, MB, since the end of the second time.
    """
    worst, begun_rss = 0.0, 0.0
    with tempfile.TemporaryDirectory() as folder, Broker() as broker:
        async with Bench(broker.port, FaultPlan(), Path(folder)) as bench:
            await bench.until(BEGIN_S)
            bench.begin()
            for done in range(CYCLES):
                worst = max(worst, await cycle(bench, broker))
                begun_rss = rss_mb() if done == 1 else begun_rss
            growth = rss_mb() - begun_rss
            return bench.outcome(name, worst, limit_s), growth


async def _kill_broker(bench: Bench, broker: Broker) -> float:
    """It is killed and started again."""
    broker.kill()
    while bench.service.mqtt.is_connected:
        await asyncio.sleep(0.005)
    await asyncio.sleep(0.3)
    broker.start()
    begun, published = time.monotonic(), bench.service.mqtt.counters.published
    while bench.service.mqtt.counters.published <= published:
        await asyncio.sleep(0.005)
    return time.monotonic() - begun


async def _pull_cable(bench: Bench, _: Broker) -> float:
    """The cable is pulled and plugged in again; the terminal may have another name then."""
    await bench.suit.transport.close()
    await asyncio.sleep(0.3)
    await bench.suit.transport.open()
    since_ns = gateway_time_ns()
    bench.watch.poses.clear()
    give_up_ns = since_ns + round(LONGEST_WAIT_S * 1e9)
    while (recovery_s := bench.watch.recovered_s(since_ns)) == float("inf"):
        if gateway_time_ns() > give_up_ns:
            break
        await asyncio.sleep(0.02)
    return recovery_s
