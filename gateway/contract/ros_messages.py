"""Messages of ROS 2 as bytes: definitions, and encoders for what a body and its modules give.

CDR, little-endian. All that varies from message to message is numbers at fixed places, since names and counts
stay: an encoder lays a message out once, and then fills in the numbers. Axes are those of REP 103 (x forward,
y left, z up): a segment's frame is its own axes turned so that all frames agree in the neutral posture.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from devices.ros_definitions import IMU, JOINT_STATE, MAGNETIC_FIELD, TF, TF_MESSAGE, TF_STATIC, definition
from gateway.body.joint_angles import JointAngles
from gateway.body.joints import Joint
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion

__all__ = ["IMU", "JOINT_STATE", "MAGNETIC_FIELD", "TF", "TF_MESSAGE", "TF_STATIC", "definition"]

WORLD_FRAME = "map"
"""REP 105: fixed to the world, z up."""


class _Layout:
    """A message in the making: its constant bytes, and where its numbers go."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._stamps: list[int] = []
        self._numbers: list[int] = []

    def stamp(self) -> None:
        """Leave room for a time that every message has."""
        self._align(4)
        self._stamps.append(len(self._bytes) // 4)
        self._bytes += bytes(8)

    def text(self, text: str) -> None:
        """Append a text with its length, as CDR has it."""
        data = text.encode() + b"\0"
        self.count(len(data))
        self._bytes += data

    def count(self, n: int) -> None:
        """Append an unsigned integer of 32 bits."""
        self._align(4)
        self._bytes += struct.pack("<I", n)

    def numbers(self, n: int) -> None:
        """Leave room for float64 that vary."""
        if n == 0:
            return
        self._align(8)
        first = len(self._bytes) // 8
        self._numbers += range(first, first + n)
        self._bytes += bytes(8 * n)

    def constants(self, values: Sequence[float]) -> None:
        """Append numbers of 64 bits that stay the same in every message."""
        self._align(8)
        self._bytes += struct.pack(f"<{len(values)}d", *values)

    def finished(self) -> _Form:
        """Return the form, to be filled for every message."""
        return _Form(bytes(self._bytes), self._stamps, self._numbers)

    def _align(self, size: int) -> None:
        self._bytes += bytes(-len(self._bytes) % size)


class _Form:
    """A message laid out, to be filled in."""

    _HEAD = b"\x00\x01\x00\x00"
    """CDR, little-endian."""

    def __init__(self, data: bytes, stamps: list[int], numbers: list[int]) -> None:
        self._size = len(data)
        self._words = np.frombuffer(data + bytes(-len(data) % 8), np.uint8).copy()
        self._seconds = np.array(stamps, np.int64)
        self._places = np.array(numbers, np.int64)

    def filled(self, time_ns: int, numbers: FloatArray) -> bytes:
        """Return the message. numbers: all that vary, in their order."""
        self._words.view("<f8")[self._places] = numbers.reshape(-1)
        seconds, rest = divmod(time_ns, 1_000_000_000)
        stamps = self._words.view("<u4")
        stamps[self._seconds], stamps[self._seconds + 1] = seconds & 0xFFFFFFFF, rest
        return self._HEAD + self._words[: self._size].tobytes()


class TransformsEncoder:
    """Transforms between frames as ``TFMessage``. names: (parent, child) of each."""

    def __init__(self, names: Sequence[tuple[str, str]]) -> None:
        layout = _Layout()
        layout.count(len(names))
        for parent, child in names:
            layout.stamp()
            layout.text(parent)
            layout.text(child)
            layout.numbers(7)
        self._form = layout.finished()

    def encode(self, time_ns: int, translations: FloatArray, rotations: FloatArray) -> bytes:
        """Return a message of translations (n, 3), m, in the parent's axes, and rotations (n, 4), child to
        parent.
        """
        return self._form.filled(time_ns, np.hstack([translations, np.roll(rotations, -1, axis=1)]))


class JointStateEncoder:
    """Angles of named joints, rad, as ``JointState``; NaN where one is not known."""

    def __init__(self, names: Sequence[str], *, has_rates: bool = False) -> None:
        # The fields of sensor_msgs/JointState in their order: header, names, positions, velocities, efforts.
        layout = _Layout()
        layout.stamp()
        layout.text("")
        layout.count(len(names))
        for name in names:
            layout.text(name)
        layout.count(len(names))
        layout.numbers(len(names))
        layout.count(len(names) if has_rates else 0)
        layout.numbers(len(names) if has_rates else 0)
        layout.count(0)
        self._form = layout.finished()

    def encode(self, time_ns: int, angles: FloatArray) -> bytes:
        """Return a message of angles (n,), rad; with rates (2, n), rad/s below."""
        return self._form.filled(time_ns, angles)


class BodyJointStates:
    """The joint angles of a body as ``JointState``: see ``angle_names``."""

    def __init__(self, skeleton: Skeleton, body: str) -> None:
        """Prepare for a skeleton; ``body`` is the id of the person, by REP 155."""
        names = angle_names(skeleton.joints)
        self.names = [name for *_, name in names]
        self.topic = "/joint_states" if skeleton.stature_m is None else f"/humans/bodies/{body}/joint_states"
        """REP 155's for a person."""
        self._joints = JointAngles(skeleton)
        self._rows = np.array([(j, a) for j, a, _ in names], np.int64).reshape(-1, 2)
        self._encoder = JointStateEncoder(self.names)

    def encode(self, time_ns: int, q_wb: FloatArray) -> bytes:
        """Return a message of orientations (S, 4), NaN where unknown; poses in order, as angles are
        continuous.
        """
        angles = self._joints.update(np.ascontiguousarray(q_wb)).angles
        return self._encoder.encode(time_ns, angles[self._rows[:, 0], self._rows[:, 1]])


class ImuEncoder:
    """Specific force and angular rate of a module in its own axes, as REP 145 has ``imu/data_raw``: without
    an orientation, which its covariance of -1 says."""

    def __init__(self, frame: str) -> None:
        layout = _Layout()
        layout.stamp()
        layout.text(frame)
        layout.constants([0.0, 0.0, 0.0, 1.0])
        layout.constants([-1.0, *[0.0] * 8])
        for _ in range(2):
            layout.numbers(3)
            layout.constants([0.0] * 9)  # covariance not known
        self._form = layout.finished()

    def encode(self, time_ns: int, angular_rate: FloatArray, specific_force: FloatArray) -> bytes:
        """Return a message of angular rate, rad/s, and specific force, m/s², (3,) each."""
        return self._form.filled(time_ns, np.concatenate([angular_rate, specific_force]))


class MagneticFieldEncoder:
    """The magnetic field at a module, as REP 145 has ``imu/mag``."""

    def __init__(self, frame: str) -> None:
        layout = _Layout()
        layout.stamp()
        layout.text(frame)
        layout.numbers(3)
        layout.constants([0.0] * 9)
        self._form = layout.finished()

    def encode(self, time_ns: int, field_ut: FloatArray) -> bytes:
        """Return a message of the field (3,), µT."""
        return self._form.filled(time_ns, field_ut * 1e-6)


class BodyTransforms:
    """The frames of a body, each in that of its parent segment; the root in the world's."""

    def __init__(self, skeleton: Skeleton) -> None:
        self.names = [
            (WORLD_FRAME if parent < 0 else skeleton.segment_names[parent], name)
            for name, parent in zip(skeleton.segment_names, skeleton.parents.tolist(), strict=True)
        ]
        """(parent, child) of each segment."""
        self._parents = skeleton.parents
        self._is_root = skeleton.parents < 0
        w, x, y, z = quaternion.conjugate(skeleton.neutral).tolist()
        self._from_frame = np.array([[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
        """Of q ⊗ conj(neutral), for rows q."""
        to_frame = quaternion.to_matrix(skeleton.neutral)
        self._offsets = skeleton.offsets @ to_frame.T
        self._encoders: dict[bytes, TransformsEncoder] = {}

    def of(self, q_wb: FloatArray, p_w: FloatArray) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
        """Return which of S transforms are known, and of these translations (n, 3), m, and rotations (n, 4).

        q_wb: (S, 4); p_w: (S, 3) m. A segment hangs from its parent, and is left out where that is not known;
        a root whose place is not known stands in the origin.
        """
        frames = q_wb @ self._from_frame
        rotations = _relative(self._parents, self._is_root, frames)
        translations = self._offsets.copy()
        translations[self._is_root] = np.nan_to_num(p_w[self._is_root])
        known = np.isfinite(rotations[:, 0])
        return known, translations[known], rotations[known]

    def encode(self, time_ns: int, q_wb: FloatArray, p_w: FloatArray) -> bytes:
        """Return a ``TFMessage`` with all transforms that are known."""
        known, translations, rotations = self.of(q_wb, p_w)
        # The layout depends on which segments are known, and that changes seldom: encoders are kept by it.
        key = known.tobytes()
        encoder = self._encoders.get(key)
        if encoder is None:
            # A body whose segments come and go has ever new layouts, which must not fill the memory.
            if len(self._encoders) >= _MOST_LAYOUTS:
                self._encoders.clear()
            names = [name for name, is_known in zip(self.names, known.tolist(), strict=True) if is_known]
            encoder = self._encoders[key] = TransformsEncoder(names)
        return encoder.encode(time_ns, translations, rotations)


_MOST_LAYOUTS = 64


def angle_names(joints: Sequence[Joint]) -> list[tuple[int, int, str]]:
    """Return (joint, angle, name) of all angles: the name of a joint that has one, as of a robot's, else
    ``<joint>_<movement>``."""
    return [
        (j, a, joint.name if len(joint.angles) == 1 else f"{joint.name}_{angle.name}")
        for j, joint in enumerate(joints)
        for a, angle in enumerate(joint.angles)
    ]


def _relative(parents: IntArray, is_root: NDArray[np.bool_], frames: FloatArray) -> FloatArray:
    """Return (S, 4) each frame in its parent's, or in the world. In NumPy: to compile it would take longer
    than a recording may take to begin."""
    pw, px, py, pz = np.where(is_root, _IDENTITY, frames[parents].T * _CONJUGATE)
    qw, qx, qy, qz = frames.T
    rotations: FloatArray = np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=1,
    )
    return rotations


_IDENTITY = np.array([[1.0], [0.0], [0.0], [0.0]])
_CONJUGATE = np.array([[1.0], [-1.0], [-1.0], [-1.0]])
