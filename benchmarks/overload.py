"""Highest load held on one core, and what gives way beyond it.

The real pipeline, the real messages and the real ``LoadWatch``, in simulated time: a chunk is handled when it
has arrived and all before it are done, and takes as long as the processor took for it. What else runs on the
machine meanwhile does not matter. Every message is sent as a datagram, in the place of the broker's socket.
"""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass, replace

from benchmarks.figures import Figure, Report, table
from benchmarks.speed_growth import enlarged_suit
from devices.emulators.paced_writer import ticks
from devices.link import Chunk, Framing
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.contract.topics import Topics
from gateway.outputs.output import Thinning
from gateway.outputs.pose_encoding import PosePublications
from gateway.outputs.settings import MqttSettings, PoseFormat, PoseMap
from gateway.outputs.unity import VmcEncoder
from gateway.pipeline import LOAD_EVENT, Pipeline
from gateway.service.overload import SEGMENT_TOPICS, SHED, SIDE_OUTPUTS, LoadWatch
from gateway.sources.clock_mode import ClockMode
from gateway.stages.frame_assembler import AssemblyParams

LINK = "suit"
MODULES = (17, 34, 63)
RATES_HZ = (100, 200, 400, 600, 800, 1000, 1500, 2000, 3000)
SECONDS = 2.0
LONG_SECONDS = 8.0
SIDE_HZ, SEGMENT_HZ = 60.0, 20.0


@dataclass
class Outcome:
    """What became of one load."""

    stage: int
    lag_s: float
    busy: float
    """Processor time for a second of samples, without giving anything up; over 1 it cannot be held."""
    lost: int


class Machine:
    """One core that does nothing else."""

    def __init__(self, suit: WornSuit, rate_hz: float) -> None:
        interval_ns = 1e9 / rate_hz
        self.pipeline = Pipeline(
            suit,
            AssemblyParams(interval_ns, 30_000_000, 100_000_000, 500_000_000),
            clock_mode=ClockMode.SHARED,
        )
        self.pipeline.add_link(LINK, Framing.BYTE_STREAM)
        settings = MqttSettings(
            segment_rate=SEGMENT_HZ,
            pose_formats=frozenset(PoseFormat),
            include=frozenset({PoseMap.POSITION, PoseMap.SIGMA, PoseMap.ANGULAR_RATE}),
        )
        self._publications = PosePublications(settings, suit.skeleton, Topics("mocap", "lab"))
        self._side, self._side_thinning = VmcEncoder(load_rig("suit_17").skeleton), Thinning(SIDE_HZ)
        self._relief = Thinning(None)
        self.watch, self.now_s, self.worked_s = LoadWatch(), 0.0, 0.0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)

    def run(self, chunks: list[Chunk], *, sheds: bool) -> None:
        """Handle all of them, each as soon as it can be."""
        for chunk in chunks:
            arrived_s = chunk.arrived_ns * 1e-9
            self.now_s = max(self.now_s, arrived_s)
            begun = time.process_time_ns()
            self._handle(chunk)
            took_s = (time.process_time_ns() - begun) * 1e-9
            self.now_s += took_s
            self.worked_s += took_s
            if sheds and self.watch.observe(LINK, self.now_s - arrived_s, self.now_s):
                self._shed()
        self._socket.close()

    def _handle(self, chunk: Chunk) -> None:
        for frame in self.pipeline.feed(chunk):
            if self._relief.admits(frame.time_ns):
                for message in self._publications.of(frame):
                    self._send(message.payload)
            if self.watch.stage < SIDE_OUTPUTS and self._side_thinning.admits(frame.time_ns):
                first = {
                    name: getattr(frame, name)[:17]
                    for name in ("q_wb", "angular_rate", "joint_acceleration", "p_w", "sigma", "status")
                }
                for datagram in self._side.encode(replace(frame, **first)):
                    self._send(datagram)

    def _send(self, data: bytes) -> None:
        try:
            self._socket.sendto(data[:60_000], self._socket.getsockname())
            self._socket.recv(65536)
        except BlockingIOError:
            return  # the system has no room: nobody waits for it

    def _shed(self) -> None:
        holds = self.watch.holds
        self._relief = Thinning(holds.poses_hz)
        self._publications.has_segments = self.watch.stage < SEGMENT_TOPICS
        self.pipeline.event(LOAD_EVENT, {"solve_every": holds.solve_every})


def run() -> Report:
    """Per number of modules: the highest rate held, and the stages beyond it."""
    report, rows = Report("overload"), []
    for n in MODULES:
        suit = replace(enlarged_suit(load_rig("suit_17"), n), module_ids=tuple(range(n)))
        held = 0
        for rate_hz in RATES_HZ:
            found = outcome(suit, rate_hz)
            rows.append(_row(n, rate_hz, found))
            if found.stage == 0:
                held = rate_hz
            if found.stage == len(SHED) - 1:
                break
        note = f"{n} modules, nothing given up: all messages of a pose in JSON and MessagePack, segments, VMC"
        report.figures.append(Figure(f"held_{n}_modules_hz", held, "Hz", note=note))
        report.figures.append(
            Figure(f"held_{n}_modules_samples", n * held, "samples/s", note="the same, modules × rate")
        )
    heads = [
        "modules",
        "rate, Hz",
        "samples/s",
        "work, s/s",
        "gives up",
        "lag at the end, ms",
        "samples lost",
    ]
    text = (
        "## What gives way\n\nMethod `independent`, one core. Work: processor seconds for a second of "
        "samples, with nothing given up; beyond 1 a core cannot hold it. Given up: the stage that holds "
        f"after {LONG_SECONDS:g} s, with all before it, of: {', '.join(stage.name for stage in SHED[1:])}."
    )
    report.tables.append(f"{text}\n\n{table(heads, rows)}")
    return report


def outcome(suit: WornSuit, rate_hz: float) -> Outcome:
    """One load: its work, measured by itself, and what a machine gives up that has to hold it."""
    alone = Machine(suit, rate_hz)
    alone.run(_chunks(len(suit.module_ids), rate_hz, SECONDS), sheds=False)
    busy = alone.worked_s / SECONDS
    if busy < 0.8:
        return Outcome(0, 0.0, busy, _lost(alone))
    loaded = Machine(suit, rate_hz)
    loaded.run(_chunks(len(suit.module_ids), rate_hz, LONG_SECONDS), sheds=True)
    return Outcome(loaded.watch.stage, loaded.watch.lag_s, busy, _lost(loaded))


def _chunks(n_modules: int, rate_hz: float, seconds: float) -> list[Chunk]:
    data = ticks(n_modules, rate_hz, seconds)
    return [Chunk(tick, round((1.0 + k / rate_hz) * 1e9), LINK) for k, tick in enumerate(data)]


def _lost(machine: Machine) -> int:
    return sum(record.lost for record in machine.pipeline.stream.modules.values())


def _row(n: int, rate_hz: float, found: Outcome) -> list[str]:
    given = SHED[found.stage].name if found.stage else "nothing"
    figures = (f"{n * rate_hz:.0f}", f"{found.busy:.2f}", given, f"{found.lag_s * 1e3:.0f}", f"{found.lost}")
    return [f"{n}", f"{rate_hz:g}", *figures]
