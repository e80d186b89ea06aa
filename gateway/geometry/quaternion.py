"""Unit quaternions, Hamilton, (w, x, y, z). Compiled; arguments are never changed.

``q_ab`` takes coordinates in b to coordinates in a, so neighbours cancel:
``q_ac = multiply(q_ab, q_bc)`` and ``v_a = rotate(q_ab, v_b)``.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray, Vector3
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import vector


@compiled
def quaternion(w: float, x: float, y: float, z: float) -> FloatArray:
    """Return a new (4,) array; not normalised."""
    q = np.empty(4)
    q[0], q[1], q[2], q[3] = w, x, y, z
    return q


@compiled
def multiply(q_ab: FloatArray, q_bc: FloatArray) -> FloatArray:
    """Return q_ac; shapes (4,), (4,) -> (4,)."""
    aw, ax, ay, az = q_ab
    bw, bx, by, bz = q_bc
    return quaternion(
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


@compiled
def conjugate(q_ab: FloatArray) -> FloatArray:
    """Return q_ba; shape (4,) -> (4,)."""
    return quaternion(q_ab[0], -q_ab[1], -q_ab[2], -q_ab[3])


@compiled
def rotate(q_ab: FloatArray, v_b: FloatArray) -> FloatArray:
    """Return v_a; shapes (4,), (3,) -> (3,)."""
    v_a = np.empty(3)
    rotate_into(v_a, q_ab, v_b)
    return v_a


@compiled
def rotate_into(v_a: FloatArray, q_ab: FloatArray, v_b: FloatArray | Vector3) -> None:
    """Write v_b (3,), rotated as ``rotate`` does, into v_a (3,), which must not be v_b."""
    w, x, y, z = q_ab[0], q_ab[1], q_ab[2], q_ab[3]
    # t = 2 u × v;  v' = v + w t + u × t
    tx = 2.0 * (y * v_b[2] - z * v_b[1])
    ty = 2.0 * (z * v_b[0] - x * v_b[2])
    tz = 2.0 * (x * v_b[1] - y * v_b[0])
    v_a[0] = v_b[0] + w * tx + y * tz - z * ty
    v_a[1] = v_b[1] + w * ty + z * tx - x * tz
    v_a[2] = v_b[2] + w * tz + x * ty - y * tx


@compiled
def rotate_inverse(q_ab: FloatArray, v_a: FloatArray) -> FloatArray:
    """Return v_b; shapes (4,), (3,) -> (3,)."""
    return rotate(conjugate(q_ab), v_a)


@compiled
def normalise(q: FloatArray) -> FloatArray:
    """Return unit length; shape (4,) -> (4,). NaN for a quaternion of zeros."""
    return q / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])


@compiled
def canonical(q: FloatArray) -> FloatArray:
    """Return the one of q and −q with w ≥ 0; shape (4,) -> (4,)."""
    return -q if q[0] < 0.0 else q.copy()


@compiled
def from_rotation_vector(r: FloatArray) -> FloatArray:
    """Return the exponential: rotation by |r| rad about r; shape (3,) -> (4,)."""
    angle = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    # sin(a/2) / a loses nothing at small angles, only at a = 0 is it not defined
    scale = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.5
    return quaternion(math.cos(0.5 * angle), scale * r[0], scale * r[1], scale * r[2])


@compiled
def to_rotation_vector(q: FloatArray) -> FloatArray:
    """Return the logarithm, the short way round (|r| ≤ π rad); shape (4,) -> (3,)."""
    w = abs(q[0])
    sign = -1.0 if q[0] < 0.0 else 1.0
    sine = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    # atan2 of the vector part keeps full precision at small angles; acos(w) would keep half the digits
    scale = sign * 2.0 * (math.atan2(sine, w) / sine if sine > 0.0 else 1.0)
    return vector(scale * q[1], scale * q[2], scale * q[3])


@compiled
def angle_between(q_wa: FloatArray, q_wb: FloatArray) -> float:
    """Return angle of the rotation between two orientations, 0 to π rad; shapes (4,), (4,)."""
    difference = multiply(conjugate(q_wa), q_wb)
    x, y, z = difference[1], difference[2], difference[3]
    return 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(difference[0]))


@compiled
def slerp(q_wa: FloatArray, q_wb: FloatArray, fraction: float) -> FloatArray:
    """Return the orientation at ``fraction`` of the short way from a to b; shapes (4,), (4,) -> (4,)."""
    step = to_rotation_vector(multiply(conjugate(q_wa), q_wb))
    return normalise(multiply(q_wa, from_rotation_vector(fraction * step)))


@compiled
def to_matrix(q_ab: FloatArray) -> FloatArray:
    """Return R_ab with v_a = R_ab v_b; shape (4,) -> (3, 3)."""
    w, x, y, z = q_ab
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
    return R


@compiled
def from_matrix(R_ab: FloatArray) -> FloatArray:
    """Return q_ab, unit, w ≥ 0; shape (3, 3) -> (4,)."""
    q = np.empty(4)
    from_matrix_into(q, R_ab)
    return q


@compiled
def from_matrix_into(q_ab: FloatArray, R_ab: FloatArray) -> None:
    """Write what ``from_matrix`` returns into a given array (4,).

    Shepperd's method: the largest of the four components is taken from the diagonal, the others
    from sums and differences, so nothing is divided by a small number.
    """
    R = R_ab
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > max(R[0, 0], R[1, 1], R[2, 2]):
        w, x, y, z = 1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        x = 1.0 + R[0, 0] - R[1, 1] - R[2, 2]
        w, y, z = R[2, 1] - R[1, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]
    elif R[1, 1] >= R[2, 2]:
        y = 1.0 + R[1, 1] - R[0, 0] - R[2, 2]
        w, x, z = R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], R[1, 2] + R[2, 1]
    else:
        z = 1.0 + R[2, 2] - R[0, 0] - R[1, 1]
        w, x, y = R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    # Of q and -q the one with w ≥ 0, as everywhere here.
    if w < 0.0:
        length = -length
    q_ab[0], q_ab[1], q_ab[2], q_ab[3] = w / length, x / length, y / length, z / length
