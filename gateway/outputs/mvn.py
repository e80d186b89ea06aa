"""Poses as MVN streams them: what game engines, animation programs and robots' nodes read from an Xsens suit.

Every frame: segments (MXTP02), joint angles (MXTP20) and the time (MXTP25); every second who it is (MXTP12)
and where segments begin in a T-pose (MXTP13). Segments that the body does not have go with the one they hang
from.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime

import numpy as np

from devices.vendor_protocols.mvn import (
    JOINT_ANGLES,
    META,
    PARENTS,
    QUATERNIONS,
    SEGMENTS,
    STREAMED_NAMES,
    TIME_CODE,
    TO_ISB,
    JointRotation,
    SegmentPose,
    encode,
    encode_scale,
    encode_text,
)
from devices.vendor_protocols.rotations import Quaternion, zxy_angles
from gateway.body.kinematics import joint_positions, lowest_point
from gateway.body.skeleton import Skeleton
from gateway.errors import OutputError
from gateway.frames import FloatArray, SkeletonFrame
from gateway.geometry import quaternion
from gateway.outputs.unity import t_pose

_DESCRIBED_EVERY_NS = 1_000_000_000
_DAY_MS = 24 * 3600 * 1000


class MvnEncoder:
    """Frames of one body as datagrams. Raises ``OutputError`` for a body that is not a person's."""

    def __init__(self, skeleton: Skeleton, gateway: str) -> None:
        names = skeleton.segment_names
        if SEGMENTS[0] not in names:
            raise OutputError(
                f"outputs.mvn: body '{skeleton.name}' is not a person's (it has no pelvis): take udp_json "
                "for other bodies"
            )
        self._skeleton, self._gateway = skeleton, gateway
        self._source = _sources(names)
        self._to_isb = [np.array(each) for each in TO_ISB]
        self._q_wb = t_pose(skeleton)
        self._described_ns: int | None = None
        self._sample = 0

    def encode(self, frame: SkeletonFrame) -> list[bytes]:
        """Return the datagrams of one frame; a segment that is not known keeps its last orientation."""
        known = np.isfinite(frame.q_wb).all(axis=1)
        self._q_wb[known] = frame.q_wb[known]
        p_w = frame.p_w if np.isfinite(frame.p_w).all() else self._standing(self._q_wb)
        when = datetime.fromtimestamp(frame.time_ns * 1e-9, UTC)
        time_ms = frame.time_ns // 1_000_000 % _DAY_MS
        head, self._sample = (self._sample, time_ms), self._sample + 1
        text = when.strftime("%H:%M:%S.") + f"{when.microsecond // 1000:03d}"
        found = [
            encode(QUATERNIONS, *head, self._poses(p_w, self._q_wb)),
            encode(JOINT_ANGLES, *head, self._joints()),
            encode_text(TIME_CODE, *head, text),
        ]
        if self._described_ns is None or frame.time_ns - self._described_ns >= _DESCRIBED_EVERY_NS:
            self._described_ns = frame.time_ns
            found += self._description(*head)
        return found

    def _poses(self, p_w: FloatArray, q_wb: FloatArray) -> list[SegmentPose]:
        poses = []
        for number, (row, is_own) in enumerate(self._source, start=1):
            begin = p_w[row]
            if not is_own:
                begin = begin + quaternion.rotate(q_wb[row], self._skeleton.tips[row])
            x, y, z = begin.tolist()
            poses.append(
                SegmentPose(
                    number, (x, y, z), _plain(quaternion.multiply(q_wb[row], self._to_isb[number - 1]))
                )
            )
        return poses

    def _joints(self) -> list[JointRotation]:
        joints = []
        for child, parent in enumerate(PARENTS, start=1):
            if parent:
                q_wp, q_wc = (self._q_wb[self._source[each - 1][0]] for each in (parent, child))
                turned = zxy_angles(_plain(quaternion.multiply(quaternion.conjugate(q_wp), q_wc)))
                x, y, z = map(math.degrees, turned)
                joints.append(JointRotation(parent, child, (x, y, z)))
        return joints

    def _description(self, sample: int, time_ms: int) -> list[bytes]:
        q_tb = np.array([quaternion.multiply(_TO_X, q) for q in t_pose(self._skeleton)])
        poses = self._poses(self._standing(q_tb), q_tb)
        origins = {name: pose.position for name, pose in zip(STREAMED_NAMES, poses, strict=True)}
        who = f"name:{self._gateway}\nxmid:{self._skeleton.name}\n"
        return [encode_text(META, sample, time_ms, who), encode_scale(sample, time_ms, origins)]

    def _standing(self, q_wb: FloatArray) -> FloatArray:
        """Return where joints (n_segments, 3) are when the lowest point is on the ground, m."""
        skeleton = self._skeleton
        p_w = joint_positions(skeleton.parents, skeleton.offsets, q_wb, np.zeros(3))
        p_w[:, 2] -= lowest_point(skeleton, q_wb, p_w)
        return p_w


_TO_X = np.array([math.sqrt(0.5), 0.0, 0.0, -math.sqrt(0.5)])
"""From facing north to facing x."""


def _sources(names: tuple[str, ...]) -> list[tuple[int, bool]]:
    """Return for each of MVN's segments the row of the one that tells it, and whether that is itself."""
    found: list[tuple[int, bool]] = []
    for name, parent in zip(SEGMENTS, PARENTS, strict=True):
        found.append((names.index(name), True) if name in names else (found[parent - 1][0], False))
    return found


def _plain(q: FloatArray) -> Quaternion:
    w, x, y, z = q.tolist()
    return w, x, y, z
