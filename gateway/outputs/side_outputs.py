"""All outputs beside MQTT, as configured. They send the newest pose and never wait.

LSL: channels ``<segment>_w, _x, _y, _z``, segment to world (ENU), NaN where not known. Time stamps are the
instants of the poses on LSL's own clock, so recorders line them up with other devices. VMC (OSC over UDP)
is what Unity, Blender and VR apps take as an avatar.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import logging
import struct
from collections.abc import AsyncIterator, Callable
from typing import Any, Protocol

from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from devices.extras import how_to_add
from devices.link import gateway_time_ns
from gateway.body.joint_angles import JointAngles
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import OutputCounters, describe_body
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.datagrams import DatagramSender
from gateway.outputs.foxglove import FoxgloveSink
from gateway.outputs.mvn import MvnEncoder
from gateway.outputs.opensim import OpenSimEncoder
from gateway.outputs.output import Thinning
from gateway.outputs.pose_encoding import PoseEncoder
from gateway.outputs.retarget import Beside, RetargetSink
from gateway.outputs.ros2 import Ros2Sink
from gateway.outputs.settings import MvnSettings, OutputsSettings, PoseMap, UdpJsonSettings
from gateway.outputs.slimevr import SlimevrSink
from gateway.outputs.stream_sink import StreamSink
from gateway.outputs.unity import AvatarPoses

_log = logging.getLogger(__name__)


class Sink(Protocol):
    """Where poses go. Nothing here waits for whoever reads them."""

    async def open(self) -> None:
        """Raises ``OutputError``."""

    def send(self, frame: SkeletonFrame) -> bool:
        """Whether the system took all of it. May raise ``OSError``."""

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


class Encoder(Protocol):
    """Makes the datagrams of a frame."""

    def encode(self, frame: SkeletonFrame) -> list[bytes]:
        """Return the datagrams of a frame, in order of sending."""
        ...


class DatagramSink:
    """Sends what frames become to one address. name: of the output, for errors."""

    def __init__(self, name: str, host: str, port: int, encoder: Encoder) -> None:
        self._sender = DatagramSender(name, host, port)
        self._encoder = encoder

    async def open(self) -> None:
        """Find the address. Raises ``OutputError`` for a host that nobody knows."""
        await self._sender.open()

    def send(self, frame: SkeletonFrame) -> bool:
        """Whether the system took all datagrams. Raises ``OSError``, such as for a network that is away."""
        return self._sender.send(self._encoder.encode(frame))

    def close(self) -> None:
        """Give the socket back."""
        self._sender.close()


STREAM_TYPE = "MoCap"


class LslSink:
    """A stream outlet; frame_rate: poses a second, as far as known beforehand, Hz."""

    def __init__(self, name: str, source: str, segment_names: tuple[str, ...], frame_rate: float) -> None:
        self._name = name
        self._source = source
        self._segment_names = segment_names
        self._frame_rate = frame_rate
        self._pylsl: Any = None
        self._outlet: Any = None

    async def open(self) -> None:
        """Announce the stream. Raises ``OutputError`` where LSL is not installed."""
        try:
            self._pylsl = importlib.import_module("pylsl")
        except (ImportError, RuntimeError, OSError) as error:  # the package, or its native library
            raise OutputError(f"outputs.lsl: LSL is not there ({error}): {how_to_add('lsl')}") from error
        channels = 4 * len(self._segment_names)
        info = self._pylsl.StreamInfo(
            self._name, STREAM_TYPE, channels, self._frame_rate, self._pylsl.cf_float32, self._source
        )
        described = info.desc().append_child("channels")
        for segment in self._segment_names:
            for component in "wxyz":
                channel = described.append_child("channel")
                channel.append_child_value("label", f"{segment}_{component}")
                channel.append_child_value("type", "Orientation")
                channel.append_child_value("unit", "quaternion")
        self._outlet = self._pylsl.StreamOutlet(info)

    def send(self, frame: SkeletonFrame) -> bool:
        """LSL buffers for whoever listens, and drops for whoever does not read."""
        age_s = (gateway_time_ns() - frame.time_ns) * 1e-9
        self._outlet.push_sample(frame.q_wb.ravel().tolist(), self._pylsl.local_clock() - age_s)
        return True

    def close(self) -> None:
        """Withdraw the stream."""
        self._outlet = None


MESSAGES_TOGETHER = 12
"""In a datagram: below the 1,500 bytes that a network takes whole."""

_PLACE = struct.Struct(">7f")
_SIZE = struct.Struct(">i")
_BUNDLE_HEAD = OscBundleBuilder(IMMEDIATELY).build().dgram
_NOWHERE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


class VmcEncoder:
    """Frames of one body as OSC bundles. Raises ``OutputError`` for a body that no avatar has.

    A bone's message differs from frame to frame in its last seven numbers only, and those end it: all before
    them is kept. Built anew each time, a frame would take several times as long.
    """

    def __init__(self, skeleton: Skeleton) -> None:
        self._avatar = AvatarPoses(skeleton)
        if not self._avatar.bones:
            raise OutputError(
                f"outputs.vmc: body '{skeleton.name}' is not a person's (its root is no pelvis): "
                "take udp_json for other bodies"
            )
        self._start_ns: int | None = None
        self._state = _message("/VMC/Ext/OK", 1)
        self._root = _message("/VMC/Ext/Root/Pos", "root", *_NOWHERE)
        self._heads = [
            _message("/VMC/Ext/Bone/Pos", bone.name, *_NOWHERE)[: -_PLACE.size] for bone in self._avatar.bones
        ]

    def encode(self, frame: SkeletonFrame) -> list[bytes]:
        """The datagrams of one frame: state, time and root, then the bones."""
        if self._start_ns is None:
            self._start_ns = frame.time_ns
        seconds = (frame.time_ns - self._start_ns) * 1e-9
        positions, rotations = self._avatar.update(frame)
        places = zip(self._heads, positions.tolist(), rotations.tolist(), strict=True)
        messages = [self._state, _message("/VMC/Ext/T", seconds), self._root]
        messages += [head + _PLACE.pack(*p, *q) for head, p, q in places]
        return [
            _bundle(messages[i : i + MESSAGES_TOGETHER]) for i in range(0, len(messages), MESSAGES_TOGETHER)
        ]


def _message(address: str, *values: str | float) -> bytes:
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)
    return builder.build().dgram


def _bundle(messages: list[bytes]) -> bytes:
    return _BUNDLE_HEAD + b"".join(_SIZE.pack(len(message)) + message for message in messages)


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
        """frame_rate: poses reconstructed a second, Hz. battery: asked for the least charge of all modules, 0
        to 1; None: not known. publish: for what goes to the broker beside poses."""
        self._outputs: list[LatestOutput] = []
        if (vmc := settings.vmc) is not None:
            self._add("vmc", DatagramSink("vmc", vmc.host, vmc.port, VmcEncoder(skeleton)), vmc.rate)
        if (udp := settings.udp_json) is not None:
            sink = DatagramSink("udp_json", udp.host, udp.port, JsonDatagrams(udp, skeleton))
            self._add("udp_json", sink, udp.rate)
        if (slimevr := settings.slimevr) is not None:
            sink_of_slimevr = SlimevrSink(slimevr, skeleton, gateway, battery)
            self._add("slimevr", sink_of_slimevr, slimevr.rate)
        if (mvn := settings.mvn) is not None:
            self._add("mvn", _sink_of_mvn(mvn, MvnEncoder(skeleton, gateway)), mvn.rate)
        if (lsl := settings.lsl) is not None:
            rate = min(lsl.rate, frame_rate)
            sink_of_lsl = LslSink(lsl.name, f"mocap-{gateway}", skeleton.segment_names, rate)
            self._add("lsl", sink_of_lsl, lsl.rate)
        if (foxglove := settings.foxglove) is not None:
            self._add("foxglove", FoxgloveSink(foxglove, skeleton, gateway), foxglove.rate)
        if (ros2 := settings.ros2) is not None:
            self._add("ros2", Ros2Sink(ros2, skeleton), ros2.rate)
        if (retarget := settings.retarget) is not None:
            self._add("retarget", RetargetSink(retarget, skeleton, publish), retarget.rate)
        if (opensim := settings.opensim) is not None:
            sink = DatagramSink("opensim", opensim.host, opensim.port, OpenSimEncoder(opensim, skeleton))
            self._add("opensim", sink, opensim.rate)

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

    def _add(self, name: str, sink: Sink, rate: float) -> None:
        self._outputs.append(LatestOutput(name, sink, rate))


def _sink_of_mvn(settings: MvnSettings, encoder: MvnEncoder) -> Sink:
    if settings.transport == "tcp":
        return StreamSink("mvn", settings.host, settings.port, encoder.encode)
    return DatagramSink("mvn", settings.host, settings.port, encoder)


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
