"""Lever arms that were measured wrong: what of it shows in the motion is found out. Compiled.

The two sides of a joint's row are ``force + K r`` with the swing ``K = R ([ω̇]× + [ω]×²)``. Arms that are off
by ``e`` leave ``u − u_p = … − K e + K_p e_p``: linear in e with coefficients that the motion changes all the
time, so orientation and arms can be told apart. Each joint has a small Kalman filter of its own for its
six components; the orientation error enters it as noise that stays for a while, and what the
arms are still uncertain of enters the orientation's rows. Directions that never show stay as measured.
Where a segment has a local device, the place of that on it is found in the same way, and the constant error
``b`` of the accelerometer shows too, as ``R b`` averaged as the row is; between two modules it does not show
well enough to be of use.
A joint's rows are correlated over the low-pass, so what they say of constants is asked every ``LEARN_S``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.blocks import times_vector_into
from gateway.reconstruction.inertial.chain_state import FilterState, Noise
from gateway.reconstruction.inertial.local_rows import LocalPair
from gateway.reconstruction.inertial.tree_filter import Three

POINT_MEMORY_S = 1.0
"""For which an orientation error stays where a point of the body is known: a constant error of the
accelerometer looks much the same. Between two modules it stays no longer than other errors of a row."""
LEARN_S = 0.025
"""How often a joint is asked, at most: half the low-pass' time constant, a quarter of what rows share."""
PHASES = 3
"""Joints take turns, so that no frame has all the work."""


class Learning(NamedTuple):
    """What learning works in."""

    rows: FloatArray  # (3, 6) of the observation
    gains: FloatArray  # (3, 6) covariance of each row's value with what is learnt, after the rows before it
    scaled: FloatArray  # (3, 6) over the variance of the innovation
    found: FloatArray  # (3,) innovations
    change: FloatArray  # (6,) of what is learnt


def learning() -> Learning:
    """To be used again and again."""
    return Learning(np.zeros((3, 6)), np.zeros((3, 6)), np.zeros((3, 6)), np.zeros(3), np.zeros(6))


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
    work: Learning,
    s: int,
    p: int,
    u: FloatArray,
    u_p: FloatArray,
    K: FloatArray,
    K_p: FloatArray,
    at_once: float,
    dt: float,
) -> float:
    """Corrects ``state.arm[s]`` and, in place, the sides u, u_p (3,); K, K_p (3, 3) 1/s², world.

    at_once: variance of a component of a single row, (m/s²)². Returns what the arms' uncertainty adds to it.
    """
    state.learnt_s[s] += dt
    if state.learnt_s[s] < 0.9 * LEARN_S:  # frames jitter
        return float(state.arm_variance[s])
    interval_s = min(state.learnt_s[s], noise.row_memory_s)
    state.learnt_s[s] = 0.0 if math.isfinite(state.learnt_s[s]) else -dt * (s % PHASES)
    for i in range(3):
        for j in range(3):
            work.rows[i, j], work.rows[i, 3 + j] = -K[i, j], K_p[i, j]
    off = spread(
        0.5 * (u[0] + u_p[0]), 0.5 * (u[1] + u_p[1]), 0.5 * (u[2] + u_p[2]), relative_covariance(state, s, p)
    )
    residual = u[0] - u_p[0], u[1] - u_p[1], u[2] - u_p[2]
    variance = at_once * noise.row_memory_s / interval_s
    memory = noise.row_memory_s / interval_s
    state.arm_variance[s] = learn_rows(
        state.arm_covariance[s], work, residual, off, variance, at_once, noise.huber, memory
    )
    change = work.change
    for i in range(6):
        state.arm[s, i] += change[i]
    for i in range(3):
        u[i] += K[i, 0] * change[0] + K[i, 1] * change[1] + K[i, 2] * change[2]
        u_p[i] += K_p[i, 0] * change[3] + K_p[i, 1] * change[4] + K_p[i, 2] * change[5]
    return float(state.arm_variance[s])


@compiled
def learn_fixed_point(
    state: FilterState,
    noise: Noise,
    work: Learning,
    d: int,
    s: int,
    u: FloatArray,
    y: FloatArray,
    K: FloatArray,
    variance: float,
    at_once: float,
    dt: float,
) -> float:
    """Corrects ``state.device_shift[d]`` of a fixed point of segment s, at which u must be the known y, and
    ``state.force_bias[s]``; u (3,) in place. Returns what their uncertainty adds to the row, (m/s²)²."""
    for i in range(3):
        for j in range(3):
            work.rows[i, j] = -K[i, j]
            work.rows[i, 3 + j] = _averaged_turn(state, noise, s, i, j)
    return _learn_point(state, noise, work, d, s, u, y, variance, at_once, dt)


@compiled
def learn_device(
    state: FilterState,
    noise: Noise,
    work: Learning,
    d: int,
    s: int,
    pair: LocalPair,
    variance: float,
    at_once: float,
    dt: float,
) -> float:
    """The same of a device that tells how its point moves; corrects ``pair.u``."""
    for i in range(3):
        for j in range(3):
            work.rows[i, j], work.rows[i, 3 + j] = -pair.arm[i, j], pair.turn[i, j]
    added = _learn_point(state, noise, work, d, s, pair.u, pair.y, variance, at_once, dt)
    history, change = state.history[d], work.change
    for k in range(len(history)):
        if history[k, 0] == -np.inf:
            continue
        for i in range(3):
            for j in range(3):
                history[k, 1 + i] -= history[k, 4 + 3 * j + i] * change[3 + j]
    return added


@compiled
def _averaged_turn(state: FilterState, noise: Noise, s: int, i: int, j: int) -> float:
    """An element of R through the low-pass, whose derivative went through it as the swing."""
    return float(state.R[s, i, j] - noise.smoothing_s * state.swing[s, i, j])


@compiled
def _learn_point(
    state: FilterState,
    noise: Noise,
    work: Learning,
    d: int,
    s: int,
    u: FloatArray,
    y: FloatArray,
    variance: float,
    at_once: float,
    dt: float,
) -> float:
    """By ``work.rows``: columns of the arm, of the accelerometer's error."""
    off = spread(y[0], y[1], y[2], own_covariance(state, s))
    residual, change = (u[0] - y[0], u[1] - y[1], u[2] - y[2]), work.change
    memory = max(1.0, POINT_MEMORY_S / dt)
    added = learn_rows(
        state.device_covariance[d], work, residual, off, variance, at_once, noise.huber, memory
    )
    for i in range(3):
        state.device_shift[d, i] += change[i]
        state.force_bias[s, i] += change[3 + i]
        for j in range(6):
            u[i] -= work.rows[i, j] * change[j]
        for j in range(3):  # the averages as if the accelerometer's error had always been known so
            state.force[s, i] -= _averaged_turn(state, noise, s, i, j) * change[3 + j]
            state.last_force[s, i] -= state.R[s, i, j] * change[3 + j]
    return added


@compiled
def learn_rows(
    P: FloatArray,
    work: Learning,
    residual: Three,
    off: Three,
    variance: float,
    at_once: float,
    huber: float,
    memory: float,
) -> float:
    """``work.change`` ← three scalar updates by ``work.rows`` and their residuals; P (6, 6) changes in place.
    Returns the mean variance that P meant for a component beforehand. memory: rows for which ``off`` stays.

    P itself is changed once, by all three: a row's gain is that by the first P less its shares in the gains
    of the rows before it.
    """
    rows, gains, scaled, found, added = work.rows, work.gains, work.scaled, work.found, 0.0
    for i in range(3):
        times_vector_into(gains[i], P, rows[i])
        added += _dot(rows[i], gains[i])
    for i in range(3):
        innovation = residual[i]
        for k in range(i):
            share = _dot(rows[i], scaled[k])
            innovation -= share * found[k]
            for a in range(6):
                gains[i, a] -= share * gains[k, a]
        uncertain = _dot(rows[i], gains[i])
        white, plausible = variance + off[i] * memory, huber * huber * (at_once + off[i] + uncertain)
        if innovation * innovation > plausible:
            white *= math.sqrt(innovation * innovation / plausible)
        weight = 1.0 / (uncertain + white)
        found[i] = innovation
        for a in range(6):
            scaled[i, a] = gains[i, a] * weight
    for a in range(6):
        x, y, z = scaled[0, a], scaled[1, a], scaled[2, a]
        work.change[a] = x * found[0] + y * found[1] + z * found[2]
        for b in range(a + 1):
            P[a, b] -= x * gains[0, b] + y * gains[1, b] + z * gains[2, b]
            P[b, a] = P[a, b]
    return added / 3.0


@compiled
def _dot(a: FloatArray, b: FloatArray) -> float:
    """a · b; shapes (6,), (6,)."""
    product: float = (a[0] * b[0] + a[1] * b[1]) + (a[2] * b[2] + a[3] * b[3]) + (a[4] * b[4] + a[5] * b[5])
    return product
