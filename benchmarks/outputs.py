"""What outputs cost: processor time a pose, highest rates, and what a broker that freezes does to poses."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import icub_models
import psutil

from benchmarks import robot, slow_broker
from benchmarks.figures import Figure, Report, table
from benchmarks.synthetic_poses import INFO, RATE_HZ, frames_of, skeleton_of_size
from devices.emulators.local_broker import mosquitto
from gateway.contract.topics import Topics
from gateway.frames import SkeletonFrame
from gateway.outputs.mqtt import MqttOutput
from gateway.outputs.output import Output
from gateway.outputs.pose_encoding import PosePublications
from gateway.outputs.settings import MqttSettings, OutputsSettings
from gateway.outputs.side_outputs import SideOutputs
from gateway.outputs.subscriber import PoseSubscriber

SECONDS = 3.0
REPEATS = 3
FLOOD = 3000
FROZEN_S = 3.0
FRESH_MS = 50.0
_ICUB = icub_models.get_model_file("iCubGazeboV2_7")
_MQTT: dict[str, dict[str, Any]] = {
    "MQTT, JSON": {},
    "MQTT, MessagePack": {"pose_formats": ["msgpack"]},
    "MQTT, both": {"pose_formats": ["json", "msgpack"]},
    "MQTT, JSON and predicted": {"predict_ms": 20},
    "MQTT, JSON and segments at 20 Hz": {"segment_rate": 20},
}
_SIDE: dict[str, dict[str, Any]] = {
    "UDP JSON": {"udp_json": {"rate": 1000, "port": 9}},
    "VMC": {"vmc": {"rate": 1000, "port": 9}},
    "Foxglove, no client": {"foxglove": {"rate": 1000, "port": 0}},
    "ROS 2, no listener": {"ros2": {"rate": 1000, "router": "tcp/127.0.0.1:9"}},
    "OpenSim": {"opensim": {"rate": 1000, "port": 9}},
    "iCub, UDP": {"retarget": {"rate": 1000, "robot": "icub", "urdf": _ICUB, "udp": {"port": 9}}},
}
_OF_A_PERSON = ("VMC", "OpenSim", "iCub, UDP")


@dataclass(frozen=True)
class Cost:
    """Of one output at one size of body."""

    name: str
    n_segments: int
    us: float
    """Processor time a pose, without that of the clock that paces them."""
    bytes: int | None
    messages_per_s: float | None = None


@dataclass(frozen=True)
class Freeze:
    """Poses at 100 Hz through a broker that stood still for a while."""

    worst_ms: float
    fresh_after_ms: float
    offered: int
    dropped: int
    longest_offer_ms: float
    rss_growth_mb: float


def run() -> Report:
    """Costs at 17 and 64 segments, then the freeze."""
    with mosquitto() as (port, process):
        costs = asyncio.run(_costs(port))
        slow = asyncio.run(slow_broker.measure(port))
        freeze = asyncio.run(_freeze(port, process))
    report = Report("outputs")
    by_name = {(cost.name, cost.n_segments): cost for cost in costs}
    for n in (17, 64):
        for name, word in (("MQTT, JSON", "json"), ("MQTT, MessagePack", "msgpack")):
            cost = by_name[name, n]
            what = f"processor time of one pose of {n} segments, {name}, at {RATE_HZ:g} Hz"
            report.figures.append(Figure(f"{word}_{n}_us", cost.us, "µs", "", what))
            flood = cost.messages_per_s or 0.0
            what = f"messages of {n} segments in a row, {name}"
            report.figures.append(Figure(f"{word}_{n}_per_s", flood, "1/s", "", what))
    report.figures += [
        Figure(
            "frozen_broker_worst_ms", freeze.worst_ms, "ms", "", f"oldest pose, broker frozen {FROZEN_S:g} s"
        ),
        Figure("frozen_broker_fresh_ms", freeze.fresh_after_ms, "ms", "", "thaw → poses no older than 50 ms"),
        Figure(
            "frozen_broker_dropped", freeze.dropped, "", "", f"counted, of {freeze.offered} poses offered"
        ),
        Figure("frozen_broker_rss_mb", freeze.rss_growth_mb, "MB", "<=5", "growth of memory meanwhile"),
        Figure(
            "frozen_broker_offer_ms", freeze.longest_offer_ms, "ms", "", "longest time in offer() meanwhile"
        ),
    ]
    what = "processor time of one pose on iCub, 32 joints, over UDP"
    report.figures.append(Figure("robot_us", by_name["iCub, UDP", 17].us, "µs", "<=2000", what))
    report.figures += _slow_figures(slow)
    robots, rows = robot.figures()
    report.figures += robots
    report.tables = [_table(costs), *rows]
    return report


def _slow_figures(slow: slow_broker.Slow) -> list[Figure]:
    line = f"17 segments at {RATE_HZ:g} Hz, line to the broker of {slow_broker.BYTES_PER_S / 1e3:g} kB/s"
    counted = f"counted, of {slow.offered} poses offered, {slow.received} received; {line}"
    return [
        Figure("slow_broker_worst_ms", slow.worst_ms, "ms", "", f"oldest pose, {line}"),
        Figure("slow_broker_dropped", slow.dropped, "", "", counted),
        Figure("slow_broker_rss_mb", slow.rss_growth_mb, "MB", "<=5", "growth of memory meanwhile"),
    ]


def _table(costs: list[Cost]) -> str:
    rows = [
        [
            *(
                cost.name,
                str(cost.n_segments),
                "–" if cost.bytes is None else str(cost.bytes),
                f"{cost.us:.0f}",
            ),
            f"{cost.us * RATE_HZ * 1e-4:.1f}",
            "–" if cost.messages_per_s is None else f"{cost.messages_per_s:.0f}",
        ]
        for cost in costs
    ]
    heads = ["output", "segments", "bytes a pose", "CPU µs a pose", "CPU % at 100 Hz", "poses/s in a row"]
    return "## Cost of outputs (one receiver: the broker, or nobody)\n\n" + table(heads, rows)


async def _costs(port: int) -> list[Cost]:
    pacing_us = await _cost_us(_Nowhere(), frames_of(skeleton_of_size(17)))
    costs = []
    for n in (17, 64):
        frames = frames_of(skeleton_of_size(n))
        for name, more in _MQTT.items():
            settings = MqttSettings(port=port, queue_length=64, **more)
            async with MqttOutput(settings, skeleton_of_size(n), INFO) as output:
                while not output.is_connected:
                    await asyncio.sleep(0.01)
                us = await _cost_us(output, frames) - pacing_us
                per_s = await _flood(output, frames)
            publications = PosePublications(settings, skeleton_of_size(n), Topics("mocap", "bench"))
            second = [replace(frames(k), time_ns=round(k * 1e9 / RATE_HZ)) for k in range(round(RATE_HZ))]
            size = sum(len(each.payload) for frame in second for each in publications.of(frame)) // len(
                second
            )
            costs.append(Cost(name, n, us, size, per_s))
        for name, more in _SIDE.items():
            if name in _OF_A_PERSON and n != 17:
                continue  # avatars and robots have no more bones
            side = SideOutputs(OutputsSettings(**more), skeleton_of_size(n), "bench", RATE_HZ)
            async with side.running():
                costs.append(Cost(name, n, await _cost_us(side, frames) - pacing_us, None))
    return costs


class _Nowhere:
    def offer(self, frame: SkeletonFrame) -> None:
        """Nothing."""


async def _cost_us(output: Output, frames: Callable[[int], SkeletonFrame]) -> float:
    """Processor time of this process a pose, µs: the least of a few runs, the machine being shared."""
    found = []
    n_poses = round(SECONDS / REPEATS * RATE_HZ)
    for _ in range(REPEATS):
        before = time.process_time()
        for k in range(n_poses):
            output.offer(frames(k))
            await asyncio.sleep(1 / RATE_HZ)
        found.append((time.process_time() - before) / n_poses * 1e6)
    return min(found)


async def _flood(output: MqttOutput, frames: Callable[[int], SkeletonFrame]) -> float:
    """Poses a second that go out when there is always one waiting."""
    first = output.counters.published
    began = time.perf_counter()
    for k in range(FLOOD):
        output.offer(frames(k))
        while output.counters.queued > 8:
            await asyncio.sleep(0)
    while output.counters.queued:
        await asyncio.sleep(0)
    return (output.counters.published - first) / (time.perf_counter() - began)


async def _freeze(port: int, process: subprocess.Popen[bytes]) -> Freeze:
    settings = MqttSettings(port=port)
    frames = frames_of(skeleton_of_size(17))
    ages_ms: list[tuple[float, float]] = []  # (arrival, age)
    longest_ms = 0.0
    async with (
        MqttOutput(settings, skeleton_of_size(17), INFO) as output,
        PoseSubscriber(settings, "bench") as poses,
    ):

        async def collect() -> None:
            async for pose in poses:
                ages_ms.append((time.perf_counter(), pose.latency_s * 1e3))

        async def offer(seconds: float) -> None:
            nonlocal longest_ms
            for k in range(round(seconds * RATE_HZ)):
                frame = frames(k)
                began = time.perf_counter()
                output.offer(frame)
                longest_ms = max(longest_ms, (time.perf_counter() - began) * 1e3)
                await asyncio.sleep(1 / RATE_HZ)

        collecting = asyncio.create_task(collect())
        while not output.is_connected:
            await asyncio.sleep(0.01)
        await offer(1.0)
        rss = psutil.Process().memory_info().rss
        process.send_signal(signal.SIGSTOP)
        await offer(FROZEN_S)
        growth = psutil.Process().memory_info().rss - rss
        process.send_signal(signal.SIGCONT)
        thawed = time.perf_counter()
        await offer(2.0)
        await asyncio.sleep(0.3)
        collecting.cancel()
        counters = output.counters
    fresh = next(at for at, age in ages_ms if at > thawed and age < FRESH_MS)
    return Freeze(
        worst_ms=max(age for _, age in ages_ms),
        fresh_after_ms=(fresh - thawed) * 1e3,
        offered=counters.published + counters.dropped + counters.queued,
        dropped=counters.dropped,
        longest_offer_ms=longest_ms,
        rss_growth_mb=growth / 1e6,
    )
