"""The lower envelope of delays as a filter: offset and rate of one module's clock, block by block.

``d`` = arrival − module time = offset + transport delay, and transport only ever delays. For delays that are
exponential above their floor the lowest line under all points is the maximum-likelihood estimate (Jeske 2005,
"On maximum-likelihood estimation of clock offset"). A link that hands over what it has every ``slot`` (USB)
says only that a packet came within ``(B − slot, B]``; a module in step with the link would then show the
same excess for ever, and its envelope would be wrong by up to one slot. The likelihood of the interval

    P(u) = F(u) − F(u − slot),  F(u) = 1 − exp(−u / m) for u > 0,  u = B − module time − offset

has no such blind spot, and is the envelope again as slot → 0: what share of packets misses the earliest
hand-over says how far before it they were ready.

State ``x``: offset c (µs) at the newest time and rate r (µs/s = ppm), Gaussian with covariance ``P``; the
rate walks at random, as temperature has it. Each block of packets is taken in by Newton's method on prior
plus log-likelihood (Laplace's approximation).
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled

SHARPNESS_US = 10.0
"""How sharp the floor is at best: stamps and arrival times are no better."""
TRUST = 0.5
"""Weight of a packet: delays of neighbouring packets are not independent."""
OUTAGE = 6.0
"""A packet later than so many mean delays was delayed: it says hardly anything of the floor."""
OUTAGE_WEIGHT = 0.02
OUTAGE_SCORE = 0.5
"""Nor of the mean delay, unless such packets are many."""
_ITERATIONS = 30
_SHORTEST_STEP = 1e-9
_GAIN = 3e-3  # of the log posterior: less is not worth another iteration
_FAR, _NEAR = 20.0, 3.0


@compiled
def _softplus(u: float, corner: float) -> tuple[float, float]:
    """Return max(u, 0) with its corner rounded over ``corner`` µs, and its slope."""
    z = u / corner
    # exp(z) would overflow; the difference to the straight line is below 1e-6.
    if z > 15.0:
        return u, 1.0
    e = math.exp(z)
    return corner * math.log1p(e), e / (1.0 + e)


@compiled
def _packet(u: float, m: float, slot: float, corner: float) -> tuple[float, float, float, float]:
    """Return log P(u), its slope, minus its curvature, and its slope over log m."""
    beyond = min(u + _FAR * corner, 0.0)  # far on the wrong side log P is a straight line
    a, a1 = _softplus(u - beyond, corner)
    b, b1 = _softplus(u - beyond - slot, corner)
    w = (a - b) / m
    h = 1.0 / math.expm1(w)
    slope = (-b1 + (a1 - b1) * h) / m
    # a'' = a'(1 − a') / corner
    a2, b2 = a1 * (1.0 - a1) / corner, b1 * (1.0 - b1) / corner
    information = (b2 - (a2 - b2) * h) / m + ((a1 - b1) / m) ** 2 * h * (1.0 + h)
    if beyond < 0.0:
        slope, information = 1.0 / corner, 0.0
    value = -b / m + math.log(-math.expm1(-w)) + beyond / corner
    return value, slope, max(information, 0.0), b / m - w * h


@compiled
def _log_packet(u: float, m: float, slot: float, corner: float) -> float:
    """Return log P(u) alone, as ``_packet`` gives it."""
    beyond = min(u + _FAR * corner, 0.0)
    a, b = _softplus(u - beyond, corner)[0], _softplus(u - beyond - slot, corner)[0]
    return -b / m + math.log(-math.expm1(-(a - b) / m)) + beyond / corner


@compiled
def _log_posterior(
    c: float, r: float, x: FloatArray, A: FloatArray, t: FloatArray, d: FloatArray, weight: FloatArray,
    m: float, slot: float, corner: float,
) -> float:  # fmt: skip
    dc, dr = c - x[0], r - x[1]
    total: float = -0.5 * (A[0, 0] * dc * dc + 2.0 * A[0, 1] * dc * dr + A[1, 1] * dr * dr)
    for k in range(len(t)):
        u = d[k] - c - r * t[k]
        total += weight[k] * _log_packet(u, m, slot, corner)
    return total


@compiled
def predict(
    x: FloatArray, P: FloatArray, dt: float, offset_walk: float, rate_walk: float
) -> tuple[FloatArray, FloatArray]:
    """Return state (2,) and covariance (2, 2) so many seconds later.

    offset_walk: µs²/s, rate_walk: ppm²/s, variance of their changes.
    """
    out_x, out_P = x.copy(), P.copy()
    out_x[0] += x[1] * dt
    # The covariance of a random walk of the rate, integrated over dt.
    out_P[0, 0] += 2.0 * dt * P[0, 1] + dt * dt * P[1, 1] + offset_walk * dt + rate_walk * dt**3 / 3.0
    out_P[0, 1] += dt * P[1, 1] + 0.5 * rate_walk * dt * dt
    out_P[1, 0] = out_P[0, 1]
    out_P[1, 1] += rate_walk * dt
    return out_x, out_P


@compiled
def _derivatives(
    c: float, r: float, x: FloatArray, A: FloatArray, t: FloatArray, d: FloatArray, weight: FloatArray,
    m: float, slot: float, corner: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return the gradient (2,) of the log posterior and its information (2, 2) at a line."""
    g, H = np.empty(2), A.copy()
    g[0] = -(A[0, 0] * (c - x[0]) + A[0, 1] * (r - x[1]))
    g[1] = -(A[0, 1] * (c - x[0]) + A[1, 1] * (r - x[1]))
    for k in range(len(t)):
        _, slope, information, _ = _packet(d[k] - c - r * t[k], m, slot, corner)
        g[0] -= weight[k] * slope
        g[1] -= weight[k] * slope * t[k]
        H[0, 0] += weight[k] * information
        H[0, 1] += weight[k] * information * t[k]
        H[1, 1] += weight[k] * information * t[k] * t[k]
    H[1, 0] = H[0, 1]
    return g, H


@compiled
def _inverse(M: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric matrix (2, 2)."""
    out = np.empty((2, 2))
    determinant = M[0, 0] * M[1, 1] - M[0, 1] * M[0, 1]
    out[0, 0], out[1, 1] = M[1, 1] / determinant, M[0, 0] / determinant
    out[0, 1] = out[1, 0] = -M[0, 1] / determinant
    return out


@compiled
def _reach(
    step_c: float, step_r: float, c: float, r: float, t: FloatArray, d: FloatArray, corner: float
) -> float:
    """Return what part of a step stays on the possible side: with no packet near the line nothing else bounds
    it."""
    reach = 1.0
    for k in range(len(t)):
        u, fall = d[k] - c - r * t[k], step_c + step_r * t[k]
        if fall > 0.0 and u > -_NEAR * corner:
            reach = min(reach, (max(u, 0.0) + _NEAR * corner) / fall)
    return reach


@compiled
def _most_likely(
    x: FloatArray, A: FloatArray, t: FloatArray, d: FloatArray, weight: FloatArray, c: float, r: float,
    m: float, slot: float, corner: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return state (2,) and covariance (2, 2) by Newton's method from a line; a step that loses is
    shortened."""
    value = _log_posterior(c, r, x, A, t, d, weight, m, slot, corner)
    P = _inverse(A)
    for _ in range(_ITERATIONS):
        g, H = _derivatives(c, r, x, A, t, d, weight, m, slot, corner)
        P = _inverse(H)
        step_c, step_r = P[0, 0] * g[0] + P[0, 1] * g[1], P[0, 1] * g[0] + P[1, 1] * g[1]
        scale, gained = _reach(step_c, step_r, c, r, t, d, corner), -1.0
        is_whole = scale == 1.0
        while gained < 0.0 and scale > _SHORTEST_STEP:
            near_c, near_r = c + scale * step_c, r + scale * step_r
            trial = _log_posterior(near_c, near_r, x, A, t, d, weight, m, slot, corner)
            gained = trial - value
            if gained >= 0.0:
                c, r, value = near_c, near_r, trial
            scale *= 0.3
        if gained < (_GAIN if is_whole else 0.0):
            break
    best = np.empty(2)
    best[0], best[1] = c, r
    return best, P


@compiled
def distance(x: FloatArray, P: FloatArray, after: FloatArray) -> float:
    """Return how far a state (2,) is from another one, in standard deviations of P (2, 2)."""
    c, r = after[0] - x[0], after[1] - x[1]
    A = _inverse(P)
    return math.sqrt(max(A[0, 0] * c * c + 2.0 * A[0, 1] * c * r + A[1, 1] * r * r, 0.0))


@compiled
def update(
    x: FloatArray, P: FloatArray, t: FloatArray, d: FloatArray, m: float, slot: float
) -> tuple[FloatArray, FloatArray, float, float]:
    """Take in a block of packets.

    t: (n,) s before the state's time (<= 0); d: (n,) arrival − module time, µs; m: mean delay above the
    floor, µs; slot: µs. Gives state, covariance, the sum over packets of the slope of log P over log m,
    and the mean of u (µs).
    """
    n = len(t)
    # No sharper than so many packets can determine the floor, or the first few would be believed.
    corner = max(SHARPNESS_US, min(m / (TRUST * n), math.sqrt(P[0, 0])))
    lowest = 0.0
    for k in range(n):
        lowest = min(lowest, d[k] - x[0] - x[1] * t[k])
    c = x[0] + lowest  # begin on the possible side
    weight = np.empty(n)
    for k in range(n):
        is_held_up = d[k] - c - x[1] * t[k] > OUTAGE * m + slot
        weight[k] = TRUST * (OUTAGE_WEIGHT if is_held_up else 1.0)
    out_x, out_P = _most_likely(x, _inverse(P), t, d, weight, c, x[1], m, slot, corner)
    score = mean = 0.0
    for k in range(n):
        u = d[k] - out_x[0] - out_x[1] * t[k]
        score += OUTAGE_SCORE if u > OUTAGE * m + slot else _packet(u, m, slot, corner)[3]
        mean += u / n
    return out_x, out_P, score, mean
