"""Recording: what it costs, that it loses nothing, what a kill costs, and that replay gives the same bits.

``python -m benchmarks.record --seconds 600`` records for ten minutes rather than for ``SECONDS``.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from benchmarks.emulated_recording import FLUSH_MS, write_session
from benchmarks.figures import Figure, Report, table
from benchmarks.latency import await_online, begin, line_of, process_of, write_config
from devices.emulators.imperfections import TYPICAL
from devices.emulators.local_broker import mosquitto
from devices.emulators.paced_writer import ticks
from devices.link import Framing
from gateway.contract.ros_messages import BodyTransforms
from gateway.emulation.simulation import relay_chunks, suit_17
from gateway.outputs.settings import MqttSettings
from gateway.outputs.subscriber import PoseSubscriber
from gateway.pipeline import Pipeline
from gateway.recording import open_recording
from gateway.recording.files import Contents, SessionFiles
from gateway.recording.snapshot import attachments_of
from gateway.recording.solving import verify
from gateway.settings import GatewaySettings, RecordingSettings
from gateway.sources.link_settings import LinkSettings

SECONDS = 30.0
KILLS = 50
N_MODULES, RATE_HZ = 17, 100.0
REPLAYED_S = 20.0
METHODS = ("independent", "articulated")
REPEATS = 3


@dataclass(frozen=True)
class Live:
    """A gateway process that records and publishes a suit of 17 modules at 100 Hz."""

    cpu_percent: float
    missing_bytes: int
    """Written by the suit and not in the recording."""
    poses: int
    is_identical: bool


@dataclass(frozen=True)
class Emulated:
    """A recording of an emulated suit with noise, loss and jitter."""

    is_identical: bool
    """Twice."""
    mb_per_minute: float
    mb_per_minute_raw: float
    """What the links gave, uncompressed and without poses."""
    writing_percent: float
    """CPU time of encoding, compressing and writing it, of the time it lasted."""
    transforms_percent: float
    """The same of the channel that viewers read, in addition."""


def run(seconds: float = SECONDS, kills: int = KILLS) -> Report:
    """All of it; ``seconds`` for the run of the gateway."""
    with mosquitto() as (port, _):
        live = asyncio.run(_gateway(port, seconds))
    losses_ms = np.array([_kill(moment) for moment in _moments(kills)])
    emulated = {method: _emulated(method) for method in METHODS}
    usual = emulated[METHODS[0]]
    identical = all(each.is_identical for each in emulated.values()) and live.is_identical
    what = f"17 × 100 Hz, {seconds:g} s, publishing"
    report = Report("record")
    report.figures = [
        Figure(
            "record_cpu_percent", live.cpu_percent, "%", "", f"of one core, whole gateway process, {what}"
        ),
        Figure("record_writing_percent", usual.writing_percent, "%", "<=5", "of one core, writing alone"),
        Figure(
            "record_transforms_percent",
            usual.transforms_percent,
            "%",
            "<=2",
            "of one core, the channel `/tf` for viewers",
        ),
        Figure(
            "record_mb_per_minute", usual.mb_per_minute, "MB", "", "17 × 100 Hz with noise, poses included"
        ),
        Figure(
            "record_missing_bytes", live.missing_bytes, "B", "<=0", f"of the suit, not in the file; {what}"
        ),
        Figure(
            "kill_loss_ms_max", losses_ms.max(), "ms", f"<={FLUSH_MS:g}", f"{kills} kills at random moments"
        ),
        Figure(
            "replay_identical", float(identical), "", ">=1", "1: every recorded pose comes out bit for bit"
        ),
    ]
    rows = [
        [method, "yes" if e.is_identical else "no", f"{e.mb_per_minute:.1f}", f"{e.mb_per_minute_raw:.1f}"]
        for method, e in emulated.items()
    ]
    heads = ["method", "replayed twice identically", "MB a minute", "raw bytes, MB a minute"]
    report.tables = [f"## Emulated suit, {REPLAYED_S:g} s with loss and jitter\n\n" + table(heads, rows)]
    return report


async def _gateway(broker_port: int, seconds: float) -> Live:
    """One process, measured while the suit speaks."""
    with tempfile.TemporaryDirectory() as folder:
        suit_port = Path(folder) / "suit"
        config = write_config(Path(folder), suit_port, broker_port, N_MODULES)
        settings = yaml.safe_load(config.read_text())
        settings["recording"] = {"folder": f"{folder}/kept", "min_free_mb": 100, "flush_ms": FLUSH_MS}
        config.write_text(yaml.safe_dump(settings))
        arguments = (str(suit_port), str(N_MODULES), str(RATE_HZ), str(seconds))
        writer = ("-m", "devices.emulators.paced_writer", *arguments)
        async with process_of(*writer) as suit:
            await line_of(suit)
            async with process_of("-m", "gateway", "record", "--quiet", "-c", str(config)) as process:
                cpu_percent = await _cpu_percent(suit, process, broker_port, seconds)
                process.send_signal(signal.SIGINT)
                await process.wait()
        (path,) = (Path(folder) / "kept").iterdir()
        recording = open_recording(path)
        raw = sum(len(chunk.data) for chunk in recording.chunks())
        found = verify(recording)
    written = sum(map(len, ticks(N_MODULES, RATE_HZ, seconds)))
    return Live(cpu_percent, abs(written - raw), found.compared, found.is_identical)


async def _cpu_percent(
    suit: asyncio.subprocess.Process, gateway: asyncio.subprocess.Process, broker_port: int, seconds: float
) -> float:
    async with PoseSubscriber(MqttSettings(port=broker_port), "bench") as poses:
        await await_online(poses)
    process = begin(suit, gateway)
    await asyncio.sleep(1.0)
    before, begun = sum(process.cpu_times()[:2]), time.monotonic()
    await asyncio.sleep(seconds - 2.0)
    cpu_percent = (sum(process.cpu_times()[:2]) - before) / (time.monotonic() - begun) * 100
    await line_of(suit)
    await asyncio.sleep(1.0)
    return cpu_percent


def _moments(kills: int) -> list[float]:
    """When to kill, s after the first byte: anywhere within some flush intervals."""
    seeded = random.Random(17)
    return [seeded.uniform(0.3, 1.3) for _ in range(kills)]


def _kill(moment_s: float) -> float:
    """How much a kill at that moment costs, ms: from the newest chunk in the file to the kill."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "benchmarks.recording_child", folder, str(FLUSH_MS)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            path = Path(child.stdout.readline().strip())
            time.sleep(moment_s)
            killed_utc_ns = time.time_ns()
            child.kill()
        recording = open_recording(path)
        newest = [chunk.arrived_ns for chunk in recording.chunks()][-1]
        newest_utc_ns = newest - recording.meta.begun_ns + recording.meta.begun_utc_ns
    return (killed_utc_ns - newest_utc_ns) * 1e-6


def _emulated(method: str) -> Emulated:
    """Record an imperfect suit's stream and its poses, flushed as live; recompute them twice."""
    suit, motion = suit_17()
    settings = GatewaySettings(
        links=[LinkSettings(name="suit", url="/dev/null")], rig="suit_17", reconstructor=method
    )
    pipeline = Pipeline.from_settings(settings, suit)
    pipeline.add_link("suit", Framing.BYTE_STREAM)
    chunks = relay_chunks(motion, REPLAYED_S, imperfections=TYPICAL)
    handled = [(chunk, pipeline.feed(chunk)) for chunk in chunks]
    contents = Contents({"suit": Framing.BYTE_STREAM}, attachments_of(settings, suit), "bench", True)
    with tempfile.TemporaryDirectory() as folder:
        kept = RecordingSettings(folder=folder, min_free_mb=1, warn_free_mb=1)
        plain_s, viewable_s = [], []
        for _ in range(REPEATS):
            for cpu_s, transforms in ((viewable_s, BodyTransforms(suit.skeleton)), (plain_s, None)):
                files = SessionFiles(kept, contents)
                begun = time.process_time()
                write_session(files, handled, transforms)
                cpu_s.append(time.process_time() - begun)
        recording = open_recording(files.path)
        minutes = REPLAYED_S / 60
        return Emulated(
            is_identical=all(verify(recording).is_identical for _ in range(2)),
            mb_per_minute=recording.meta.size / 1e6 / minutes,
            mb_per_minute_raw=sum(len(chunk.data) for chunk in chunks) / 1e6 / minutes,
            writing_percent=100 * min(plain_s) / REPLAYED_S,
            transforms_percent=100 * (min(viewable_s) - min(plain_s)) / REPLAYED_S,
        )


def main() -> None:
    """The suite by itself, as long as wanted."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.record", description=__doc__)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of the run of the gateway")
    parser.add_argument("--kills", type=int, default=KILLS)
    arguments = parser.parse_args()
    for figure in run(arguments.seconds, arguments.kills).figures:
        print(figure.line(), flush=True)


if __name__ == "__main__":
    main()
