"""The VMC protocol (OSC over UDP): what Unity, Blender and VR apps take as an avatar."""

from __future__ import annotations

import struct

from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from gateway.body.skeleton import Skeleton
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame
from gateway.outputs.unity import AvatarPoses

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
