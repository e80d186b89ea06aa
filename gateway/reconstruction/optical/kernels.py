"""The equations of one pose: markers of a skeleton, their derivatives, and what joints are allowed. Compiled.

The unknowns of a pose of S segments are 3 + 3 S small changes δ: a shift of the root, and for every segment a
turn about its proximal joint, world axes, that takes all it carries along. A marker at y on a segment with
the chain of segments a = root … own then moves by

    dy = δ₀ + Σ_a δ_a × (y − p_a),

with p_a the joint of segment a: the Jacobian's blocks are the identity and −[y − p_a]×.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, IntArray
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import cross, dot, norm, vector

_SINGULAR = 0.2
"""Sine between first and third axis of a joint under which its angles are not used."""


class MarkerRow(NamedTuple):
    """One marker of one frame, as the normal equations take it."""

    segment: int
    y: FloatArray  # (3,) m, virtual marker
    r: FloatArray  # (3,) m, measured minus virtual
    weight: float  # 1/m²


class JointRow(NamedTuple):
    """What one joint is allowed, by Cardan angles about axes of the moving segment."""

    distal: int
    axes: IntArray  # (3,)
    signs: FloatArray  # (3,)
    stiffness: FloatArray  # (3,) 1/rad²: draws each angle to zero
    limits: FloatArray  # (3, 2) rad
    limit_stiffness: float  # 1/rad², beyond them


@compiled
def places(parents: IntArray, offsets: FloatArray, R: FloatArray, root: FloatArray) -> FloatArray:
    """Return proximal joints p_w (S, 3), m, from R (S, 3, 3) segment to world and the root's place (3,)."""
    p = np.empty((len(parents), 3))
    for s in range(len(parents)):
        p[s] = root if parents[s] < 0 else p[parents[s]] + rm.rotate(R[parents[s]], offsets[s])
    return p


@compiled
def marker_places(segments: IntArray, positions: FloatArray, R: FloatArray, p: FloatArray) -> FloatArray:
    """Return where the virtual markers are, (M, 3) m."""
    y = np.empty((len(segments), 3))
    for m in range(len(segments)):
        y[m] = p[segments[m]] + rm.rotate(R[segments[m]], positions[m])
    return y


@compiled
def add_marker(H: FloatArray, g: FloatArray, parents: IntArray, p: FloatArray, marker: MarkerRow) -> None:
    """Add one marker's normal equations: H ← H + w JᵀJ, g ← g + w Jᵀr. Upper blocks of H only."""
    y, r, weight = marker.y, marker.r, marker.weight
    for i in range(3):
        H[i, i] += weight
        g[i] += weight * r[i]
    a = marker.segment
    while a >= 0:
        d_a = y - p[a]
        at = 3 + 3 * a
        turned = cross(d_a, r)
        for i in range(3):
            g[at + i] += weight * turned[i]
        # identity row times −[d]×
        H[0, at + 1] += weight * d_a[2]
        H[0, at + 2] -= weight * d_a[1]
        H[1, at] -= weight * d_a[2]
        H[1, at + 2] += weight * d_a[0]
        H[2, at] += weight * d_a[1]
        H[2, at + 1] -= weight * d_a[0]
        b = a
        while b >= 0:
            d_b = y - p[b]
            to = 3 + 3 * b
            both = dot(d_a, d_b)
            for i in range(3):
                H[to + i, at + i] += weight * both
                for j in range(3):
                    H[to + i, at + j] -= weight * d_a[i] * d_b[j]
            b = parents[b]
        a = parents[a]


@compiled
def add_joint(H: FloatArray, g: FloatArray, R_p: FloatArray, R_d: FloatArray, joint: JointRow) -> float:
    """Add what a joint is allowed: pulled to the neutral posture, and back inside its limits.

    Near the singularity only a turn as a whole is drawn to zero. Returns the cost, ½ Σ k e².
    """
    stiffness, limits, limit_stiffness = joint.stiffness, joint.limits, joint.limit_stiffness
    found, E, is_regular = cardan(R_p, R_d, joint.axes)
    at = 3 + 3 * joint.distal
    cost = 0.0
    if not is_regular:
        turn = rm.rotate(R_p, rm.increment(R_p, R_d))
        weakest = min(stiffness[0], stiffness[1], stiffness[2])
        for i in range(3):
            H[at + i, at + i] += weakest
            g[at + i] -= weakest * turn[i]
        whole: float = 0.5 * weakest * dot(turn, turn)
        return whole
    for k in range(3):
        angle = found[k] * joint.signs[k]
        pull = stiffness[k] * angle
        stiff = stiffness[k]
        cost += 0.5 * stiffness[k] * angle**2
        beyond = min(0.0, angle - limits[k, 0]) + max(0.0, angle - limits[k, 1])
        if beyond != 0.0:
            pull += limit_stiffness * beyond
            stiff += limit_stiffness
            cost += 0.5 * limit_stiffness * beyond * beyond
        row = E[k] * joint.signs[k]
        for i in range(3):
            g[at + i] -= pull * row[i]
            for j in range(3):
                H[at + i, at + j] += stiff * row[i] * row[j]
    return cost


@compiled
def cardan(R_p: FloatArray, R_d: FloatArray, axes: IntArray) -> tuple[FloatArray, FloatArray, bool]:
    """Return right-handed angles (3,) rad of distal in proximal axes, and their rates by a turn of the distal
    segment.

    E (3, 3): d angle_k = E[k] · δ, δ in world axes. False where the axes are nearly dependent.
    """
    i, j, k = axes[0], axes[1], axes[2]
    Q = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            Q[a, b] = R_p[0, a] * R_d[0, b] + R_p[1, a] * R_d[1, b] + R_p[2, a] * R_d[2, b]
    if i == k:
        return vector(0.0, 0.0, 0.0), Q, False
    parity = float((i - j) * (j - k) * (k - i)) / 2.0
    first = math.atan2(-parity * Q[j, k], Q[k, k])
    second = math.asin(min(1.0, max(-1.0, parity * Q[i, k])))
    third = math.atan2(-parity * Q[i, j], Q[i, i])
    e1, e3 = R_p[:, i].copy(), R_d[:, k].copy()
    e2 = cross(e3, e1) * parity
    sine = norm(e2)
    if sine < _SINGULAR:
        return vector(first, second, third), Q, False
    e2 /= sine
    E = np.empty((3, 3))
    # reciprocal vectors of e1, e2, e3
    volume = dot(e1, cross(e2, e3))
    E[0], E[1], E[2] = cross(e2, e3) / volume, cross(e3, e1) / volume, cross(e1, e2) / volume
    return vector(first, second, third), E, True


@compiled
def mirrored(H: FloatArray) -> None:
    """Fill the lower triangle from the upper one."""
    for i in range(len(H)):
        for j in range(i):
            H[i, j] = H[j, i]


@compiled
def cholesky(A: FloatArray) -> bool:
    """Replace A by its lower Cholesky factor; return False when A is not positive definite."""
    for j in range(len(A)):
        total = A[j, j]
        for k in range(j):
            total -= A[j, k] * A[j, k]
        if not total > 0.0:
            return False
        A[j, j] = math.sqrt(total)
        for i in range(j + 1, len(A)):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = total / A[j, j]
    return True


@compiled
def substituted(L: FloatArray, b: FloatArray) -> FloatArray:
    """Return x of L Lᵀ x = b."""
    n = len(b)
    x = b.copy()
    for i in range(n):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    solve_transposed(L, x)
    return x


@compiled
def solve_transposed(L: FloatArray, x: FloatArray) -> None:
    """Solve Lᵀ y = x for y, in place of x."""
    n = len(x)
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]


@compiled
def moved(
    parents: IntArray, R: FloatArray, root: FloatArray, delta: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the pose after a change δ (3 + 3 S): (S, 3, 3), (3,). A turn carries all segments beyond it."""
    turned = np.empty_like(R)
    total = np.empty((len(parents), 3, 3))
    for s in range(len(parents)):
        own = rm.from_rotation_vector(delta[3 + 3 * s : 6 + 3 * s])
        total[s] = own if parents[s] < 0 else rm.multiply(total[parents[s]], own)
        turned[s] = rm.multiply(total[s], R[s])
    return turned, root + delta[:3]
