"""The VMC protocol (OSC over UDP): what Unity, Blender and VR apps take as an avatar."""

from __future__ import annotations

from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message import OscMessage
from pythonosc.osc_message_builder import OscMessageBuilder

from gateway.body.skeleton import Skeleton
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.unity import AvatarPoses

BONES_TOGETHER = 12
"""Messages a datagram: below the 1,500 bytes that a network takes whole."""


class VmcEncoder:
    """Frames of one body as OSC bundles. Raises ``OutputError`` for a body that no avatar has."""

    def __init__(self, skeleton: Skeleton) -> None:
        self._avatar = AvatarPoses(skeleton)
        if not self._avatar.bones:
            raise OutputError(
                f"outputs.vmc: body '{skeleton.name}' is not a person's (its root is no pelvis): "
                "take udp_json for other bodies"
            )
        self._start_ns: int | None = None

    def encode(self, frame: SkeletonFrame) -> list[bytes]:
        """The datagrams of one frame: state, time and root, then the bones."""
        if self._start_ns is None:
            self._start_ns = frame.time_ns
        seconds = (frame.time_ns - self._start_ns) * 1e-9
        positions, rotations = self._avatar.update(frame)
        messages = [
            _message("/VMC/Ext/OK", 1),
            _message("/VMC/Ext/T", seconds),
            _message("/VMC/Ext/Root/Pos", "root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        ]
        for bone, p, q in zip(self._avatar.bones, positions.tolist(), rotations.tolist(), strict=True):
            messages.append(_message("/VMC/Ext/Bone/Pos", bone.name, *p, *q))
        return [_bundle(messages[i : i + BONES_TOGETHER]) for i in range(0, len(messages), BONES_TOGETHER)]


def _message(address: str, *values: str | float) -> OscMessage:
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)
    return builder.build()


def _bundle(messages: list[OscMessage]) -> bytes:
    builder = OscBundleBuilder(IMMEDIATELY)
    for message in messages:
        builder.add_content(message)
    return builder.build().dgram
