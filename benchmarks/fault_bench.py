"""A running gateway with a faulty suit at its link and a broker that can be killed, to measure with."""

from __future__ import annotations

import asyncio
import gc
import socket
import subprocess
import tempfile
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil

from benchmarks.emulated_stream import suit_17
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

WHOLE_POSES = 10
"""So many whole poses in a row are a recovery; it counts from the first of them."""
REMEMBERED_POSES = 2000


class Watch:
    """An output that notes when poses were whole, the last of them."""

    def __init__(self) -> None:
        self.whole: deque[tuple[int, bool]] = deque(maxlen=REMEMBERED_POSES)
        self.on_pose: Callable[[SkeletonFrame], None] | None = None

    def offer(self, frame: SkeletonFrame) -> None:
        """Note the gateway time, and whether every segment rests on a sample younger than ``hold_ms``."""
        is_whole = bool(np.all(frame.status <= Status.HELD))
        self.whole.append((gateway_time_ns(), is_whole))
        if self.on_pose is not None:
            self.on_pose(frame)

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
        self.watch = Watch()
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
