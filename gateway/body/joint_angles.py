"""Joint angles from segment orientations: ISB conventions, instant by instant.

The definitions (segments, order of rotations, positive directions) are data: see ``config/bodies/`` and
docs/reference/joint_angles.md. Angles are in radians here; outputs give degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.body.joint_decomposition import GIMBAL_ZONE, decompose
from gateway.body.joints import WORLD, Angle, Decomposition, Joint
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled

BoolArray = NDArray[np.bool_]

LIMIT_TOLERANCE = np.radians(5.0)
"""How far an angle may pass its limit before it counts as beyond it, rad."""


@dataclass(frozen=True)
class JointAngleFrame:
    """The angles of all joints at one instant, in the order of the joints."""

    angles: FloatArray
    """(n_joints, 3) rad, each growing with its named movement; NaN where not known, and beyond a joint's
    last angle."""
    near_gimbal: BoolArray
    """(n_joints,) near the singularity of its decomposition: single angles are to be taken with care."""
    beyond_limits: BoolArray
    """(n_joints,) an angle is more than ``LIMIT_TOLERANCE`` beyond its limits."""


class JointAngles:
    """Angles of all joints of a skeleton, continuous from frame to frame.

    A joint begins with angles inside its limits, goes on with those nearest the frame before, and begins
    anew after a frame in which one of its segments was not known.
    """

    def __init__(self, skeleton: Skeleton) -> None:
        self.joints = skeleton.joints
        self._ends = _ends(self.joints)
        self._kinds = np.array([joint.decomposition for joint in self.joints], dtype=np.int64)
        self._axes = _per_angle(self.joints, lambda angle: angle.axis_index, 0).astype(np.int64)
        self._hinges = np.array([joint.angles[0].axis for joint in self.joints]).reshape(-1, 3)
        signs = _per_angle(self.joints, lambda angle: angle.sign, 1.0)
        signs[self._kinds == Decomposition.HINGE] = 1.0  # the sign is in the axis itself
        self._signs = signs
        low = _per_angle(self.joints, lambda angle: angle.limits[0], -np.inf)
        high = _per_angle(self.joints, lambda angle: angle.limits[1], np.inf)
        self._limits = np.stack([low, high], axis=2)
        self._turned_limits = np.sort(self._limits * signs[:, :, None], axis=2)
        self._neutral = skeleton.neutral
        self._before = np.full((len(self.joints), 3), np.nan)
        self.update(np.tile(skeleton.neutral, (skeleton.n_segments, 1)))  # compile before the first frame
        self.reset()

    def reset(self) -> None:
        """Forget the frame before."""
        self._before[:] = np.nan

    def update(self, q_wb: FloatArray) -> JointAngleFrame:
        """Return the angles of one instant. q_wb: (n_segments, 4), NaN rows where not known."""
        turned, lock = _joint_angles(
            q_wb, self._neutral, self._ends, self._kinds, self._axes, self._hinges, self._before,
            self._turned_limits,
        )  # fmt: skip
        self._before = turned
        angles = turned * self._signs
        with np.errstate(invalid="ignore"):
            beyond = (angles < self._limits[:, :, 0] - LIMIT_TOLERANCE) | (
                angles > self._limits[:, :, 1] + LIMIT_TOLERANCE
            )
        return JointAngleFrame(angles, lock < GIMBAL_ZONE, beyond.any(axis=1))


def joint_angles(skeleton: Skeleton, q_wb: FloatArray) -> FloatArray:
    """Return angles over time: q_wb (T, n_segments, 4) to (T, n_joints, 3), rad."""
    stream = JointAngles(skeleton)
    return np.stack([stream.update(pose).angles for pose in q_wb])


def posture(skeleton: Skeleton, angles: Mapping[str, Sequence[float]], q_root: FloatArray) -> FloatArray:
    """Return ``q_wb`` (n_segments, 4) with joints at the given angles, rad, and all others at zero.

    angles: joint name to its angles in order. q_root: (4,) of the root segment. A segment without a joint
    here is turned as its parent is. Raises ``KeyError`` for an unknown joint.
    """
    joints = {joint.name: joint for joint in skeleton.joints}
    turned = {joints[name].distal: (joints[name], np.asarray(values)) for name, values in angles.items()}
    q_wb = np.tile(q_root, (skeleton.n_segments, 1))
    for i, parent in enumerate(skeleton.parents.tolist()):
        joint, values = turned.get(i, (None, np.zeros(3)))
        # Parents come first, so this one is known already.
        if parent >= 0:
            q_wb[i] = q_wb[parent]
        if joint is not None:
            q_wp = skeleton.neutral if joint.proximal == WORLD else q_wb[joint.proximal]
            q_wb[i] = quaternion.multiply(q_wp, joint_rotation(joint, values))
    return q_wb


def joint_rotation(joint: Joint, angles: FloatArray) -> FloatArray:
    """Return ``q_pd`` (4,), distal to proximal, of a joint at the given angles, rad: inverse of
    ``decompose``.
    """
    vectors = [np.array(angle.axis) * value for angle, value in zip(joint.angles, angles, strict=False)]
    if joint.decomposition is Decomposition.SWING_TWIST:
        vectors = [vectors[0] + vectors[1], vectors[2]]
    q = np.array([1.0, 0.0, 0.0, 0.0])
    for vector in vectors:
        q = quaternion.multiply(q, quaternion.from_rotation_vector(vector))
    return q


@compiled
def _joint_angles(
    q_wb: FloatArray,
    neutral: FloatArray,
    ends: IntArray,
    kinds: IntArray,
    axes: IntArray,
    hinges: FloatArray,
    before: FloatArray,
    limits: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return right-handed angles (n_joints, 3) and distances from the singularity (n_joints,), rad."""
    angles = np.full((len(ends), 3), np.nan)
    lock = np.full(len(ends), np.nan)
    for n in range(len(ends)):
        q_wp = neutral if ends[n, 0] == WORLD else q_wb[ends[n, 0]]
        q_pd = quaternion.multiply(quaternion.conjugate(q_wp), q_wb[ends[n, 1]])
        if not np.isfinite(q_pd).all():
            continue
        angles[n], lock[n] = decompose(kinds[n], q_pd, axes[n], hinges[n], before[n], limits[n])
    return angles, lock


def _ends(joints: Sequence[Joint]) -> IntArray:
    pairs = [(joint.proximal, joint.distal) for joint in joints]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _per_angle(joints: Sequence[Joint], value: Callable[[Angle], float], default: float) -> FloatArray:
    table = np.full((len(joints), 3), default, dtype=np.float64)
    for n, joint in enumerate(joints):
        for i, angle in enumerate(joint.angles):
            table[n, i] = value(angle)
    return table
