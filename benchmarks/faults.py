"""Every fault in turn on a running gateway: how soon poses are whole again, and what was lost.

A suit of 17 modules at 100 Hz on a pseudo-terminal, a real broker, the service, all but the broker in this
process. ``FAULT_CYCLES`` in the environment: how often the broker is killed and the cable pulled under load.
"""

from __future__ import annotations

import asyncio
import gc
import os
import socket
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil

from benchmarks.emulated_stream import suit_17
from benchmarks.figures import Figure, Report, table
from benchmarks.local_broker import mosquitto_program
from devices.emulators import IDEAL, EmulatedSuit, SuitSettings, SuitTraffic
from devices.emulators.fault_plan import FaultPlan
from devices.emulators.faulty_suit import FaultySuit, pull_cable
from devices.emulators.transports import PtyTransport
from devices.link import gateway_time_ns
from gateway.accounting import unaccounted
from gateway.frames import SkeletonFrame, Status
from gateway.service import Service
from gateway.settings import GatewaySettings

CYCLES = int(os.environ.get("FAULT_CYCLES", "5"))
BEGIN_S = 4.0
"""When a fault begins: the gateway has settled by then."""
WATCHED_S = 3.5
"""How long it is watched after the fault's end."""
WHOLE_POSES = 10
"""So many whole poses in a row are a recovery; it counts from the first of them."""

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


class _Watch:
    """An output that notes when poses were whole."""

    def __init__(self) -> None:
        self.whole: list[tuple[int, bool]] = []

    def offer(self, frame: SkeletonFrame) -> None:
        """Note the gateway time, and whether every segment was measured."""
        is_whole = bool(np.all(frame.status <= Status.INTERPOLATED))
        self.whole.append((gateway_time_ns(), is_whole))

    def recovered_s(self, since_ns: int) -> float:
        """Time from an instant to the first of ``WHOLE_POSES`` whole poses in a row; infinite: never."""
        run: list[int] = []
        for at_ns, is_whole in self.whole:
            if at_ns >= since_ns:
                run = [*run, at_ns] if is_whole else []
                if len(run) == WHOLE_POSES:
                    return (run[0] - since_ns) * 1e-9
        return float("inf")


class Bench:
    """A running service with a faulty suit at its link."""

    def __init__(self, port: int, plan: FaultPlan, folder: Path) -> None:
        worn, motion = suit_17()
        traffic = SuitTraffic(motion, SuitSettings(has_relay=True), IDEAL, seed=1)
        self.faulty = FaultySuit(traffic, plan)
        self.plan = plan
        self.suit = EmulatedSuit(self.faulty, PtyTransport(folder / "suit"))
        settings = GatewaySettings.model_validate(
            {
                "links": [{"name": "suit", "url": str(folder / "suit")}],
                "rig": "suit_17",
                "mqtt": {"port": port},
                "recording": {"folder": str(folder / "recordings")},
            }
        )
        self.service = Service(settings, worn)
        self.watch = _Watch()
        self.service._outputs = (*self.service._outputs, self.watch)  # type: ignore[assignment]
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Bench:
        self._tasks = [
            asyncio.create_task(self.suit.run()),
            asyncio.create_task(pull_cable(self.plan, self.suit)),
            asyncio.create_task(self.service.run()),
        ]
        while self.suit.start_ns is None:
            await asyncio.sleep(0.01)
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    @property
    def motion_s(self) -> float:
        """Motion time now, s."""
        return self.suit.motion_time_s(gateway_time_ns())

    async def until(self, motion_s: float) -> None:
        """Sleep until a motion time."""
        await asyncio.sleep(max(0.0, motion_s - self.motion_s))

    @property
    def left_over(self) -> int:
        """Samples, poses and chunks not accounted for."""
        return sum(abs(rest) for rest in unaccounted(self.service.balances()).values())

    @property
    def lost(self) -> int:
        """Packets lost on the way."""
        return sum(record.lost for record in self.service.pipeline.stream.modules.values())


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
                while (recovery_s := bench.watch.recovered_s(since_ns)) == float("inf"):
                    await asyncio.sleep(0.02)
                worst = max(worst, recovery_s)
                begun_rss = rss_mb() if cycle == 1 else begun_rss
            growth = rss_mb() - begun_rss
            return Outcome(f"unplugged {CYCLES} × for 0.3 s", worst, bench.lost, bench.left_over), growth


def rss_mb() -> float:
    """Resident memory of this process, MB."""
    gc.collect()
    return float(psutil.Process().memory_info().rss) / 2**20


class Broker:
    """mosquitto on a free port, which stays the same when it is killed and started again."""

    def __init__(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = int(probe.getsockname()[1])
        self._folder = tempfile.TemporaryDirectory()
        self._config = Path(self._folder.name) / "mosquitto.conf"
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\nset_tcp_nodelay true\nuser root\n"
        )
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, and wait until it listens."""
        command = [mosquitto_program(), "-c", str(self._config)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(500):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.005)
        raise SystemExit("mosquitto does not listen")

    def kill(self) -> None:
        """Kill it as a crash would."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> Broker:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self._folder.cleanup()
