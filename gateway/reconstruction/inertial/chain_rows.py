"""The observations of the chain filters as rows on orientation errors. Compiled.

A world vector ``u = R̂ s`` is truly ``exp(δ) R̂ s ≈ u − [u]× δ``. Two sides that must agree therefore give
``u − u_p = [u]× δ − [u_p]× δ_p``, and a known vector ``y``: ``u − y = [u]× δ``.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, skew
from gateway.reconstruction.inertial.blocks import inverse_3_into
from gateway.reconstruction.inertial.chain_state import OPEN_SIGMA, ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.tree_filter import Evidence, add_edge, add_joint, add_known, add_own

REFERENCE_INTERVAL_S = 0.025
"""``Noise.specific_force`` belongs to rows this far apart; denser rows say no more in all."""
DIP_TOLERANCE = 0.1
"""rad: a field steeper or flatter than it should be by that much is half disturbed."""
NORM_TOLERANCE = 0.1
FIRST_LOOK_S = 0.5
"""A heading that nothing else can show is taken from the field within that time."""
REST_RATE_SIGMA = 0.005
"""rad/s: of a mean rate at rest against the bias."""


@compiled
def joint_row(
    evidence: Evidence,
    state: FilterState,
    noise: Noise,
    s: int,
    p: int,
    u: FloatArray,
    u_p: FloatArray,
    variance: float,
) -> None:
    """The joint's acceleration seen from both sides; variance of a component, (m/s²)²."""
    if state.is_open[s]:
        # heading against the parent unknown: the horizontal parts are only equally long
        H, H_p, residual = skew(u), -skew(u_p), u - u_p
        spread = variance + dot(u, u) + dot(u_p, u_p)
        for i in range(3):
            H[i, 2], H_p[i, 2] = 0.0, 0.0
            add_edge(evidence, s, H[i], H_p[i], residual[i], spread if i < 2 else variance)
        return
    S = np.zeros((3, 3))
    _add_projected(S, u, state.P[s], u, 1.0)
    _add_projected(S, u_p, state.P[p], u_p, 1.0)
    _add_projected(S, u, state.C[s], u_p, -2.0)
    add_joint(evidence, s, u, u_p, variance * _huber(S, u, u_p, variance, noise.huber))


@compiled
def known_row(
    evidence: Evidence,
    state: FilterState,
    noise: Noise,
    s: int,
    u: FloatArray,
    y: FloatArray,
    variance: float,
    is_open: bool,
) -> None:
    """A vector that is known in the world; is_open: its horizontal direction says nothing yet."""
    if is_open:
        H, residual = skew(u), u - y
        spread = variance + dot(u, u) + dot(y, y)
        for i in range(3):
            H[i, 2] = 0.0
            add_own(evidence, s, H[i], residual[i], spread if i < 2 else variance)
        return
    S = np.zeros((3, 3))
    _add_projected(S, u, state.P[s], u, 1.0)
    add_known(evidence, s, u, y, variance * _huber(S, u, y, variance, noise.huber))


@compiled
def _add_projected(S: FloatArray, a: FloatArray, P: FloatArray, b: FloatArray, factor: float) -> None:
    """S ← S + factor · symmetric part of [a]× P [b]×ᵀ; P: the orientations' part of a (6, 6) block."""
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        x = a[j] * P[k, 0] - a[k] * P[j, 0]
        y = a[j] * P[k, 1] - a[k] * P[j, 1]
        z = a[j] * P[k, 2] - a[k] * P[j, 2]
        row = (b[1] * z - b[2] * y, b[2] * x - b[0] * z, b[0] * y - b[1] * x)
        for n in range(3):
            S[i, n] += 0.5 * factor * row[n]
            S[n, i] += 0.5 * factor * row[n]


@compiled
def _huber(S: FloatArray, u: FloatArray, y: FloatArray, variance: float, limit: float) -> float:
    """By how much the variance is raised: 1 within ``limit`` standard deviations of the innovation u − y."""
    for i in range(3):
        S[i, i] += variance
    information, squared = np.empty((3, 3)), 0.0
    inverse_3_into(information, S)
    for i in range(3):
        for j in range(3):
            squared += (u[i] - y[i]) * information[i, j] * (u[j] - y[j])
    return max(1.0, math.sqrt(max(0.0, squared)) / limit)


@compiled
def field_error(body: ChainBody, state: FilterState, s: int, m: FloatArray) -> tuple[float, float]:
    """Heading by which the field is seen off, rad, and how disturbed it looks (1: not at all)."""
    h, seen = body.field, rotation_matrix.rotate(state.R[s], m)
    off = math.atan2(h[0] * seen[1] - h[1] * seen[0], h[0] * seen[0] + h[1] * seen[1])
    dip_seen = math.atan2(seen[2], math.hypot(seen[0], seen[1]))
    dip = dip_seen - math.atan2(h[2], math.hypot(h[0], h[1]))
    length = math.sqrt(dot(m, m) / dot(h, h)) - 1.0
    return off, 1.0 + (dip / DIP_TOLERANCE) ** 2 + (length / NORM_TOLERANCE) ** 2


@compiled
def field_row(
    evidence: Evidence, body: ChainBody, state: FilterState, noise: Noise, s: int, m: FloatArray, dt: float
) -> None:
    """Heading by the field, weak: it is off to the same side for ``heading_memory_s``."""
    off, disturbance = field_error(body, state, s, m)
    sigma = math.sqrt(noise.heading**2 + min(state.P[s, 2, 2], OPEN_SIGMA**2))
    weight = max(1.0, abs(off) / sigma / noise.huber) * disturbance
    is_first = body.opens[s] == 0 and state.P[s, 2, 2] > noise.heading**2
    memory_s = FIRST_LOOK_S if is_first else noise.heading_memory_s
    variance = noise.heading**2 * memory_s / dt * weight
    row = np.zeros(3)
    row[2] = 1.0
    add_own(evidence, s, row, -off, variance)


@compiled
def unaided_row(
    evidence: Evidence, state: FilterState, noise: Noise, s: int, gravity: FloatArray, dt: float
) -> None:
    """Mean acceleration over a window is small, where nothing tells what it is."""
    variance = (noise.unaided_speed / noise.unaided_window_s) ** 2 * noise.unaided_window_s / dt
    known_row(evidence, state, noise, s, state.long_force[s], -gravity, variance, False)


@compiled
def rest_row(evidence: Evidence, state: FilterState, s: int, window_s: float, dt: float) -> None:
    """At rest the mean rate is the bias."""
    variance = REST_RATE_SIGMA**2 * window_s / dt
    for i in range(3):
        evidence.own[s, 3 + i, 3 + i] += 1.0 / variance
        evidence.own_vector[s, 3 + i] += (state.rest[s, i] - state.bias[s, i]) / variance


@compiled
def row_variance(noise: Noise, motion: float, interval_s: float) -> float:
    """(m/s²)² of a row of accelerations that comes every ``interval_s``; motion: ‖[ω̇, ω]‖ or rms sum."""
    variance = noise.specific_force**2 + (noise.lever_arm * motion) ** 2
    return variance * REFERENCE_INTERVAL_S / interval_s
