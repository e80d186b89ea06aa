"""Exact kinematics of a tree of rigid segments: the truth that a reconstruction is measured against.

Every joint is a sequence of rotations about coordinate axes. Passing a rotation ``E`` about the axis
``e`` by the angle θ, the orientation becomes ``R E`` and the rates, in the axes after the rotation,

    ω' = Eᵀω + θ̇ e          ω̇' = Eᵀω̇ + θ̈ e − θ̇ e × Eᵀω        (d/dt of the line before; Ėᵀ = −θ̇ [e]× Eᵀ)

and passing a lever arm ``r`` of the segment

    v' = v + R (ω × r)       a' = a + R (ω̇ × r + ω × (ω × r)).

All is vectorised over times and over paths through the tree, so that every module is evaluated at its
own sampling instants at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from devices.deferred import Rotation
from devices.emulators.bodies import EmulatedBody, FloatArray, IntArray
from devices.emulators.motion.waves import Derivatives, Fade


@dataclass(frozen=True)
class MotionState:
    """The motion of M segments at T times; world ENU, SI."""

    R_wb: FloatArray  # (T, M, 3, 3) segment to world
    angular_rate: FloatArray  # (T, M, 3) rad/s, segment axes
    angular_acceleration: FloatArray  # (T, M, 3) rad/s², segment axes
    joint_position: FloatArray  # (T, M, 3) m, proximal joint, world axes
    joint_velocity: FloatArray  # (T, M, 3) m/s
    joint_acceleration: FloatArray  # (T, M, 3) m/s², without gravity

    @property
    def q_wb(self) -> FloatArray:
        """(T, M, 4) segment to world, wxyz, w >= 0."""
        shape = self.R_wb.shape[:2]
        rotation = Rotation.from_matrix(self.R_wb.reshape(-1, 3, 3).astype(np.float64))
        q: FloatArray = rotation.as_quat(canonical=True, scalar_first=True)
        return q.reshape(*shape, 4)


class _Moving(NamedTuple):
    """Axes in motion. Components first, so that each is a contiguous array of (T, M)."""

    R: list[FloatArray]  # three columns, each (3, T, M): the axes in the world
    omega: FloatArray  # (3, T, M) in these axes
    alpha: FloatArray  # (3, T, M)
    p: FloatArray  # (3, T, M) in the world
    v: FloatArray
    a: FloatArray


class JointAngles(Protocol):
    """Rotations of segments against their parents, by segment."""

    def with_idle_row(self) -> JointAngles:
        """Return the angles with one node more, which never turns."""

    def rows(self, rows: IntArray) -> JointAngles:
        """Return the angles of some nodes only, in that order."""

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return the angles about x, y and z at ``times`` (T, N), rad, each (T, N), with derivatives."""


class RootPath(Protocol):
    """Where the root's joint is, and about the vertical how far its axes are turned."""

    def evaluate(self, times: FloatArray, fade: Derivatives) -> list[Derivatives]:
        """Return the place's three components at ``times`` (T, N), m, each (T, N), with derivatives."""

    def heading(self, times: FloatArray) -> Derivatives:
        """Return the heading at ``times``, rad, with derivatives."""


class TreeKinematics:
    """Joint angles to segment motion, for one body.

    rotation_order: the coordinate axes about which each joint turns, in order: (2, 0, 1) is z-x'-y''.
    """

    def __init__(
        self,
        body: EmulatedBody,
        joint_angles: JointAngles,
        root_path: RootPath,
        fade: Fade,
        rotation_order: tuple[int, ...],
    ) -> None:
        self._angles = joint_angles.with_idle_row()
        self._root_path = root_path
        self._fade = fade
        self._order = rotation_order
        self._idle = body.n_segments
        reference = Rotation.from_quat(body.reference_posture, scalar_first=True)
        parents = body.parents
        relative = [
            (reference[n] if parents[n] < 0 else reference[parents[n]].inv() * reference[n]).as_matrix()
            for n in range(body.n_segments)
        ]
        self._relative = np.array([*relative, np.eye(3)])  # (S+1, 3, 3)
        self._offsets = np.vstack([body.offsets, np.zeros(3)])  # (S+1, 3)
        self._paths = [body.path(n) for n in range(body.n_segments)]

    def state(self, segments: IntArray, times: FloatArray) -> MotionState:
        """Return the motion of ``segments`` (M,), each at its own times (T, M), s."""
        paths = self._padded_paths(segments)
        fade = self._fade.evaluate(times)
        moving = self._origin(times, fade)
        for nodes in paths.T:
            moving = _displace(moving, self._offsets[nodes])
            moving = _turn_constant(moving, self._relative[nodes])
            angles = self._angles.rows(nodes).evaluate(times, fade)
            for axis in self._order:
                moving = _turn(moving, axis, angles[axis])
        return MotionState(
            np.ascontiguousarray(np.moveaxis(np.stack(moving.R, axis=1), (0, 1), (2, 3))),
            *(np.ascontiguousarray(np.moveaxis(x, 0, -1)) for x in moving[1:]),
        )

    def _padded_paths(self, segments: IntArray) -> IntArray:
        """Return paths (M, depth) from root to segment; shorter ones end in a node that does not move."""
        paths = [self._paths[n] for n in segments]
        depth = max(map(len, paths))
        return np.array([path + [self._idle] * (depth - len(path)) for path in paths], dtype=np.int64)

    def _origin(self, times: FloatArray, fade: Derivatives) -> _Moving:
        components = self._root_path.evaluate(times, fade)
        p, v, a = (np.stack([c[i] for c in components]) for i in range(3))
        columns = [np.zeros((3, *times.shape), times.dtype) for _ in range(3)]
        for axis in range(3):
            columns[axis][axis] = 1.0
        still = np.zeros((3, *times.shape), times.dtype)
        moving = _Moving(columns, still, still.copy(), p, v, a)
        heading = self._root_path.heading(times)
        return _turn(moving, 2, heading) if heading.value.any() else moving


def _turn(moving: _Moving, axis: int, theta: Derivatives) -> _Moving:
    """Return axes after a rotation about one of their own coordinate axes."""
    j, k = (axis + 1) % 3, (axis + 2) % 3
    c, s = np.cos(theta.value), np.sin(theta.value)
    R = list(moving.R)
    R[j], R[k] = c * R[j] + s * R[k], c * R[k] - s * R[j]
    omega, alpha = moving.omega.copy(), moving.alpha.copy()
    for old, new in ((moving.omega, omega), (moving.alpha, alpha)):  # Eᵀ
        new[j], new[k] = c * old[j] + s * old[k], c * old[k] - s * old[j]
    alpha[axis] += theta.acceleration
    alpha[j] += theta.rate * omega[k]  # −θ̇ e × Eᵀω
    alpha[k] -= theta.rate * omega[j]
    omega[axis] += theta.rate
    return moving._replace(R=R, omega=omega, alpha=alpha)


def _turn_constant(moving: _Moving, C: FloatArray) -> _Moving:
    """Return axes after a constant rotation C (M, 3, 3)."""
    if np.array_equal(C, np.broadcast_to(np.eye(3), C.shape)):
        return moving
    return moving._replace(
        R=[_combined(moving.R, C[:, :, j]) for j in range(3)],
        omega=np.stack([_combined(moving.omega, C[:, :, j]) for j in range(3)]),
        alpha=np.stack([_combined(moving.alpha, C[:, :, j]) for j in range(3)]),
    )


def _displace(moving: _Moving, r: FloatArray) -> _Moving:
    """Return the point at the lever arm r (M, 3) of the same rigid segment."""
    # A point on the joint moves as the joint does.
    if not r.any():
        return moving
    arm = np.broadcast_to(r.T[:, None, :], moving.omega.shape)
    swept = _cross(moving.omega, arm)
    lever = _cross(moving.alpha, arm) + _cross(moving.omega, swept)
    return moving._replace(
        p=moving.p + _to_world(moving.R, arm),
        v=moving.v + _to_world(moving.R, swept),
        a=moving.a + _to_world(moving.R, lever),
    )


def _combined(parts: Sequence[FloatArray] | FloatArray, weights: FloatArray) -> FloatArray:
    """Return three arrays (…, M) weighted by the columns of (M, 3) and summed."""
    combined: FloatArray = parts[0] * weights[:, 0] + parts[1] * weights[:, 1] + parts[2] * weights[:, 2]
    return combined


def _to_world(R: list[FloatArray], v: FloatArray) -> FloatArray:
    turned: FloatArray = R[0] * v[0] + R[1] * v[1] + R[2] * v[2]
    return turned


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
    )
