"""Joint angles from segment orientations: ISB conventions, instant by instant, each continuous.

The definitions (segments, order of rotations, positive directions) are data: see ``config/bodies/`` and
docs/reference/joint_angles.md. Angles are in radians here; outputs give degrees.

``decompose`` (compiled) makes angles of the rotation of one joint: three successive rotations by the direct
method of Bernardes & Viollet (2022, PLoS ONE 17(11): e0276302). It finds the half sum and the half
difference of the first and third angle. Near gimbal lock (second angle at ±90°, or at 0° or 180° where the
first axis comes again) one of the two is lost in noise while the other stays well defined: the lost one then
follows what is measured the more slowly the nearer the lock is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.body.joints import WORLD, Angle, Decomposition, Joint
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, vector

GIMBAL_ZONE = math.radians(5.0)
"""Distance from the singularity below which angles are held together, and flagged, rad."""
RETURN_ZONE = math.radians(15.0)
"""Distance from the singularity beyond which angles may return to the way inside the limits, rad."""
RETURN_EXCESS = math.radians(30.0)
"""How far outside the limits they have to be for that, more than the other way, rad."""

_TURN = 2.0 * math.pi
_CARDAN = int(Decomposition.CARDAN)
_SWING_TWIST = int(Decomposition.SWING_TWIST)


@compiled
def nearest_turn(angle: float, to: float) -> float:
    """Return the angle plus whole turns that is nearest ``to``; rad."""
    return angle - _TURN * math.floor((angle - to) / _TURN + 0.5)


@compiled
def decompose(
    kind: int, q: FloatArray, axes: IntArray, axis: FloatArray, before: FloatArray, limits: FloatArray
) -> tuple[FloatArray, float]:
    """Return right-handed angles about the axes (3,), rad, and the distance from the singularity, rad.

    q: (4,) distal to proximal. axes: (3,) 0, 1, 2 for x, y, z. axis: (3,) unit, of a hinge.
    before: (3,) the angles of the instant before; NaN: a new start, inside the limits where possible.
    limits: (3, 2) of these angles, rad; infinite where there are none.
    """
    if kind == _CARDAN:
        return _cardan(q, axes, before, limits)
    if kind == _SWING_TWIST:
        return _swing_twist(q, axes, before)
    angle = 2.0 * math.atan2(dot(q[1:], axis), q[0])
    # An angle about one axis is known up to whole turns: the one nearest to the last angle is continuous.
    near = before[0] if math.isfinite(before[0]) else _middle(limits[0])
    angle = _brought_back(nearest_turn(angle, near), limits[0])
    return vector(angle, np.nan, np.nan), math.pi


@compiled
def _cardan(
    q: FloatArray, axes: IntArray, before: FloatArray, limits: FloatArray
) -> tuple[FloatArray, float]:
    half_sum, half_difference, middle, handed, shift = _half_angles(q, axes)
    lock = min(middle, math.pi - middle)
    found = vector(handed * (half_sum + half_difference), middle - shift, half_sum - half_difference)
    # the other way to write the same rotation: half a turn first, half a turn last
    other = vector(found[0] + math.pi, -middle - shift, found[2] + math.pi)
    anew = _within_limits(found, other, limits)
    if not math.isfinite(before[0]):
        return anew, lock
    found, other = _near(found, before), _near(other, before)
    if _distance(other, before) < _distance(found, before):
        found = other
    if lock > RETURN_ZONE and _excess(found, limits) > _excess(anew, limits) + RETURN_EXCESS**2:
        return anew, lock
    if lock < GIMBAL_ZONE:
        _steady(found, before, lock, handed, -1.0 if middle < 0.5 * math.pi else 1.0)
    return found, lock


@compiled
def _within_limits(found: FloatArray, other: FloatArray, limits: FloatArray) -> FloatArray:
    """Return that of two decompositions of a rotation, whole turns aside, that is most inside the limits."""
    middle = vector(_middle(limits[0]), _middle(limits[1]), _middle(limits[2]))
    found, other = _near(found, middle), _near(other, middle)
    return other if _excess(other, limits) < _excess(found, limits) else found


@compiled
def _steady(found: FloatArray, before: FloatArray, lock: float, handed: float, lost: float) -> None:
    """Let ``handed · first + lost · third``, which is lost in noise, follow slowly; changes ``found``."""
    change = handed * (before[0] - found[0]) + lost * (before[2] - found[2])
    correction = 0.5 * (1.0 - (lock / GIMBAL_ZONE) ** 2) * change
    found[0] += handed * correction
    found[2] += lost * correction


@compiled
def _half_angles(q: FloatArray, axes: IntArray) -> tuple[float, float, float, float, float]:
    """Return half sum and half difference of ``handed · first`` and third, middle in [0, π], handed, middle's
    shift.

    The source's rotations are about fixed axes, ours about moving ones: its first is our third.
    """
    i, j, k = axes[2], axes[1], axes[0]
    # Where first and third axis are the same, the third direction follows from the other two.
    is_cardan = i != k
    if not is_cardan:
        k = 3 - i - j
    parity = float((i - j) * (j - k) * (k - i)) / 2.0
    w, x, y, z = q[0], q[1 + i], q[1 + j], parity * q[1 + k]
    if is_cardan:
        a, b, c, d = w - y, x + z, y + w, z - x
    else:
        a, b, c, d = w, x, y, z
    middle = 2.0 * math.atan2(math.sqrt(c * c + d * d), math.sqrt(a * a + b * b))
    half_sum, half_difference = math.atan2(b, a), math.atan2(d, c)
    if is_cardan:
        return half_sum, half_difference, middle, parity, 0.5 * math.pi
    return half_sum, half_difference, middle, 1.0, 0.0


@compiled
def _swing_twist(q: FloatArray, axes: IntArray, before: FloatArray) -> tuple[FloatArray, float]:
    along = q[1 + axes[2]]
    length = math.sqrt(q[0] * q[0] + along * along)
    twist = np.zeros(4)
    # Swung by half a turn, every twist would do: zero is taken.
    twist[0], twist[1 + axes[2]] = (q[0] / length, along / length) if length > 0.0 else (1.0, 0.0)
    angle = 2.0 * math.atan2(along, q[0])
    swing = quaternion.to_rotation_vector(quaternion.multiply(q, quaternion.conjugate(twist)))
    lock = 2.0 * math.asin(min(1.0, length))
    if math.isfinite(before[2]):
        angle = nearest_turn(angle, before[2])
        if lock < GIMBAL_ZONE:
            # Near the singularity noise would turn the twist about: it follows the less the nearer it is.
            angle = before[2] + (lock / GIMBAL_ZONE) ** 2 * (angle - before[2])
    else:
        angle = nearest_turn(angle, 0.0)
    return vector(swing[axes[0]], swing[axes[1]], angle), lock


@compiled
def _middle(limits: FloatArray) -> float:
    middle: float = 0.5 * (limits[0] + limits[1])
    return middle if math.isfinite(middle) else 0.0


@compiled
def _brought_back(angle: float, limits: FloatArray) -> float:
    """Return a limited angle that has gone round by more than a turn, back by whole turns."""
    if not math.isfinite(limits[0] + limits[1]) or abs(angle - _middle(limits)) <= _TURN:
        return angle
    return nearest_turn(angle, _middle(limits))


@compiled
def _near(angles: FloatArray, to: FloatArray) -> FloatArray:
    return vector(
        nearest_turn(angles[0], to[0]), nearest_turn(angles[1], to[1]), nearest_turn(angles[2], to[2])
    )


@compiled
def _distance(a: FloatArray, b: FloatArray) -> float:
    d = a - b
    return dot(d, d)


@compiled
def _excess(angles: FloatArray, limits: FloatArray) -> float:
    """Return how far outside the limits, squared; among equals the one nearer their middles."""
    total = 0.0
    for i in range(3):
        out = max(limits[i, 0] - angles[i], angles[i] - limits[i, 1], 0.0)
        total += out * out + 1e-3 * (angles[i] - _middle(limits[i])) ** 2
    return total


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
    for turn in vectors:
        q = quaternion.multiply(q, quaternion.from_rotation_vector(turn))
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
