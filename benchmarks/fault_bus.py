"""Faults of a CAN bus, and of what is on it. See ``benchmarks.faults``, and ``EmulatedBus`` for the bus."""

from __future__ import annotations

import asyncio
import contextlib
import tempfile
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.emulated_bus import EmulatedBus
from benchmarks.fault_bench import LINK_LIMIT_S, WHOLE_LIMIT_S, Bench, Broker, Outcome, Wiring
from devices.emulators.faults.fault_plan import FaultPlan
from devices.links.socketcan_link import BusError

BEGIN_S = 4.0
LASTS_S = 1.0
WATCHED_S = 2.0
FULL_BUS_BYTES_PER_S = 60_000.0
"""What fits on a bus of 1 Mbit/s, in frames of 8 bytes."""
BABBLING: tuple[dict[str, Any], ...] = (
    {"kind": "noise", "at": BEGIN_S, "lasts": LASTS_S, "bytes_per_s": FULL_BUS_BYTES_PER_S},
    {"kind": "loss", "at": BEGIN_S, "lasts": LASTS_S, "share": 0.5},
)
"""A node that fills the bus: its frames go first, and half of the others do not get through."""
PASSIVE_LOSS = 0.2


@contextlib.asynccontextmanager
async def _running(faults: Sequence[dict[str, Any]] = ()) -> AsyncIterator[tuple[Bench, EmulatedBus]]:
    """A gateway on a bus, that has settled."""
    bus, plan = EmulatedBus(), FaultPlan.model_validate({"faults": faults})
    with tempfile.TemporaryDirectory() as folder, Broker() as broker, bus.in_place():
        async with Bench(broker.port, plan, Path(folder), wiring=Wiring.by_bus(bus)) as bench:
            await bench.until(BEGIN_S)
            bench.begin()
            yield bench, bus


async def _recovered(bench: Bench, name: str, limit_s: float) -> Outcome:
    """From now on."""
    since_ns = bench.now_ns
    await asyncio.sleep(WATCHED_S)
    return bench.outcome(name, bench.watch.recovered_s(since_ns), limit_s)


async def babbling_node() -> Outcome:
    """A node fills the bus with frames that nobody wants."""
    async with _running(BABBLING) as (bench, _):
        await bench.until(BEGIN_S + LASTS_S)
        return await _recovered(bench, f"CAN: babbling node fills the bus for {LASTS_S:g} s", WHOLE_LIMIT_S)


async def error_passive() -> Outcome:
    """Bad wiring: the controller reports it, and takes only some of the frames."""
    async with _running() as (bench, bus):
        bus.report(BusError.PASSIVE)
        bus.loss = PASSIVE_LOSS
        await asyncio.sleep(LASTS_S)
        bus.loss = 0.0
        return await _recovered(
            bench, f"CAN: controller error-passive for {LASTS_S:g} s, {PASSIVE_LOSS:.0%} lost", WHOLE_LIMIT_S
        )


async def bus_off() -> Outcome:
    """The controller leaves the bus, until the kernel restarts it."""
    async with _running() as (bench, bus):
        bus.report(BusError.BUS_OFF)
        await asyncio.sleep(LASTS_S)
        bus.is_off = False
        return await _recovered(bench, f"CAN: bus-off for {LASTS_S:g} s", LINK_LIMIT_S)


async def controller_overflow() -> Outcome:
    """The controller's own buffer is full for a moment."""
    async with _running() as (bench, bus):
        bus.loss = 1.0
        await asyncio.sleep(0.05)
        bus.report(BusError.OVERFLOW)
        bus.loss = 0.0
        return await _recovered(bench, "CAN: controller's buffer full for 0.05 s", WHOLE_LIMIT_S)


BUS_FAULTS = (babbling_node, error_passive, bus_off, controller_overflow)
"""All of them, in the order of the table."""
