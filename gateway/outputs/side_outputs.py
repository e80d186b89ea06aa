"""All outputs beside MQTT, as configured. They send the newest pose and never wait."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Callable
from typing import Any, NamedTuple, Protocol

from gateway.body.joint_angles import JointAngles
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import OutputCounters, describe_body
from gateway.frames import SkeletonFrame
from gateway.outputs.datagrams import DatagramSink
from gateway.outputs.foxglove import FoxgloveSink
from gateway.outputs.lsl import LslSink
from gateway.outputs.mvn import MvnEncoder
from gateway.outputs.opensim import OpenSimEncoder
from gateway.outputs.output import Thinning
from gateway.outputs.pose_encoding import PoseEncoder
from gateway.outputs.retarget import Beside, RetargetSink
from gateway.outputs.ros2 import Ros2Sink
from gateway.outputs.settings import MvnSettings, OutputsSettings, PoseMap, UdpJsonSettings
from gateway.outputs.slimevr import SlimevrSink
from gateway.outputs.stream_sink import StreamSink
from gateway.outputs.unity import VmcEncoder

_log = logging.getLogger(__name__)


class Sink(Protocol):
    """Where poses go. Nothing here waits for whoever reads them."""

    async def open(self) -> None:
        """Open what poses go to. Raises ``OutputError``."""

    def send(self, frame: SkeletonFrame) -> bool:
        """Send a frame; return whether the system took all of it. May raise ``OSError``."""

    def close(self) -> None:
        """Free what it holds."""
        ...


class LatestOutput:
    """An ``Output`` in front of a sink. Belongs to one event loop.

    name: in the counters and the log; rate: most poses a second.
    """

    def __init__(self, name: str, sink: Sink, rate: float) -> None:
        self.name = name
        self.is_paused = False
        """Frames offered meanwhile count as thinned."""
        self._sink = sink
        self._thinning = Thinning(rate)
        self._waiting: SkeletonFrame | None = None
        self._is_running = False
        self._published = self._dropped = self._thinned = 0
        self._has_complained = False
        self._is_open = False

    @property
    def is_waiting(self) -> bool:
        """Whether a pose is to be sent at the next turn of the event loop."""
        return self._waiting is not None and self._is_running

    @property
    def counters(self) -> OutputCounters:
        """What became of the offered poses so far."""
        return OutputCounters(
            published=self._published,
            dropped=self._dropped,
            thinned=self._thinned,
            queued=int(self._waiting is not None),
        )

    def offer(self, frame: SkeletonFrame) -> None:
        """Take a frame. Never waits; one that still waits gives way."""
        if self.is_paused or not self._thinning.admits(frame.time_ns):
            self._thinned += 1
            return
        if self._waiting is not None:
            self._dropped += 1
        elif self._is_running:
            asyncio.get_running_loop().call_soon(self._send_waiting)
        self._waiting = frame

    async def open(self) -> None:
        """Open the sink; does nothing for the second time. Raises ``OutputError``."""
        if not self._is_open:
            await self._sink.open()
            self._is_open = True

    async def start(self) -> None:
        """Begin. Raises ``OutputError`` when the sink cannot be opened."""
        await self.open()
        self._is_running = True
        self._send_waiting()

    async def stop(self) -> None:
        """End, begun or not; what still waits is dropped."""
        self._is_running = False
        self._sink.close()
        self._is_open = False

    def _send_waiting(self) -> None:
        if self._is_running and self._waiting is not None:
            frame, self._waiting = self._waiting, None
            self._send(frame)

    def _send(self, frame: SkeletonFrame) -> None:
        try:
            is_sent = self._sink.send(frame)
        except Exception as error:
            # Nothing that is wrong with one output may end it, or the others.
            is_sent = False
            if not self._has_complained:
                self._has_complained = True
                _log.warning("output %s: a pose could not be sent (%s)", self.name, error)
        if is_sent:
            self._published += 1
        else:
            self._dropped += 1


class JsonDatagrams:
    """A pose message is one datagram."""

    def __init__(self, settings: UdpJsonSettings, skeleton: Skeleton) -> None:
        angles = JointAngles(skeleton) if PoseMap.JOINT_ANGLES in settings.include else None
        self._encoder = PoseEncoder(skeleton.segment_names, include=settings.include, joint_angles=angles)
        self._body = describe_body(skeleton).payload()
        self._bodies = Thinning(1.0) if settings.body else None

    def encode(self, frame: SkeletonFrame) -> list[bytes]:
        """Return the pose; once a second the body before it, where it is wanted."""
        pose = self._encoder.encode(frame)
        if self._bodies is not None and self._bodies.admits(frame.time_ns):
            return [self._body, pose]
        return [pose]


class OutputContext(NamedTuple):
    """What an output may need to know beside its settings."""

    skeleton: Skeleton
    gateway: str
    frame_rate: float
    """Poses reconstructed a second, Hz."""
    battery: Callable[[], float | None]
    """Returns the least charge of all modules, 0 to 1; None: not known."""
    publish: Beside
    """For what goes to the broker beside poses."""


def _sink_of_mvn(settings: MvnSettings, encoder: MvnEncoder) -> Sink:
    if settings.transport == "tcp":
        return StreamSink("mvn", settings.host, settings.port, encoder.encode)
    return DatagramSink("mvn", settings.host, settings.port, encoder)


SINKS: dict[str, Callable[[Any, OutputContext], Sink]] = {
    "vmc": lambda vmc, on: DatagramSink("vmc", vmc.host, vmc.port, VmcEncoder(on.skeleton)),
    "udp_json": lambda udp, on: DatagramSink("udp_json", udp.host, udp.port, JsonDatagrams(udp, on.skeleton)),
    "slimevr": lambda slimevr, on: SlimevrSink(slimevr, on.skeleton, on.gateway, on.battery),
    "mvn": lambda mvn, on: _sink_of_mvn(mvn, MvnEncoder(on.skeleton, on.gateway)),
    "lsl": lambda lsl, on: LslSink(
        lsl.name, f"mocap-{on.gateway}", on.skeleton.segment_names, min(lsl.rate, on.frame_rate)
    ),
    "foxglove": lambda foxglove, on: FoxgloveSink(foxglove, on.skeleton, on.gateway),
    "ros2": lambda ros2, on: Ros2Sink(ros2, on.skeleton),
    "retarget": lambda retarget, on: RetargetSink(retarget, on.skeleton, on.publish),
    "opensim": lambda opensim, on: DatagramSink(
        "opensim", opensim.host, opensim.port, OpenSimEncoder(opensim, on.skeleton)
    ),
}
"""By name in ``OutputsSettings``, whose settings the first argument is."""


class SideOutputs:
    """One ``Output`` in front of all of them. ``OutputError``: a body that one cannot show."""

    def __init__(
        self,
        settings: OutputsSettings,
        skeleton: Skeleton,
        gateway: str,
        frame_rate: float,
        battery: Callable[[], float | None] = lambda: None,
        publish: Beside = lambda _topic, _payload: True,
    ) -> None:
        """Make those that are asked for; the arguments beside the settings are those of ``OutputContext``."""
        context = OutputContext(skeleton, gateway, frame_rate, battery, publish)
        self._outputs = [
            LatestOutput(name, make(chosen, context), chosen.rate)
            for name, make in SINKS.items()
            if (chosen := getattr(settings, name)) is not None
        ]

    @property
    def counters(self) -> dict[str, OutputCounters]:
        """What became of the poses offered, by output."""
        return {output.name: output.counters for output in self._outputs}

    def offer(self, frame: SkeletonFrame) -> None:
        """Give a frame to all. Never waits."""
        for output in self._outputs:
            output.offer(frame)

    @property
    def is_waiting(self) -> bool:
        """Whether one has a pose to send, and the event loop should have its turn."""
        return any(output.is_waiting for output in self._outputs)

    def pause(self, is_paused: bool) -> None:
        """Send nothing for a while, or go on: what is offered meanwhile counts as thinned."""
        for output in self._outputs:
            output.is_paused = is_paused

    async def open(self) -> None:
        """Open all that can fail, without sending. Raises ``OutputError``; ``close`` undoes it."""
        for output in self._outputs:
            await output.open()

    async def close(self) -> None:
        """Close what was opened and never run."""
        for output in self._outputs:
            await output.stop()

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Send until left. Raises ``OutputError`` when one cannot start."""
        async with contextlib.AsyncExitStack() as stack:
            for output in self._outputs:
                stack.push_async_callback(output.stop)
                await output.start()
            yield
