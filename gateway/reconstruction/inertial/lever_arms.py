"""Lever arms that were measured wrong: what of it shows in the motion is found out. Compiled.

The two sides of a joint's row are ``force + K r`` with the swing ``K = R ([ω̇]× + [ω]×²)``. Arms that are off
by ``e`` leave ``u − u_p = … − K e + K_p e_p``: linear in e with coefficients that the motion changes all the
time, so orientation and arms can be told apart. Each joint has a small Kalman filter of its own for its
six components; the orientation error enters it as noise that stays for ``ORIENTATION_MEMORY_S``, and what the
arms are still uncertain of enters the orientation's rows. Directions that never show stay as measured.
Where a fixed point holds a segment, the constant error ``b`` of its accelerometer shows too, as ``R b``
through the low-pass; between two modules it does not show well enough to be of use.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_state import FilterState, Noise
from gateway.reconstruction.inertial.tree_filter import Three

ORIENTATION_MEMORY_S = 1.0


Symmetric = tuple[float, float, float, float, float, float]
"""xx, yy, zz, yz, xz, xy of a (3, 3) matrix: numbers, for which no array has to be made."""


@compiled
def own_covariance(state: FilterState, s: int) -> Symmetric:
    """Of the orientation error of segment s, world axes, rad²."""
    P = state.P[s]
    return P[0, 0], P[1, 1], P[2, 2], P[1, 2], P[0, 2], P[0, 1]


@compiled
def relative_covariance(state: FilterState, s: int, p: int) -> Symmetric:
    """Of the orientation error of segment s against that of p, world axes, rad²."""
    P, P_p, C = state.P[s], state.P[p], state.C[s]
    return (
        P[0, 0] + P_p[0, 0] - C[0, 0] - C[0, 0],
        P[1, 1] + P_p[1, 1] - C[1, 1] - C[1, 1],
        P[2, 2] + P_p[2, 2] - C[2, 2] - C[2, 2],
        P[1, 2] + P_p[1, 2] - C[1, 2] - C[2, 1],
        P[0, 2] + P_p[0, 2] - C[0, 2] - C[2, 0],
        P[0, 1] + P_p[0, 1] - C[0, 1] - C[1, 0],
    )


@compiled
def spread(x: float, y: float, z: float, D: Symmetric) -> Three:
    """Diagonal of ``[v]× D [v]×ᵀ``, v = (x, y, z): what an uncertain orientation makes of a vector."""
    xx, yy, zz, yz, xz, xy = D
    return (
        z * z * yy - 2.0 * y * z * yz + y * y * zz,
        z * z * xx - 2.0 * x * z * xz + x * x * zz,
        y * y * xx - 2.0 * x * y * xy + x * x * yy,
    )


@compiled
def learn_joint_arms(
    state: FilterState,
    noise: Noise,
    s: int,
    p: int,
    u: FloatArray,
    u_p: FloatArray,
    K: FloatArray,
    K_p: FloatArray,
    variance: float,
    at_once: float,
    dt: float,
) -> float:
    """Corrects ``state.arm[s]`` and, in place, the sides u, u_p (3,); K, K_p (3, 3) 1/s², world.

    variance: of a component of the row that comes every dt, (m/s²)²; at_once: of a single one. Returns what
    the arms' uncertainty adds to the former.
    """
    rows = np.empty((3, 6))
    for i in range(3):
        for j in range(3):
            rows[i, j], rows[i, 3 + j] = -K[i, j], K_p[i, j]
    off = spread(
        0.5 * (u[0] + u_p[0]), 0.5 * (u[1] + u_p[1]), 0.5 * (u[2] + u_p[2]), relative_covariance(state, s, p)
    )
    before = state.arm[s].copy()
    added = _learn(
        state.arm[s], state.arm_covariance[s], rows, u - u_p, off, variance, at_once, noise.huber, dt
    )
    for i in range(3):
        for j in range(3):
            u[i] += K[i, j] * (state.arm[s, j] - before[j])
            u_p[i] += K_p[i, j] * (state.arm[s, 3 + j] - before[3 + j])
    return added * noise.row_memory_s / dt


@compiled
def learn_device_arm(
    state: FilterState,
    noise: Noise,
    d: int,
    s: int,
    u: FloatArray,
    y: FloatArray,
    K: FloatArray,
    variance: float,
    at_once: float,
    dt: float,
) -> float:
    """The same of fixed point d of segment s, at which u must be the known y; and ``state.force_bias[s]``."""
    off = spread(y[0], y[1], y[2], own_covariance(state, s))
    rows, x = np.empty((3, 6)), np.empty(6)
    for i in range(3):
        x[i], x[3 + i] = state.device_shift[d, i], state.force_bias[s, i]
        for j in range(3):
            rows[i, j] = -K[i, j]
            # R through the low-pass, whose derivative went through it as the swing
            rows[i, 3 + j] = state.R[s, i, j] - noise.smoothing_s * state.swing[s, i, j]
    before = x.copy()
    added = _learn(x, state.device_covariance[d], rows, u - y, off, variance, at_once, noise.huber, dt)
    for i in range(3):
        state.device_shift[d, i], state.force_bias[s, i] = x[i], x[3 + i]
        for j in range(6):
            u[i] -= rows[i, j] * (x[j] - before[j])
        for j in range(3, 6):  # the averages as if the accelerometer's error had always been known so
            state.force[s, i] -= rows[i, j] * (x[j] - before[j])
            state.last_force[s, i] -= state.R[s, i, j - 3] * (x[j] - before[j])
    return added * noise.row_memory_s / dt


@compiled
def _learn(
    x: FloatArray,
    P: FloatArray,
    rows: FloatArray,
    residual: FloatArray,
    off: Three,
    variance: float,
    at_once: float,
    huber: float,
    dt: float,
) -> float:
    """Three scalar updates of x (m,) and P (m, m) in place by rows (3, m) and their residuals; the mean
    variance that P meant for a component beforehand."""
    m, added = len(x), 0.0
    gain, start = np.empty(m), x.copy()
    for i in range(3):
        for a in range(m):
            for b in range(m):
                added += rows[i, a] * P[a, b] * rows[i, b] / 3.0
    for i in range(3):
        innovation, uncertain = residual[i], 0.0
        for a in range(m):
            innovation -= rows[i, a] * (x[a] - start[a])
            gain[a] = 0.0
            for b in range(m):
                gain[a] += P[a, b] * rows[i, b]
            uncertain += rows[i, a] * gain[a]
        white = variance + off[i] * max(1.0, ORIENTATION_MEMORY_S / dt)
        surprise = abs(innovation) / math.sqrt(at_once + off[i] + uncertain)
        total = uncertain + white * max(1.0, surprise / huber)
        for a in range(m):
            x[a] += gain[a] * innovation / total
            for b in range(m):
                P[a, b] -= gain[a] * gain[b] / total
    return added
