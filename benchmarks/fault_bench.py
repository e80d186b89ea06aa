"""A running gateway with a faulty suit at its link and a broker that can be killed, to measure with."""

from __future__ import annotations

import asyncio
import gc
import signal
import socket
import subprocess
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from benchmarks.emulated_bus import EmulatedBus
from devices.emulators import IDEAL, EmulatedSuit, Encoding, SuitSettings, SuitTraffic
from devices.emulators.faults.fault_plan import FaultPlan
from devices.emulators.faults.faulty_suit import FaultySuit, pull_cable
from devices.emulators.local_broker import mosquitto_program
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.transports import PtyTransport
from devices.emulators.transports.transport import Transport
from devices.free_ports import free_port
from devices.link import Framing, gateway_time_ns
from gateway.body.rig import load_rig
from gateway.body.skeleton import LocalDevice, WornSuit
from gateway.contract.balances import unaccounted
from gateway.emulation.rig import dress, move
from gateway.emulation.simulation import suit_17
from gateway.frames import SkeletonFrame, Status, StatusArray
from gateway.service.service import Service
from gateway.settings import GatewaySettings
from gateway.support.memory import trim_heap

METHOD = "independent"
"""Reconstructor: what it costs is not at stake here."""
WHOLE_POSES = 10
"""So many whole poses in a row are a recovery; it counts from the first of them."""
REMEMBERED_POSES = 2000
LINK_LIMIT_S, BROKER_LIMIT_S, WHOLE_LIMIT_S = 1.0, 2.0, 1.0
"""Cable plugged in → poses whole; broker listens → pose out; any other fault over → poses whole."""
SAMPLES_LIMIT_S = 0.03
"""Three samples, between the end of a module's fault and the instant of the first pose that it is in."""


class Pose(NamedTuple):
    """What is kept of a pose."""

    at_ns: int
    """When it was offered to the outputs."""
    time_ns: int
    status: StatusArray


class Watch:
    """An output that keeps what tells of the last poses how whole they were."""

    def __init__(self) -> None:
        self.poses: deque[Pose] = deque(maxlen=REMEMBERED_POSES)
        self.on_pose: Callable[[SkeletonFrame], None] | None = None

    def offer(self, frame: SkeletonFrame) -> None:
        """Note the gateway time, the pose's instant, and its status."""
        self.poses.append(Pose(gateway_time_ns(), frame.time_ns, frame.status.copy()))
        if self.on_pose is not None:
            self.on_pose(frame)

    def recovered_s(self, since_ns: int) -> float:
        """Time to the first of ``WHOLE_POSES`` poses in a row; infinite: never.

        Every segment of such a pose rests on a sample younger than ``hold_ms``.
        """
        run: list[int] = []
        for pose in self.poses:
            if pose.at_ns >= since_ns:
                run = [*run, pose.at_ns] if np.all(pose.status <= Status.HELD) else []
                if len(run) == WHOLE_POSES:
                    return (run[0] - since_ns) * 1e-9
        return float("inf")

    def back_s(self, since_ns: int, segment: int) -> float:
        """From an instant to that of the first pose with a segment between two samples of its module."""
        for pose in self.poses:
            if pose.time_ns >= since_ns and pose.status[segment] <= Status.INTERPOLATED:
                return (pose.time_ns - since_ns) * 1e-9
        return float("inf")


class Outcome(NamedTuple):
    """What one fault did."""

    name: str
    recovery_s: float
    limit_s: float
    """Longest recovery that passes."""
    lost: dict[str, int]
    """Samples by what became of them, where they did not come, and poses and chunks likewise."""
    unaccounted: int
    note: str = ""
    """Why it could not be done."""

    @classmethod
    def not_done(cls, name: str, why: str) -> Outcome:
        """A fault that is not to be had here."""
        return cls(name, float("nan"), 0.0, {}, 0, why)

    @property
    def passes(self) -> bool:
        """In time, and everything accounted for."""
        return bool(self.note) or (self.recovery_s <= self.limit_s and not self.unaccounted)


class Wiring(NamedTuple):
    """A suit, and how it is connected to the gateway."""

    worn: WornSuit
    motion: BodyMotion
    settings: SuitSettings
    transport: Transport
    url: str
    """Of the gateway's link."""
    rig: str = "suit_17"
    silent: frozenset[int] = frozenset()
    """Modules that never say anything."""

    @classmethod
    def of_rig(cls, folder: Path, rig: str, silent: frozenset[int] = frozenset()) -> Wiring:
        """A shipped rig, modules of which may be silent, through a relay and a pseudo-terminal."""
        worn = load_rig(rig)
        motion = move(dress(worn), worn.skeleton.name, seed=1)
        port = folder / "suit"
        settings = SuitSettings(has_relay=True)
        return cls(worn, motion, settings, PtyTransport(port), str(port), rig, silent)

    @classmethod
    def by_cable(cls, folder: Path, local: Sequence[LocalDevice] = ()) -> Wiring:
        """17 modules, and ``local`` devices, through a relay and a pseudo-terminal in the folder."""
        worn, motion = suit_17()
        if local:
            worn = replace(worn, local_devices=tuple(local))
            motion = move(dress(worn), worn.skeleton.name, seed=1)
        port = folder / "suit"
        return cls(worn, motion, SuitSettings(has_relay=True), PtyTransport(port), str(port))

    @classmethod
    def by_bus(cls, bus: EmulatedBus) -> Wiring:
        """The same 17 modules on a CAN FD bus."""
        worn, motion = suit_17()
        return cls(worn, motion, SuitSettings(encoding=Encoding(Framing.CAN, is_fd=True)), bus, bus.url)


class Bench:
    """A running service with a faulty suit at its link."""

    def __init__(
        self,
        port: int,
        plan: FaultPlan,
        folder: Path,
        recordings: Path | None = None,
        wiring: Wiring | None = None,
    ) -> None:
        """port: of the broker; recordings: folder for them, on whatever disk; wiring: by cable, if none."""
        wiring = wiring or Wiring.by_cable(folder)
        traffic = SuitTraffic(wiring.motion, wiring.settings, IDEAL, seed=1)
        self.faulty = FaultySuit(traffic, plan)
        spoil = self.faulty.sensors.spoil
        traffic.on_sent = lambda module, sent: [] if module in wiring.silent else spoil(module, sent)
        self.plan = plan
        self.suit = EmulatedSuit(self.faulty, wiring.transport)
        settings = GatewaySettings.model_validate(
            {
                "links": [{"name": "suit", "url": wiring.url}],
                "rig": wiring.rig,
                "reconstructor": METHOD,
                "mqtt": {"port": port},
                "recording": {"folder": str(recordings or folder / "recordings"), "min_free_mb": 0},
            }
        )
        self.service = Service(settings, wiring.worn)
        self.watch = Watch()
        self.service._outputs = (*self.service._outputs, self.watch)  # type: ignore[assignment]
        self._tasks: list[asyncio.Task[None]] = []
        self._lost_before: Counter[str] = Counter()

    async def __aenter__(self) -> Bench:
        self._tasks = [
            asyncio.create_task(self.suit.run(), name="suit"),
            asyncio.create_task(pull_cable(self.plan, self.suit), name="cable"),
            asyncio.create_task(self.service.run(), name="gateway"),
        ]
        while self.suit.start_ns is None:
            await asyncio.sleep(0.01)
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    @property
    def failures(self) -> dict[str, str]:
        """Why the suit, the cable or the gateway has ended before its time, by these names."""
        ended = [task for task in self._tasks if task.done() and not task.cancelled()]
        return {task.get_name(): repr(error) for task in ended if (error := task.exception()) is not None}

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

    def segment_of(self, module: int) -> int:
        """The segment that a module is on."""
        suit = self.service.pipeline.suit
        return int(np.flatnonzero(suit.module_of_segment == suit.module_ids.index(module))[0])

    @property
    def now_ns(self) -> int:
        """Gateway time."""
        return gateway_time_ns()

    def begin(self) -> None:
        """What is lost from now on counts as the fault's."""
        self._lost_before = self._lost()

    def outcome(self, name: str, recovery_s: float, limit_s: float) -> Outcome:
        """With the losses since ``begin``."""
        lost = self._lost()
        lost.subtract(self._lost_before)
        nonzero = {what: count for what, count in lost.items() if count}
        return Outcome(name, recovery_s, limit_s, nonzero, self.left_over)

    def _lost(self) -> Counter[str]:
        lost: Counter[str] = Counter()
        for balance in self.service.balances():
            if balance.name in _OF_LOSSES:
                lost.update({p: n for p, n in balance.parts.items() if (balance.name, p) not in _NO_LOSS})
        return lost


_OF_LOSSES = frozenset({"samples_sent", "readings", "output_mqtt", "recorded_chunks"})
_NO_LOSS = frozenset(
    {
        ("samples_sent", "received"),
        ("readings", "taken"),
        ("output_mqtt", "published"),
        ("output_mqtt", "queued"),
        ("recorded_chunks", "written"),
        ("recorded_chunks", "waiting"),
    }
)


def rss_mb() -> float:
    """Resident memory of this process in use, MB.

    What a burst has left free within the heap is first given back to the system, as the gateway itself does
    every half minute: else the figure says how long ago that was.
    """
    gc.collect()
    trim_heap()
    return float(psutil.Process().memory_info().rss) / 2**20


class Broker:
    """mosquitto on a free port, which stays the same when it is killed and started again."""

    def __init__(self) -> None:
        self.port = free_port()
        self._folder = tempfile.TemporaryDirectory()
        self._config = Path(self._folder.name) / "mosquitto.conf"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, is_open: bool = True) -> None:
        """Start it, and wait until it listens. is_open: to whoever comes, without a name."""
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous {str(is_open).lower()}\n"
            "set_tcp_nodelay true\nuser root\n"
        )
        command = [mosquitto_program(), "-c", str(self._config)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(500):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.005)
        raise SystemExit("mosquitto does not listen")

    def freeze(self) -> None:
        """Stop its process."""
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it go on."""
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        if self._process is not None:
            self._process.send_signal(number)

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
