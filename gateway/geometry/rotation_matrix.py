"""Rotation matrices: exponential, logarithm of a product, and the two-vector solve. Compiled.

``…_into`` and ``turn…`` write to the array that is given and make none, for loops over many segments.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import cross, norm, vector

PARALLEL = 1e-3
"""Sine of the angle under which two directions no longer define an orientation."""

SMALL_TURN = 0.5
"""rad: up to there seven terms of the series have all digits, in a third of the time."""


@compiled
def from_rotation_vector(r: FloatArray) -> FloatArray:
    """Return the exponential (Rodrigues); shape (3,) -> (3, 3)."""
    R = np.empty((3, 3))
    exponential_into(R, r[0], r[1], r[2])
    return R


@compiled
def exponential_into(R: FloatArray, x: float, y: float, z: float) -> None:
    """Write R ← exp([r]×), r = (x, y, z) rad; (3, 3)."""
    q = x * x + y * y + z * z
    if q < SMALL_TURN**2:  # sin a / a and (1 − cos a) / a²
        a = 1.0 - q * (1 / 72) * (1.0 - q * (1 / 110) * (1.0 - q * (1 / 156)))
        a = 1.0 - q * (1 / 6) * (1.0 - q * (1 / 20) * (1.0 - q * (1 / 42) * a))
        b = 1.0 - q * (1 / 90) * (1.0 - q * (1 / 132) * (1.0 - q * (1 / 182)))
        b = 0.5 * (1.0 - q * (1 / 12) * (1.0 - q * (1 / 30) * (1.0 - q * (1 / 56) * b)))
    else:
        angle = math.sqrt(q)
        # 1 − cos a = 2 sin²(a/2): no cancellation at small angles
        half = math.sin(0.5 * angle) / (0.5 * angle)
        a = math.sin(angle) / angle
        b = 0.5 * half * half
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    R[1, 0], R[1, 1], R[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    R[2, 0], R[2, 1], R[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)


@compiled
def multiply(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return a B; shapes (3, 3), (3, 3) -> (3, 3)."""
    C = np.empty((3, 3))
    multiply_into(C, A, B)
    return C


@compiled
def multiply_into(C: FloatArray, A: FloatArray, B: FloatArray) -> None:
    """Write C ← A B; shapes (3, 3). C is neither A nor B."""
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@compiled
def copy_into(C: FloatArray, A: FloatArray) -> None:
    """Write C ← A; shapes (3, 3)."""
    for i in range(3):
        for j in range(3):
            C[i, j] = A[i, j]


@compiled
def turn(E: FloatArray, v: FloatArray) -> None:
    """Rotate v ← E v in place; shapes (3, 3), (3,)."""
    rotate_into(v, E, v)


@compiled
def rotate_into(v_a: FloatArray, R_ab: FloatArray, v_b: FloatArray) -> None:
    """Write v_a ← R_ab v_b; shapes (3,), (3, 3), (3,); v_a may be v_b."""
    x, y, z = v_b[0], v_b[1], v_b[2]
    for i in range(3):
        v_a[i] = R_ab[i, 0] * x + R_ab[i, 1] * y + R_ab[i, 2] * z


@compiled
def turn_columns(E: FloatArray, R: FloatArray) -> None:
    """Rotate R ← E R in place; shapes (3, 3)."""
    for j in range(3):
        x, y, z = R[0, j], R[1, j], R[2, j]
        for i in range(3):
            R[i, j] = E[i, 0] * x + E[i, 1] * y + E[i, 2] * z


@compiled
def turn_rows(R: FloatArray, E: FloatArray) -> None:
    """Rotate R ← R E in place; shapes (3, 3)."""
    for i in range(3):
        x, y, z = R[i, 0], R[i, 1], R[i, 2]
        for j in range(3):
            R[i, j] = x * E[0, j] + y * E[1, j] + z * E[2, j]


@compiled
def rotate(R_ab: FloatArray, v_b: FloatArray) -> FloatArray:
    """Return v_a; shapes (3, 3), (3,) -> (3,)."""
    return vector(
        R_ab[0, 0] * v_b[0] + R_ab[0, 1] * v_b[1] + R_ab[0, 2] * v_b[2],
        R_ab[1, 0] * v_b[0] + R_ab[1, 1] * v_b[1] + R_ab[1, 2] * v_b[2],
        R_ab[2, 0] * v_b[0] + R_ab[2, 1] * v_b[1] + R_ab[2, 2] * v_b[2],
    )


@compiled
def rotate_inverse(R_ab: FloatArray, v_a: FloatArray) -> FloatArray:
    """Return v_b; shapes (3, 3), (3,) -> (3,)."""
    return vector(
        R_ab[0, 0] * v_a[0] + R_ab[1, 0] * v_a[1] + R_ab[2, 0] * v_a[2],
        R_ab[0, 1] * v_a[0] + R_ab[1, 1] * v_a[1] + R_ab[2, 1] * v_a[2],
        R_ab[0, 2] * v_a[0] + R_ab[1, 2] * v_a[1] + R_ab[2, 2] * v_a[2],
    )


@compiled
def increment(R_wa: FloatArray, R_wb: FloatArray) -> FloatArray:
    """Return log(R_waᵀ R_wb): the rotation vector from orientation a to b, in axes of a (and of b), rad.

    Shapes (3, 3), (3, 3) -> (3,). The product is taken as I + R_waᵀ (R_wb − R_wa), whose subtraction
    is exact for neighbouring orientations, and the angle from the sine and the cosine together, so that
    only the rounding already in the two matrices is left in the result.
    """
    D = R_wb - R_wa
    M = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            M[i, j] = R_wa[0, i] * D[0, j] + R_wa[1, i] * D[1, j] + R_wa[2, i] * D[2, j]
    v = vector(0.5 * (M[2, 1] - M[1, 2]), 0.5 * (M[0, 2] - M[2, 0]), 0.5 * (M[1, 0] - M[0, 1]))
    sine, cosine = norm(v), 1.0 + 0.5 * (M[0, 0] + M[1, 1] + M[2, 2])
    return v * (math.atan2(sine, cosine) / sine if sine > 0.0 else 1.0)


@compiled
def from_two_vectors(
    primary_b: FloatArray, secondary_b: FloatArray, primary_w: FloatArray, secondary_w: FloatArray
) -> FloatArray:
    """Return R_wb from two directions seen in both coordinates (TRIAD, Black 1964); lengths do not matter.

    Shapes four times (3,) -> (3, 3). The primary pair is met exactly; of the secondary only the part
    across the primary is used. All NaN when the two are closer to parallel than ``PARALLEL``.
    """
    B = _triad(primary_b, secondary_b)
    W = _triad(primary_w, secondary_w)
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = W[0, i] * B[0, j] + W[1, i] * B[1, j] + W[2, i] * B[2, j]
    return R


@compiled
def _triad(primary: FloatArray, secondary: FloatArray) -> FloatArray:
    """Return orthonormal rows: along the primary, across both, and what completes them."""
    T, across = np.empty((3, 3)), cross(primary, secondary)
    length, across_length = norm(primary), norm(across)
    lengths = length * norm(secondary)
    is_defined = across_length > PARALLEL * lengths and lengths > 0.0
    for i in range(3):
        T[0, i] = primary[i] / length if is_defined else np.nan
        T[1, i] = across[i] / across_length if is_defined else np.nan
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        # The cross product of the first two rows, component by component.
        T[2, i] = T[0, j] * T[1, k] - T[0, k] * T[1, j]
    return T
