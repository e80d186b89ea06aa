"""A motion as smooth functions of time, with analytic velocities and accelerations.

Rotations stay free of singularities: each joint's quaternion is made continuous, low-passed without lag, and
laid through by a quintic spline in its four components, whose projection onto unit length is the rotation.
Its derivatives are those of that projected curve, exactly; joint angles follow from the same rotations.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from devices.deferred import Rotation, butter, make_interp_spline, sosfiltfilt
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray

DEFAULT_CUTOFF_HZ = 6.0
"""Usual for walking (Winter 2009, ch. 3.4)."""
_ORDER = 2
_DUAL_PASS = (np.sqrt(2.0) - 1.0) ** (-1.0 / (2 * _ORDER))
"""Twice through a Butterworth filter lowers its cut-off by this factor (Winter 2009, eq. 3.13)."""
_FEWEST_FRAMES = 6
_FEWEST_PERIODS = 2.0
"""Of the cut-off, that a motion must last: a shorter one is nothing but the filter's two ends."""


@dataclass(frozen=True)
class SmoothMotion:
    """F instants of S segments. The root's rotation is to the world, others' to their parent."""

    skeleton: Skeleton
    time_s: FloatArray  # (F,)
    cutoff_hz: float | None
    """At half power, forward and backward together; None: as recorded."""
    root: FloatArray  # (F, 3) m
    root_velocity: FloatArray  # (F, 3) m/s
    root_acceleration: FloatArray  # (F, 3) m/s²
    rotation: FloatArray  # (F, S, 4) w x y z, segment to parent (root: to world)
    angular_velocity: FloatArray  # (F, S, 3) rad/s, against the parent, in the segment's axes
    angular_acceleration: FloatArray  # (F, S, 3) rad/s²

    def orientations(self) -> FloatArray:
        """Return (F, S, 4) ``q_wb``."""
        q_wb = np.empty_like(self.rotation)
        for s, parent in enumerate(self.skeleton.parents.tolist()):
            own = self.rotation[:, s]
            q_wb[:, s] = own if parent < 0 else product(q_wb[:, parent], own)
        return q_wb

    def part(self, instants: slice) -> SmoothMotion:
        """Return some of its instants."""
        cut = {
            field.name: getattr(self, field.name)[instants]
            for field in fields(self)
            if field.name not in ("skeleton", "cutoff_hz")
        }
        return replace(self, **cut)


def smooth_motion(
    skeleton: Skeleton, time_s: FloatArray, q_wb: FloatArray, root: FloatArray, cutoff_hz: float | None
) -> SmoothMotion:
    """Return the smooth motion through regular samples without NaN.

    time_s: (F,); q_wb: (F, S, 4) segment to world; root: (F, 3) m, world; cutoff_hz: None: as recorded.

    Raises ``GatewayError`` for fewer than six frames, a motion shorter than two periods of the cut-off, or a
    cut-off at or beyond half the sampling rate.
    """
    if len(time_s) < _FEWEST_FRAMES:
        raise GatewayError(f"{len(time_s)} frames: a motion to be analysed needs {_FEWEST_FRAMES} at least")
    lasts_s = float(time_s[-1] - time_s[0])
    if cutoff_hz is not None and lasts_s < _FEWEST_PERIODS / cutoff_hz:
        raise GatewayError(
            f"{lasts_s:.2f} s of motion is too short for a cut-off of {cutoff_hz:g} Hz: "
            f"{_FEWEST_PERIODS / cutoff_hz:.3g} s at least, or a higher --cutoff (0: none)"
        )
    rate_hz = (len(time_s) - 1) / lasts_s
    turned = _continuous(relative(skeleton, q_wb))
    turned, places = low_pass(turned, rate_hz, cutoff_hz), low_pass(root, rate_hz, cutoff_hz)
    path = make_interp_spline(time_s, places, k=5)
    curve = make_interp_spline(time_s, turned.reshape(len(turned), -1), k=5)
    values, first, second = (curve(time_s, nu).reshape(turned.shape) for nu in range(3))
    rotation, velocity, acceleration = rotation_derivatives(values, first, second)
    return SmoothMotion(
        skeleton=skeleton,
        time_s=time_s,
        cutoff_hz=cutoff_hz,
        root=path(time_s),
        root_velocity=path(time_s, 1),
        root_acceleration=path(time_s, 2),
        rotation=rotation,
        angular_velocity=velocity,
        angular_acceleration=acceleration,
    )


def low_pass(values: FloatArray, rate_hz: float, cutoff_hz: float | None) -> FloatArray:
    """Return values (F, …) after a Butterworth of order 2, forward and backward along the first axis; None:
    unchanged.

    Raises ``GatewayError`` for a cut-off at or beyond half the sampling rate.
    """
    if cutoff_hz is None:
        return values
    corner = cutoff_hz * _DUAL_PASS
    if not 0.0 < corner < 0.5 * rate_hz:
        raise GatewayError(
            f"a cut-off of {cutoff_hz:g} Hz does not go with {rate_hz:g} frames a second: less than "
            f"{0.5 * rate_hz / _DUAL_PASS:.3g} Hz is wanted"
        )
    sections = butter(_ORDER, corner, fs=rate_hz, output="sos")
    filtered: FloatArray = sosfiltfilt(sections, values, axis=0, padlen=min(len(values) - 1, int(rate_hz)))
    return filtered


def rotation_derivatives(
    values: FloatArray, first: FloatArray, second: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return unit quaternion (…, 4), angular velocity and acceleration (…, 3) in the turned axes.

    Of a curve in R⁴ with its derivatives by time: with s = n q, q̇ = (ṡ − ṅ q)/n and so on;
    ω = 2 vec(q* q̇) and ω̇ = 2 vec(q* q̈), as q̇* q̇ is a scalar.
    """
    n = np.linalg.norm(values, axis=-1, keepdims=True)
    q = values / n
    n1 = np.sum(q * first, axis=-1, keepdims=True)
    n2 = (np.sum(first * first + values * second, axis=-1, keepdims=True) - n1 * n1) / n
    q1 = (first - n1 * q) / n
    q2 = (second - 2.0 * n1 * q1 - n2 * q) / n
    inverse = conjugate(q)
    return q, 2.0 * product(inverse, q1)[..., 1:], 2.0 * product(inverse, q2)[..., 1:]


def product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return Hamilton products of quaternions (…, 4)."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    turned: FloatArray = np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )
    return turned


def conjugate(q: FloatArray) -> FloatArray:
    """Return the conjugates of quaternions (…, 4)."""
    turned: FloatArray = q * np.array([1.0, -1.0, -1.0, -1.0])
    return turned


def matrices(q: FloatArray) -> FloatArray:
    """Return (…, 3, 3) of quaternions (…, 4)."""
    turned: FloatArray = Rotation.from_quat(q.reshape(-1, 4), scalar_first=True).as_matrix()
    shaped: FloatArray = turned.reshape(*q.shape[:-1], 3, 3)
    return shaped


def relative(skeleton: Skeleton, q_wb: FloatArray) -> FloatArray:
    """Return (F, S, 4) of each segment to its parent, of the root to the world. q_wb: (F, S, 4)."""
    turned = q_wb.copy()
    for s, parent in enumerate(skeleton.parents.tolist()):
        if parent >= 0:
            turned[:, s] = product(conjugate(q_wb[:, parent]), q_wb[:, s])
    return turned


def _continuous(q: FloatArray) -> FloatArray:
    """Return of each rotation's two quaternions the one nearer to that of the instant before, (F, S, 4)."""
    flips = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0.0, -1.0, 1.0)
    signs = np.concatenate([np.ones((1, q.shape[1])), np.cumprod(flips, axis=0)])
    continuous: FloatArray = q * signs[:, :, None]
    return continuous
