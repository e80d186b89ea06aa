"""All outputs beside MQTT, as configured."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator

from gateway.body.joint_angles import JointAngles
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import OutputCounters
from gateway.frames import SkeletonFrame
from gateway.outputs.datagrams import DatagramSink
from gateway.outputs.latest import LatestOutput, Sink
from gateway.outputs.lsl import LslSink
from gateway.outputs.pose_encoding import PoseEncoder
from gateway.outputs.settings import PoseMap
from gateway.outputs.side_settings import OutputsSettings, UdpJsonSettings
from gateway.outputs.vmc import VmcEncoder


class SideOutputs:
    """One ``Output`` in front of all of them. ``OutputError``: a body that one cannot show."""

    def __init__(
        self, settings: OutputsSettings, skeleton: Skeleton, gateway: str, frame_rate: float
    ) -> None:
        """frame_rate: poses reconstructed a second, Hz."""
        self._outputs: list[LatestOutput] = []
        if (vmc := settings.vmc) is not None:
            self._add("vmc", DatagramSink("vmc", vmc.host, vmc.port, VmcEncoder(skeleton)), vmc.rate)
        if (udp := settings.udp_json) is not None:
            sink = DatagramSink("udp_json", udp.host, udp.port, _JsonDatagrams(udp, skeleton))
            self._add("udp_json", sink, udp.rate)
        if (lsl := settings.lsl) is not None:
            rate = min(lsl.rate, frame_rate)
            sink_of_lsl = LslSink(lsl.name, f"mocap-{gateway}", skeleton.segment_names, rate)
            self._add("lsl", sink_of_lsl, lsl.rate)

    @property
    def counters(self) -> dict[str, OutputCounters]:
        """What became of the poses offered, by output."""
        return {output.name: output.counters for output in self._outputs}

    def offer(self, frame: SkeletonFrame) -> None:
        """Give a frame to all. Never waits."""
        for output in self._outputs:
            output.offer(frame)

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

    def _add(self, name: str, sink: Sink, rate: float) -> None:
        self._outputs.append(LatestOutput(name, sink, rate))


class _JsonDatagrams:
    """A pose message is one datagram."""

    def __init__(self, settings: UdpJsonSettings, skeleton: Skeleton) -> None:
        angles = JointAngles(skeleton) if PoseMap.JOINT_ANGLES in settings.include else None
        self._encoder = PoseEncoder(skeleton.segment_names, include=settings.include, joint_angles=angles)

    def encode(self, frame: SkeletonFrame) -> list[bytes]:
        return [self._encoder.encode(frame)]
