"""Operator 3 without gyrometers: the orientation of a segment whose module sits off the joint.

The equations of one instant t_k, with s = a_n − g; all vectors but s and h in segment axes:

    (f)  f = R_kᵀ s + [ω̇, ω] ⊳ U        (x)  x = R_kᵀ h
    ω_k = log(R_{k−1}ᵀ R_k) / Δt          ω̇_k = (ω_k − ω_{k−1}) / Δt

Why they cannot be solved with the two earlier orientations taken as exact. Through ω̇, (f) reacts to
R_k with |U|/Δt² (77 000 m/s² a radian at 0.12 m and 800 Hz), to gravity with 9.8. Putting the last ω̇ into
(f) and iterating therefore diverges; solving for R_k exactly amounts to integrating a pendulum. Let φ be
a small error about h (x holds the two others), c = x × U, y = R_kᵀ s. Of (f) there remains
  along h: nothing, a turn of the whole motion about h changes nothing;
  along U: 0 = (y × x)·U φ − 2 (ω × U)·c φ̇           without ω̇, since U·(ω̇ × U) = 0;
  along c: 0 = (y × x)·c φ + |c|² φ̈ + …               a pendulum, upside down where U lies along y.
The last grows like exp(t √(|y|/|U|)), nine-fold in a quarter of a second. Only the one along U
holds φ to the truth. (Measured: the four-segment arm of the tests is off by more than 100° after 2 s.)

What is done. The two earlier orientations come with their uncertainty: (R_{k−1}, R_{k−2}), or what is the
same, (R_{k−1}, ω_{k−1}), has errors (δ, ν) of covariance P (6 × 6). Unknown at t_k are these six and ω̇_k,
linked by the differences above and by nothing else; (f) and (x) are six more rows. Their weighted
least squares is one Kalman update in nine unknowns. Rows heavy in derivatives then act as a prediction,
the others correct, and P knows in which direction which is the case. The warm start is a constant rate;
(f) is linear in ω̇ and R_k so near that one Gauss–Newton step suffices.

Not observable: at rest with f, U and x in one plane, (y × x)·U = 0, and nothing holds φ. From a start that
is 1° wrong about h (0.12 m, 200 Hz, 25° dip): module across that plane, 0.01° after a quarter of a second;
hanging below the joint, it swings within 0.8° and dies away in 5 s; above the joint 5° after half a
second and 14° after 10 s; on the horizontal north of it, lost after 2 s. The arm of the tests, whose modules
lie east of its joints, holds over 30 s; a trunk that sways with its module north of or above the hip does
not (15° RMS within 3 s). A prior of 30 rad/s² on ω̇ across U was tried: it keeps that trunk within 2.5°, and
loses the arm at 1600 Hz. Upright segments need gyrometers, or a module on the joint.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.derivatives import point_acceleration
from gateway.geometry.vectors import cross, norm, skew


class Weights(NamedTuple):
    """Standard deviations that weigh the rows against each other."""

    specific_force_sigma: float
    """m/s²: accelerometer, and what backward differences miss."""
    direction_sigma: float
    """rad: direction of sensor X."""
    second_difference_sigma: float
    """rad: ω̇ Δt² about zero. Well above ``direction_sigma`` it leaves ω̇ to the equations."""


class Rotation(NamedTuple):
    """Orientation of one segment with its derivatives and their uncertainty."""

    R: FloatArray  # (3, 3) segment to world
    rate: FloatArray  # (3,) ω over the last step, rad/s
    rate_derivative: FloatArray  # (3,) ω̇, rad/s²
    covariance: FloatArray  # (6, 6) of the errors of R (rad) and rate (rad/s), segment axes


@compiled
def next_rotation(
    before: Rotation,
    dt_before: float,
    dt: float,
    f: FloatArray,
    x: FloatArray,
    s_w: FloatArray,
    h_w: FloatArray,
    U: FloatArray,
    weights: Weights,
) -> Rotation:
    """The orientation at t_k from the one before and the module's reading.

    f (3,) specific force, m/s²; x, h_w (3,) sensor X and its field in the world, any length;
    s_w (3,) a_n − g, world; U (3,) joint to module. dt: t_k − t_{k−1}, dt_before: t_{k−1} − t_{k−2}, s.
    """
    w = before.rate
    turn = rotation_matrix.from_rotation_vector(w * dt)
    R = rotation_matrix.multiply(before.R, turn)
    P = _predicted_covariance(before.covariance, turn, w, dt, 0.5 * (dt_before + dt), weights)

    y, direction = rotation_matrix.rotate_inverse(R, s_w), rotation_matrix.rotate_inverse(R, h_w / norm(h_w))
    force_residual = f - y - point_acceleration(np.zeros(3), w, U)
    direction_residual = x / norm(x) - direction
    # columns: δ_k, ν_k, ω̇_k
    H = np.zeros((6, 9))
    _put(H, 0, 0, skew(y), 1.0)
    _put(H, 0, 3, skew(cross(w, U)), -1.0)
    _put(H, 0, 3, rotation_matrix.multiply(skew(w), skew(U)), -1.0)
    _put(H, 0, 6, skew(U), -1.0)
    _put(H, 3, 0, skew(direction), 1.0)

    correction = np.zeros(9)
    for i in range(3):
        correction, P = _with_row(correction, P, H[i], force_residual[i], weights.specific_force_sigma)
        correction, P = _with_row(correction, P, H[i + 3], direction_residual[i], weights.direction_sigma)
    R = rotation_matrix.multiply(R, rotation_matrix.from_rotation_vector(correction[:3]))
    return Rotation(R, w + correction[3:6], correction[6:].copy(), P[:6, :6].copy())


@compiled
def _predicted_covariance(
    P: FloatArray, turn: FloatArray, w: FloatArray, dt: float, dt_middles: float, weights: Weights
) -> FloatArray:
    """(9, 9), of (δ_k, ν_k, ω̇_k): ν_k = ν_{k−1} + Δt ω̇_k, δ_k = turnᵀ δ_{k−1} + Δt J ν_k."""
    J = np.eye(3) - 0.5 * dt * skew(w)
    F, Q = np.zeros((9, 9)), np.zeros((9, 9))  # F: from (δ_{k−1}, ν_{k−1}, ω̇_k)
    _put(F, 0, 0, turn.T, 1.0)
    _put(F, 0, 3, J, dt)
    _put(F, 3, 3, np.eye(3), 1.0)
    _put(F, 0, 6, J, dt * dt_middles)
    _put(F, 3, 6, np.eye(3), dt_middles)
    _put(F, 6, 6, np.eye(3), 1.0)
    Q[:6, :6] = P
    _put(Q, 6, 6, np.eye(3), (weights.second_difference_sigma / (dt * dt_middles)) ** 2)
    return _product(_product(F, Q), F.T)


@compiled
def _with_row(
    correction: FloatArray, P: FloatArray, row: FloatArray, residual: float, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """One row more in the least squares; (9,) and (9, 9). Rows with independent errors may come singly."""
    Ph = np.zeros(9)
    for i in range(9):
        for j in range(9):
            Ph[i] += P[i, j] * row[j]
    variance, expected = sigma * sigma, 0.0
    for i in range(9):
        variance += row[i] * Ph[i]
        expected += row[i] * correction[i]
    new_P = np.empty((9, 9))
    for i in range(9):
        for j in range(9):
            new_P[i, j] = P[i, j] - Ph[i] * Ph[j] / variance
    return correction + Ph * ((residual - expected) / variance), new_P


@compiled
def _product(A: FloatArray, B: FloatArray) -> FloatArray:
    """A B, (9, 9); loops compile in a fraction of the time that a call of BLAS takes to compile."""
    C = np.zeros((9, 9))
    for i in range(9):
        for j in range(9):
            for k in range(9):
                C[i, j] += A[i, k] * B[k, j]
    return C


@compiled
def _put(M: FloatArray, row: int, column: int, block: FloatArray, scale: float) -> None:
    """Adds a scaled (3, 3) block to M, in place."""
    for i in range(3):
        for j in range(3):
            M[row + i, column + j] += scale * block[i, j]
