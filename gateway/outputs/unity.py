"""A pose in Unity's terms: a left-handed world with y up, and the bones of its humanoid avatars.

World axes: x_unity = east, y_unity = up, z_unity = north. Two axes are exchanged, which is a reflection
``M``: positions become ``M p``, and a rotation by ``M R Mᵀ``, so the vector part of its quaternion by
``-M v`` (a vector of rotation is axial). Unity writes quaternions x, y, z, w.

An avatar's bones are unrotated in the T-pose, facing z_unity (north): palms down, thumbs forward. So a
bone's rotation is that of its segment since the T-pose, ``q_wb ⊗ q_tb*`` with ``q_tb`` the segment in the
T-pose, and what is sent is relative to the parent bone.

``VmcEncoder`` sends it by the VMC protocol (OSC over UDP), which Unity, Blender and VR apps take as an
avatar.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from gateway.body.kinematics import joint_positions, lowest_point
from gateway.body.skeleton import Skeleton
from gateway.errors import OutputError
from gateway.frames import FloatArray, SkeletonFrame
from gateway.geometry import quaternion

_SIDED = {
    "shoulder_girdle": "Shoulder",
    "upper_arm": "UpperArm",
    "forearm": "LowerArm",
    "hand": "Hand",
    "thigh": "UpperLeg",
    "shank": "LowerLeg",
    "foot": "Foot",
    "toes": "Toes",
}
UNITY_BONES: dict[str, str] = {
    "pelvis": "Hips",
    "l5": "Spine",
    "t12": "Chest",
    "thorax": "UpperChest",
    "neck": "Neck",
    "head": "Head",
    **{
        f"{side}_{segment}": f"{side.capitalize()}{bone}"
        for side in ("left", "right")
        for segment, bone in _SIDED.items()
    },
}
"""Segment to ``HumanBodyBones`` name. A thorax that hangs from the pelvis is the ``Spine``: it bends there.
Segments without a bone (``l3``) turn their children only."""

_ARM = ("upper_arm", "forearm", "hand")
_TO_NORTH = np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)])


def unity_vector(v_w: FloatArray) -> FloatArray:
    """Return a vector in world axes as one in Unity axes; (..., 3)."""
    return v_w[..., [0, 2, 1]]


def unity_rotation(q_w: FloatArray) -> FloatArray:
    """Return a rotation in world axes as one in Unity axes: (..., 4) wxyz to (..., 4) xyzw."""
    converted: FloatArray = np.concatenate([-q_w[..., [1, 3, 2]], q_w[..., :1]], axis=-1)
    return converted


def t_pose(skeleton: Skeleton) -> FloatArray:
    """Return ``q_tb`` (n_segments, 4): every segment to the world in a T-pose, facing north."""
    q_tb = np.tile(quaternion.multiply(_TO_NORTH, skeleton.neutral), (skeleton.n_segments, 1))
    for s, name in enumerate(skeleton.segment_names):
        side, _, part = name.partition("_")
        if part in _ARM:
            half = math.radians(45 if side == "left" else -45)  # about the axis forward
            q_tb[s] = quaternion.multiply(q_tb[s], np.array([math.cos(half), math.sin(half), 0.0, 0.0]))
    return q_tb


@dataclass(frozen=True, slots=True)
class Bone:
    """One bone of an avatar."""

    name: str
    segment: int
    parent: int
    """Index of the parent bone, -1 for the hips."""


def bones_of(skeleton: Skeleton) -> tuple[Bone, ...]:
    """Return the bones that an avatar has for this body, parents first; empty for a body that is not a
    person's."""
    names = skeleton.segment_names
    bones: list[Bone] = []
    of_segment: dict[int, int] = {}
    for s, name in enumerate(names):
        if name not in UNITY_BONES:
            continue
        parent = skeleton.parents[s]
        is_low_thorax = name == "thorax" and parent >= 0 and names[parent] == "pelvis"
        while parent >= 0 and parent not in of_segment:
            parent = skeleton.parents[parent]
        of_segment[s] = len(bones)
        bones.append(
            Bone("Spine" if is_low_thorax else UNITY_BONES[name], s, of_segment.get(int(parent), -1))
        )
    return tuple(bones) if bones and bones[0].name == "Hips" else ()


class AvatarPoses:
    """Skeleton frames to poses of an avatar; a segment that is not known keeps its last rotation."""

    def __init__(self, skeleton: Skeleton) -> None:
        self.bones = bones_of(skeleton)
        self._skeleton = skeleton
        self._from_t_pose = np.array([quaternion.conjugate(q) for q in t_pose(skeleton)])
        self._q_wb = t_pose(skeleton)
        self._root = int(np.flatnonzero(skeleton.parents < 0)[0])
        self._offsets = self._rest_offsets()

    def update(self, frame: SkeletonFrame) -> tuple[FloatArray, FloatArray]:
        """Return (n_bones, 3) and (n_bones, 4): each bone in its parent, Unity axes, m and xyzw.

        A body whose place is not known stands on the ground.
        """
        is_known = np.isfinite(frame.q_wb).all(axis=1)
        self._q_wb[is_known] = frame.q_wb[is_known]
        turned = [
            quaternion.multiply(self._q_wb[b.segment], self._from_t_pose[b.segment]) for b in self.bones
        ]
        local = [
            turned[i]
            if bone.parent < 0
            else quaternion.multiply(quaternion.conjugate(turned[bone.parent]), turned[i])
            for i, bone in enumerate(self.bones)
        ]
        positions = self._offsets.copy()
        positions[0] = unity_vector(self._hips(frame))
        return positions, unity_rotation(np.array(local))

    def _hips(self, frame: SkeletonFrame) -> FloatArray:
        skeleton, place = self._skeleton, frame.p_w[self._root]
        root = place if np.isfinite(place).all() else np.zeros(3)
        if root.any():
            return root
        p_w = joint_positions(skeleton.parents, skeleton.offsets, self._q_wb, root)
        return np.array([0.0, 0.0, -lowest_point(skeleton, self._q_wb, p_w)])

    def _rest_offsets(self) -> FloatArray:
        """Return (n_bones, 3): each bone from its parent in the T-pose, Unity axes, m."""
        skeleton = self._skeleton
        p_w = joint_positions(skeleton.parents, skeleton.offsets, t_pose(skeleton), np.zeros(3))
        at = np.array([p_w[bone.segment] for bone in self.bones]).reshape(-1, 3)
        from_parent = [
            p - (at[b.parent] if b.parent >= 0 else p) for p, b in zip(at, self.bones, strict=True)
        ]
        return unity_vector(np.array(from_parent).reshape(-1, 3))


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
        """Return the datagrams of one frame: state, time and root, then the bones."""
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
