"""Operator 3 without gyrometers: the orientation of a segment whose module sits off the joint.

The equations of one instant t_k, s = a_n − g, all else in segment axes:

    (f)  f = R_kᵀ s + [ω̇, ω] ⊳ U        (x)  x = R_kᵀ h
    ω_k = log(R_{k−1}ᵀ R_k) / Δt          ω̇_k = (ω_k − ω_{k−1}) / Δt

Why they cannot be solved with the two earlier orientations taken as exact. Through ω̇, (f) reacts to R_k
with |U|/Δt² (77 000 m/s² a radian at 0.12 m and 800 Hz) against |g| = 9.8 for what gravity says. Iterating
R_k ← (f, x; ω̇ of the last R_k) therefore diverges, and solving for R_k exactly integrates a pendulum.
Let φ be a small error about h (the two others are held by x), c = x̂ × U. The three components of (f) are
  along h : no φ at all (a turn of the whole motion about h changes nothing);
  along U : 0 = (R_kᵀs × x̂)·U φ − 2 (ω × U)·c φ̇            — no ω̇, since U·(ω̇ × U) = 0;
  along c : 0 = (R_kᵀs × x̂)·c φ + |c|² φ̈ + …                — an upside-down pendulum where U lies along s.
The second grows like exp(t √(|s|/|U|)), nine-fold in a quarter of a second; only the first holds φ to the truth.

What is done. The two earlier orientations are given with their uncertainty: (R_{k−1}, R_{k−2}), equivalently
(R_{k−1}, ω_{k−1}), has errors (δ, ν) with covariance P (6 × 6). The unknowns of t_k are then these six and ω̇_k,
with the equations above as the only link, and (f), (x) are six more rows with the sensors' variances. Their weighted least squares
is one Kalman update in nine unknowns. Rows heavy in derivatives act as prediction, the others
correct, and P says in which direction which is the case. Prediction is at constant rate (the warm start);
(f) is linear in ω̇, and R_k is so near that a second Gauss–Newton step changes nothing measurable.

Not observable: where f, U and x lie in one plane, (R_kᵀs × x̂)·U = 0 and (f) along U no longer holds φ while
the segment rests: the error then swings (module hanging below the joint) or runs away (above it), until it moves.
``rate_derivative_sigma`` is what bounds this: the prior standard deviation of ω̇ about zero.
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
    residual = np.empty(6)
    residual[:3] = f - y - point_acceleration(np.zeros(3), w, U)
    residual[3:] = x / norm(x) - direction
    H = np.zeros((6, 9))
    H[:3, :3] = skew(y)
    H[:3, 3:6] = -skew(cross(w, U)) - skew(w) @ skew(U)
    H[:3, 6:] = -skew(U)
    H[3:, :3] = skew(direction)

    variance = np.empty(6)
    variance[:3], variance[3:] = weights.specific_force_sigma**2, weights.direction_sigma**2
    PHt = P @ H.T
    K = np.linalg.solve(H @ PHt + np.diag(variance), PHt.T).T
    correction = K @ residual
    P = _joseph(P, K, H, variance)
    R = rotation_matrix.multiply(R, rotation_matrix.from_rotation_vector(correction[:3]))
    return Rotation(R, w + correction[3:6], correction[6:].copy(), P[:6, :6].copy())


@compiled
def _predicted_covariance(
    P: FloatArray, turn: FloatArray, w: FloatArray, dt: float, dt_middles: float, weights: Weights
) -> FloatArray:
    """(9, 9), of (δ_k, ν_k, ω̇_k): ν_k = ν_{k−1} + Δt ω̇_k, δ_k = turnᵀ δ_{k−1} + Δt J ν_k."""
    J = np.eye(3) - 0.5 * dt * skew(w)
    F = np.zeros((9, 6))
    F[:3, :3], F[:3, 3:], F[3:6, 3:] = turn.T, dt * J, np.eye(3)
    G = np.zeros((9, 3))
    G[:3], G[3:6], G[6:] = dt * dt_middles * J, dt_middles * np.eye(3), np.eye(3)
    rate_derivative_sigma = weights.second_difference_sigma / (dt * dt_middles)
    return F @ P @ F.T + rate_derivative_sigma**2 * (G @ G.T)


@compiled
def _joseph(P: FloatArray, K: FloatArray, H: FloatArray, variance: FloatArray) -> FloatArray:
    """(I − K H) P (I − K H)ᵀ + K diag(variance) Kᵀ: stays symmetric and positive whatever K's rounding."""
    A = np.eye(9) - K @ H
    return A @ P @ A.T + (K * variance) @ K.T
