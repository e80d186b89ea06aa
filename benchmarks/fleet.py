"""A hundred light gateways before three brokers: nodes that fail, and what more suits need."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import signal
import statistics
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import aiomqtt
import orjson
import psutil

from benchmarks.figures import Figure, Report, table
from gateway.contract import topics
from gateway.fleet.cluster import NODES, READER, Node
from gateway.fleet.demonstration import DemoFleet, DemonstrationPlan
from gateway.fleet.overview import Fleet, listener, take_into
from gateway.outputs.connection import broker_connection, unique_identifier

GATEWAYS = int(os.environ.get("FLEET_GATEWAYS", "100"))
"""Fewer where the machine is wanted for other things: the tables say how many there were."""
RATES_HZ = (10, 25, 50)
HELD = 0.97
"""Of the rate asked for, that a machine must reach to have held it."""
_LONGEST_START_S = 90.0
SETTLE_S = 4.0
STEADY_S = 8.0
AWAY_S = 8.0
SUIT_HZ = 100.0
SUIT_BYTES = 1600
_DAY_S = 8 * 3600


@dataclass
class ReceivedPoses:
    """Every pose that came, by gateway: live ones as the overview counts them."""

    fleet: Fleet
    live: dict[str, set[int]] = field(default_factory=dict)
    late: dict[str, set[int]] = field(default_factory=dict)
    arrivals: dict[str, list[float]] = field(default_factory=dict)
    repeated: int = 0
    """Poses that were counted as live though their number had been."""
    overflowed: int = 0
    """Messages that came faster than the reader took them."""

    def take(self, message: aiomqtt.Message) -> None:
        """For ``listen``."""
        name, _, below = message.topic.value.partition("/")[2].partition("/")
        before = self._counted(name)
        take_into(self.fleet)(message)
        if below == topics.POSE and self._counted(name) > before:
            numbers, seq = self.live.setdefault(name, set()), _seq(message.payload)
            self.repeated += seq in numbers
            numbers.add(seq)
            self.arrivals.setdefault(name, []).append(time.monotonic())
        elif below == topics.LATE_POSE:
            self.late.setdefault(name, set()).add(_seq(message.payload))

    def _counted(self, name: str) -> int:
        """Return how many live poses of a gateway the overview has counted."""
        seen = self.fleet.gateways.get(name)
        return 0 if seen is None else seen.received

    def missing(self) -> tuple[int, int]:
        """Poses between the first and the last live one that did not come live, and not late either."""
        live = late = 0
        for name, numbers in self.live.items():
            lost = set(range(min(numbers), max(numbers))) - numbers
            live += len(lost)
            late += len(lost - self.late.get(name, set()))
        return live, late

    def longest_gaps(self, since_s: float) -> list[float]:
        """Of each gateway since an instant, s."""
        found = []
        for instants in self.arrivals.values():
            recent = [since_s, *(each for each in instants if each >= since_s), time.monotonic()]
            found.append(max((b - a for a, b in itertools.pairwise(recent)), default=0.0))
        return found


def _seq(payload: object) -> int:
    assert isinstance(payload, bytes)
    return int(payload.split(b'"seq":', 1)[1].split(b",", 1)[0])


def run() -> Report:
    """Rates that the machine holds, then what becomes of a fleet whose nodes fail."""
    report = Report("fleet", also="guide/fleet.md")
    rate_hz, load = _held_rate(report)
    _failures(report, rate_hz)
    _arithmetic(report, load)
    return report


@dataclass(frozen=True)
class _Load:
    """What poses cost, per pose."""

    broker_s: float
    gateway_s: float
    memory_mb: float


def _held_rate(report: Report) -> tuple[float, _Load]:
    """Measure each rate; return the highest that was held, and what a pose cost at it."""
    rows, best, load = [], float(RATES_HZ[0]), _Load(0, 0, 0)
    for rate_hz in RATES_HZ:
        load_before = os.getloadavg()[0]
        with (
            tempfile.TemporaryDirectory() as folder,
            DemoFleet(Path(folder), DemonstrationPlan(GATEWAYS, rate_hz)) as fleet,
        ):
            received = ReceivedPoses(Fleet())
            reached, delay_ms, spent = asyncio.run(_steady(fleet, received))
        is_held = reached >= HELD * rate_hz
        missing, _ = received.missing()
        per_pose = _Load(spent.broker_s, spent.gateway_s, spent.memory_mb)
        if is_held or rate_hz == RATES_HZ[0]:
            best, load = float(rate_hz), per_pose
        rows.append(
            [
                str(rate_hz),
                f"{load_before:.1f}",
                f"{reached:.1f}",
                "yes" if is_held else "no",
                str(missing),
                f"{delay_ms:.0f}",
                f"{spent.broker_s * 1e6:.0f}",
                f"{spent.gateway_s * 1e6:.0f}",
                f"{spent.memory_mb:.0f}",
            ]
        )
        if not is_held:
            break
    heads = ["Hz asked for", "load before", "Hz reached", "held", "lost", "median delay, ms"]
    heads += ["brokers, µs a pose", "light gateway, µs a pose", "a broker, MB"]
    report.tables.append(f"## {GATEWAYS} light gateways, three brokers, one reader\n\n" + table(heads, rows))
    report.figures.append(Figure("fleet_rate_held", best, "Hz", "", f"each of {GATEWAYS} gateways"))
    return best, load


async def _steady(fleet: DemoFleet, received: ReceivedPoses) -> tuple[float, float, _Load]:
    """Return the median rate, the median delay (ms) and what a pose cost."""
    async with _listening(fleet, received):
        await _until_all_publish(received)
        before, counted = _spent(fleet), {name: len(numbers) for name, numbers in received.live.items()}
        begun = time.monotonic()
        await asyncio.sleep(STEADY_S)
        elapsed, after = time.monotonic() - begun, _spent(fleet)
        counts = [len(received.live.get(name, ())) - counted.get(name, 0) for name in fleet.names]
        delays = [row.delay_ms for row in received.fleet.rows(time.monotonic()) if row.delay_ms is not None]
        poses = max(sum(counts), 1)
        memory = max(psutil.Process(node.pid).memory_info().rss for node in fleet.cluster.nodes) / 1e6
        load = _Load((after[0] - before[0]) / poses, (after[1] - before[1]) / poses, memory)
        return statistics.median(counts) / elapsed, statistics.median(delays or [0.0]), load


async def _until_all_publish(received: ReceivedPoses) -> None:
    """Raises ``TimeoutError``."""
    async with asyncio.timeout(_LONGEST_START_S):
        while len(received.live) < GATEWAYS:
            await asyncio.sleep(0.2)
    await asyncio.sleep(SETTLE_S)


def _spent(fleet: DemoFleet) -> tuple[float, float]:
    """Processor time of the brokers and of the light gateways so far, s."""
    brokers = [node.pid for node in fleet.cluster.nodes]
    return _processor_s(brokers), _processor_s([process.pid for process in fleet.processes])


def _processor_s(pids: list[int]) -> float:
    return sum(sum(psutil.Process(pid).cpu_times()[:2]) for pid in pids)


@contextlib.asynccontextmanager
async def _listening(fleet: DemoFleet, received: ReceivedPoses) -> AsyncIterator[None]:
    """Have a reader hear all, for as long as the block lasts."""
    receiver = listener(fleet.settings(READER, 1), received.take)
    task = asyncio.create_task(receiver.run())
    await receiver.subscribed.wait()
    try:
        yield
    finally:
        received.overflowed += receiver.dropped
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def _failures(report: Report, rate_hz: float) -> None:
    rows: list[list[str]] = []
    load = os.getloadavg()[0]
    wanted = DemonstrationPlan(GATEWAYS, rate_hz, is_cuttable=True)
    with tempfile.TemporaryDirectory() as folder, DemoFleet(Path(folder), wanted) as fleet:
        worst, received, unreceived, right = asyncio.run(_broken(fleet, rows))
        died = asyncio.run(_kill_a_worker(fleet))
    heads = [
        "what happened",
        "longest gap of a gateway, s",
        "median of all, s",
        "missing live",
        "and not late",
    ]
    note = f"{GATEWAYS} gateways at {rate_hz:g} Hz; load before {load:.1f}"
    report.tables.append(
        f"## A node fails\n\n{note}. One node is killed, frozen, cut off from the others (its gateways and "
        "readers reach it still), slow. A reader whose own node dies misses what was on its way to it: it "
        "comes by QoS 0, and its gateways know nothing of it.\n\n" + table(heads, rows)
    )
    report.figures += [
        *_gap_figures(worst),
        *_pose_figures(received, unreceived),
        Figure("fleet_retained_wrong", float(right), "topics", "<=0", "state and body, each node asked"),
        Figure("fleet_wills_missing", float(died), "topics", "<=0", "gateways killed, not offline on a node"),
    ]


def _gap_figures(worst: Mapping[str, float]) -> list[Figure]:
    """Return the longest gap of any gateway after each failure."""
    return [
        Figure("fleet_recover_kill", worst["killed"], "s", "<=2", "longest gap of any gateway, node killed"),
        Figure(
            "fleet_recover_reader", worst["the reader's own killed"], "s", "<=2", "the reader's node killed"
        ),
        Figure(
            "fleet_recover_frozen", worst["frozen"], "s", "<=2", "the same, node silent, connections open"
        ),
        Figure("fleet_recover_cut", worst["cut off"], "s", "<=2", "the same, node cut off from the others"),
        Figure("fleet_recover_slow", worst["slow"], "s", "<=2", "the same, node halted for half of the time"),
        Figure(
            "fleet_recover_reader_cut",
            worst["the reader's own cut off"],
            "s",
            "",
            "the reader's node cut off: it must subscribe at another one, while the cluster chooses a leader",
        ),
    ]


def _pose_figures(received: ReceivedPoses, unreceived: int) -> list[Figure]:
    """Return what became of the poses, over all failures. unreceived: neither live nor late."""
    live, _ = received.missing()
    total = sum(len(numbers) for numbers in received.live.values())
    overtaken = sum(seen.repeated for seen in received.fleet.gateways.values())
    both = sum(len(numbers & received.late.get(name, set())) for name, numbers in received.live.items())
    return [
        Figure("fleet_missing_live", float(live), "poses", "", f"of {total}, all failures together"),
        Figure(
            "fleet_missing_for_ever",
            float(unreceived),
            "poses",
            "<=0",
            "neither live nor late",
        ),
        Figure("fleet_counted_twice", float(received.repeated), "poses", "<=0", "live poses of one number"),
        Figure(
            "fleet_reader_overflowed",
            float(received.overflowed),
            "messages",
            "<=0",
            "too fast for the reader",
        ),
        Figure(
            "fleet_overtaken",
            float(overtaken),
            "poses",
            "",
            "live, after newer ones or twice, from a node that thawed or was cut off: left out",
        ),
        Figure(
            "fleet_live_and_late", float(both), "poses", "", "late ones whose number came live: told by seq"
        ),
    ]


async def _broken(
    fleet: DemoFleet, rows: list[list[str]]
) -> tuple[dict[str, float], ReceivedPoses, int, int]:
    received, worst = ReceivedPoses(Fleet()), dict[str, float]()
    first, readers, last = fleet.cluster.nodes

    async def act_and_count(what: str, act: Callable[[], None], seconds: float) -> None:
        before = received.missing()
        since = time.monotonic()
        act()
        await asyncio.sleep(seconds)
        gaps = received.longest_gaps(since)
        worst[what.split(",", maxsplit=1)[0]] = max(gaps)
        after = received.missing()
        rows.append(
            [
                what,
                f"{max(gaps):.2f}",
                f"{statistics.median(gaps):.2f}",
                str(after[0] - before[0]),
                str(after[1] - before[1]),
            ]
        )

    async with _listening(fleet, received):
        await _until_all_publish(received)
        await act_and_count("nothing, for comparison", lambda: None, STEADY_S)
        # First of all: gateways leave a node that dies, and one without gateways is not missed.
        assert fleet.cluster.routes is not None
        routes = fleet.cluster.routes
        await act_and_count("cut off, from the other nodes", lambda: routes.cut(0), AWAY_S)
        await act_and_count("mended", lambda: routes.cut(None), AWAY_S)
        slow = threading.Thread(target=_slow, args=(first, AWAY_S))
        await act_and_count("slow, halted for 0.2 s of every 0.4 s", slow.start, AWAY_S)
        await asyncio.to_thread(slow.join)
        await act_and_count("killed, with SIGKILL", first.kill, AWAY_S)
        await act_and_count("brought back", first.start, AWAY_S)
        await act_and_count(
            "frozen, as behind a cut cable", lambda: os.kill(last.pid, signal.SIGSTOP), AWAY_S
        )
        await act_and_count("thawed", lambda: os.kill(last.pid, signal.SIGCONT), AWAY_S)
        await act_and_count("nothing, for what is late", lambda: None, AWAY_S)
        _, unreceived = received.missing()
        await act_and_count("the reader's own killed", readers.kill, AWAY_S)
        await act_and_count("the reader's own brought back", readers.start, AWAY_S)
        there = fleet.cluster.nodes.index(readers)
        await act_and_count("the reader's own cut off", lambda: routes.cut(there), AWAY_S)
        await act_and_count("the reader's own mended", lambda: routes.cut(None), AWAY_S)
    wrong = 0
    for first in range(NODES):
        kept = await _retained(fleet, first)
        wrong += sum(kept.get(f"{name}/{topics.BRIDGE_STATE}") != "online" for name in fleet.names)
        wrong += sum(f"{name}/{topics.BODY}" not in kept for name in fleet.names)
    return worst, received, unreceived, wrong


def _slow(node: Node, seconds: float) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        os.kill(node.pid, signal.SIGSTOP)
        time.sleep(0.2)
        os.kill(node.pid, signal.SIGCONT)
        time.sleep(0.2)


async def _retained(fleet: DemoFleet, first: int) -> dict[str, str]:
    """Return what one node keeps: the state of each gateway, and that it has a body."""
    settings, kept = fleet.settings(READER, first), dict[str, str]()
    async with broker_connection(settings, settings.port, unique_identifier("bench")) as client:
        await client.subscribe([(f"mocap/+/{topic}", 0) for topic in (topics.BRIDGE_STATE, topics.BODY)])
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(4):
                async for message in client.messages:
                    content = orjson.loads(message.payload)
                    kept[message.topic.value.partition("/")[2]] = str(content.get("state"))
    return kept


async def _kill_a_worker(fleet: DemoFleet) -> int:
    """Kill the gateways of one process; return how many of them a node does not tell as offline."""
    fleet.processes[0].kill()
    await asyncio.sleep(10)
    killed = fleet.names[:25]
    wrong = 0
    for first in range(NODES):
        kept = await _retained(fleet, first)
        wrong += sum(kept.get(f"{name}/{topics.BRIDGE_STATE}") != "offline" for name in killed)
    return wrong


def _arithmetic(report: Report, load: _Load) -> None:
    """What more suits need, from what a pose cost here."""
    rows = []
    for suits in (100, 1000, 10_000):
        poses = suits * SUIT_HZ
        rows.append(
            [
                str(suits),
                f"{poses:.0f}",
                f"{poses * SUIT_BYTES * 8e-6:.0f}",
                f"{poses * load.broker_s:.1f}",
                f"{poses * SUIT_BYTES * _DAY_S / 1e9:.0f}",
                str(4 * suits),
            ]
        )
    heads = [
        "suits at 100 Hz",
        "poses/s",
        "Mbit/s in",
        "cores of brokers",
        "GB of JSON in 8 h",
        "connections",
    ]
    report.tables.append(
        "## What more suits need\n\n"
        f"poses/s = suits × {SUIT_HZ:g}; Mbit/s = poses/s × {SUIT_BYTES} B × 8 / 10⁶, and as much again for "
        "each reader of all; cores = poses/s × processor time of all brokers a pose as measured above "
        f"({load.broker_s * 1e6:.0f} µs, one reader); connections = suits × 4 (state, requests, poses, "
        "standing by). On paper: not more than the rate above was run.\n\n" + table(heads, rows)
    )
