"""A Kalman filter over a tree: 6 states a segment, cost linear in the number of segments. Compiled.

The state of a segment is the error of its orientation (rotation vector in **world** axes, rad: the true
``R = exp(δ) R̂``) and of its gyrometer bias (rad/s, segment axes). Segments are driven by independent noise
and every observation involves one segment or two neighbours. The joint covariance is kept as that of a
Gaussian Markov tree: the blocks of every segment and of every edge; the rest follows from them. One update
of such a tree is exact in two sweeps (leaves to root, root to leaves: belief propagation). Between updates
the prediction would couple more than neighbours; what is kept is the tree nearest to it in the sense of
Kullback and Leibler, which is the one with the same blocks (Chow & Liu 1968).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, IntArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.blocks import (
    inverse_into,
    product_into,
    symmetric_sum_into,
    times_vector_into,
    weakened_into,
)

Three = tuple[float, float, float]
"""A vector of numbers, for which no array has to be made."""


class Evidence(NamedTuple):
    """What an instant tells, in information form. ``own``: of one segment; others: of an edge's two ends,
    child ``c`` and parent ``p``, in their orientation errors only; all by segment (edges: by child)."""

    own: FloatArray  # (n, 6, 6)
    own_vector: FloatArray  # (n, 6)
    cc: FloatArray  # (n, 3, 3)
    cp: FloatArray  # (n, 3, 3)
    pp: FloatArray  # (n, 3, 3)
    c: FloatArray  # (n, 3)
    p: FloatArray  # (n, 3)


def no_evidence(n: int) -> Evidence:
    """Of n segments."""
    return Evidence(
        np.zeros((n, 6, 6)),
        np.zeros((n, 6)),
        np.zeros((n, 3, 3)),
        np.zeros((n, 3, 3)),
        np.zeros((n, 3, 3)),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
    )


@compiled
def clear(evidence: Evidence) -> None:
    """As ``no_evidence``, in place."""
    for s in range(len(evidence.own)):
        for i in range(6):
            evidence.own_vector[s, i] = 0.0
            for j in range(6):
                evidence.own[s, i, j] = 0.0
        for i in range(3):
            evidence.c[s, i], evidence.p[s, i] = 0.0, 0.0
            for j in range(3):
                evidence.cc[s, i, j], evidence.cp[s, i, j], evidence.pp[s, i, j] = 0.0, 0.0, 0.0


@compiled
def add_own(evidence: Evidence, s: int, row: FloatArray | Three, residual: float, variance: float) -> None:
    """One scalar row on the orientation of segment s; row (3,)."""
    for i in range(3):
        evidence.own_vector[s, i] += row[i] * residual / variance
        for j in range(3):
            evidence.own[s, i, j] += row[i] * row[j] / variance


@compiled
def add_edge(
    evidence: Evidence, s: int, row: FloatArray, row_p: FloatArray, residual: float, variance: float
) -> None:
    """One scalar row on the orientations of segment s and of its parent; rows (3,)."""
    for i in range(3):
        evidence.c[s, i] += row[i] * residual / variance
        evidence.p[s, i] += row_p[i] * residual / variance
        for j in range(3):
            evidence.cc[s, i, j] += row[i] * row[j] / variance
            evidence.cp[s, i, j] += row[i] * row_p[j] / variance
            evidence.pp[s, i, j] += row_p[i] * row_p[j] / variance


@compiled
def add_joint(evidence: Evidence, s: int, m: Three, residual: Three, variance: float) -> None:
    """``residual = [m]× (δ − δ_p)``, of segment s and its parent; (3,), variance of each component.

    In closed form, with ``[m]×ᵀ [m]× = (m · m) I − m mᵀ``.
    """
    weight, square = 1.0 / variance, m[0] * m[0] + m[1] * m[1] + m[2] * m[2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        across = residual[j] * m[k] - residual[k] * m[j]
        evidence.c[s, i] += weight * across
        evidence.p[s, i] -= weight * across
        for j in range(3):
            information = weight * ((square if i == j else 0.0) - m[i] * m[j])
            evidence.cc[s, i, j] += information
            evidence.cp[s, i, j] -= information
            evidence.pp[s, i, j] += information


@compiled
def add_known(evidence: Evidence, s: int, m: Three, residual: Three, variance: float) -> None:
    """``residual = [m]× δ``, of segment s; (3,), variance of each component."""
    weight, square = 1.0 / variance, m[0] * m[0] + m[1] * m[1] + m[2] * m[2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        evidence.own_vector[s, i] += weight * (residual[j] * m[k] - residual[k] * m[j])
        for j in range(3):
            evidence.own[s, i, j] += weight * ((square if i == j else 0.0) - m[i] * m[j])


@compiled
def propagate(P: FloatArray, R: FloatArray, R_other: FloatArray, dt: float) -> None:
    """P ← F P F_oᵀ with F = [[I, −R Δt], [0, I]], in place; P (6, 6), R (3, 3), R_other likewise."""
    for j in range(6):
        x, y, z = dt * P[3, j], dt * P[4, j], dt * P[5, j]
        for i in range(3):
            P[i, j] -= R[i, 0] * x + R[i, 1] * y + R[i, 2] * z
    for i in range(6):
        x, y, z = dt * P[i, 3], dt * P[i, 4], dt * P[i, 5]
        for j in range(3):
            P[i, j] -= x * R_other[j, 0] + y * R_other[j, 1] + z * R_other[j, 2]


@compiled
def propagate_own(P: FloatArray, R: FloatArray, dt: float) -> None:
    """The same of a segment with itself: P (6, 6) is symmetric before and after, to the last bit."""
    for i in range(2, -1, -1):
        x, y, z = dt * R[i, 0], dt * R[i, 1], dt * R[i, 2]
        for j in range(i + 1):  # rows up to this one are as they were
            P[i, j] -= x * P[j, 3] + y * P[j, 4] + z * P[j, 5]
        for j in range(3, 6):
            P[i, j] -= x * P[3, j] + y * P[4, j] + z * P[5, j]
            P[j, i] = P[i, j]
        for j in range(i + 1):
            P[i, j] -= dt * (P[i, 3] * R[j, 0] + P[i, 4] * R[j, 1] + P[i, 5] * R[j, 2])
            P[j, i] = P[i, j]


class Workspace(NamedTuple):
    """What one update needs besides its arguments, and what it finds."""

    x: FloatArray  # (n, 6) the errors found
    is_known: IntArray  # (n,) 1: the prior has been inverted
    known: FloatArray  # (n, 6, 6) prior information, of segments with children
    G: FloatArray  # (n, 6, 6) of a segment on its parent
    W: FloatArray  # (n, 6, 6) covariance given the parent
    offset: FloatArray  # (n, 6) error where the parent has none
    A: FloatArray  # (6, 6) prior regression on the parent
    T: FloatArray  # (6, 6)
    X: FloatArray  # (6, 6)


def workspace(n: int) -> Workspace:
    """Of n segments, to be used again and again."""
    blocks, six = (n, 6, 6), (6, 6)
    return Workspace(
        np.zeros((n, 6)), np.zeros(n, np.int64), np.zeros(blocks), np.zeros(blocks), np.zeros(blocks),
        np.zeros((n, 6)), np.zeros(six), np.zeros(six), np.zeros(six),
    )  # fmt: skip


@compiled
def update_tree(parents: IntArray, P: FloatArray, C: FloatArray, evidence: Evidence, work: Workspace) -> None:
    """Finds the errors, ``work.x``; P (n, 6, 6) and C (n, 6, 6; child rows, parent columns) change in place.

    ``evidence`` is used up. parents: (n,), parents first, −1 for the root of a tree (several may be).
    """
    n, x = len(parents), work.x
    for s in range(n):
        work.is_known[s] = 0
    for s in range(n - 1, -1, -1):
        p = parents[s]
        if p < 0 and not work.is_known[s]:
            inverse_into(work.known[s], P[s])
        if p >= 0:
            if not work.is_known[p]:
                inverse_into(work.known[p], P[p])
                work.is_known[p] = 1
            _gather(s, p, P, C, evidence, work)
    for s in range(n):
        if parents[s] < 0:
            _add_into(work.X, work.known[s], evidence.own[s])
            inverse_into(P[s], work.X)
            times_vector_into(x[s], P[s], evidence.own_vector[s])
        else:
            _hand_down(s, parents[s], P, C, x, work)


@compiled
def _gather(s: int, p: int, P: FloatArray, C: FloatArray, evidence: Evidence, work: Workspace) -> None:
    """All that is known beyond the edge is told to the parent.

    A priori ``x_s = A x_p + noise of covariance Σ``. With Λ the information about x_s and B that about
    both ends, ``W = (Σ⁻¹ + Λ)⁻¹``, ``T = Λ A + B``, ``G = A − W T``; the parent hears ``Bᵀ A + Gᵀ T``: the
    usual ``Aᵀ Σ⁻¹ A − …`` without its difference of large numbers.
    """
    A, T, X, W, G = work.A, work.T, work.X, work.W[s], work.G[s]
    own, own_p, B = evidence.own[s], evidence.own[p], evidence.cp[s]
    product_into(A, C[s], work.known[p])
    symmetric_sum_into(W, P[s], -1.0, A, C[s])
    inverse_into(X, W)
    for i in range(3):
        evidence.own_vector[s, i] += evidence.c[s, i]
        for j in range(3):
            own[i, j] += evidence.cc[s, i, j]
            own_p[i, j] += evidence.pp[s, i, j]
    _add_into(T, X, own)
    inverse_into(W, T)
    product_into(T, own, A)
    for i in range(3):
        for j in range(3):
            T[i, j] += B[i, j]
    product_into(X, W, T)
    for i in range(6):
        for j in range(6):
            G[i, j] = A[i, j] - X[i, j]
    for i in range(6):
        for j in range(i + 1):
            told = (G[0, i] * T[0, j] + G[1, i] * T[1, j]) + (G[2, i] * T[2, j] + G[3, i] * T[3, j])
            told += G[4, i] * T[4, j] + G[5, i] * T[5, j]
            if i < 3:
                told += B[0, i] * A[0, j] + B[1, i] * A[1, j] + B[2, i] * A[2, j]
            own_p[i, j] += told
            own_p[j, i] = own_p[i, j]
    times_vector_into(work.offset[s], W, evidence.own_vector[s])
    for i in range(6):
        if i < 3:
            evidence.own_vector[p, i] += evidence.p[s, i]
        for k in range(6):
            evidence.own_vector[p, i] += G[k, i] * evidence.own_vector[s, k]


@compiled
def _hand_down(s: int, p: int, P: FloatArray, C: FloatArray, x: FloatArray, work: Workspace) -> None:
    """What the parent has been found to be is told to the child."""
    times_vector_into(x[s], work.G[s], x[p])
    for i in range(6):
        x[s, i] += work.offset[s, i]
    product_into(C[s], work.G[s], P[p])
    symmetric_sum_into(P[s], work.W[s], 1.0, C[s], work.G[s])


@compiled
def _add_into(C: FloatArray, A: FloatArray, B: FloatArray) -> None:
    for i in range(6):
        for j in range(6):
            C[i, j] = A[i, j] + B[i, j]


@compiled
def update_outward(parents: IntArray, P: FloatArray, evidence: Evidence, work: Workspace) -> None:
    """The same with every segment for itself, its parent taken as found. P changes in place.

    The parent's orientation error is known to ``P_p``, which is handed down: integrated out of the edge's
    evidence it leaves the information ``cc − cp (P_p⁻¹ + pp)⁻¹ cpᵀ`` about the child. What is then known of
    the orientation, and at rest of the bias, are blocks of three of the six states.
    """
    for s in range(len(parents)):
        p, own = parents[s], evidence.own[s]
        if p >= 0 and evidence.cc[s, 0, 0] + evidence.cc[s, 1, 1] + evidence.cc[s, 2, 2] > 0.0:
            _hear_parent(s, p, P, evidence, work)
        for first in range(0, 6, 3):
            if own[first, first] + own[first + 1, first + 1] + own[first + 2, first + 2] > 0.0:
                _learn_three(P[s], own, first, work)
        times_vector_into(work.x[s], P[s], evidence.own_vector[s])


@compiled
def _hear_parent(s: int, p: int, P: FloatArray, evidence: Evidence, work: Workspace) -> None:
    """Adds to what is told of s itself what the edge tells once the parent is integrated out."""
    pp, cp, vector, x, gain = evidence.pp[s], evidence.cp[s], evidence.own_vector[s], work.x[p], work.T
    weakened_into(work.A, work.X, P[p], 0, pp, 0)
    for i in range(3):
        for j in range(3):
            gain[i, j] = cp[i, 0] * work.A[0, j] + cp[i, 1] * work.A[1, j] + cp[i, 2] * work.A[2, j]
    for i in range(3):
        vector[i] += evidence.c[s, i]
        for k in range(3):
            innovation = evidence.p[s, k] - pp[k, 0] * x[0] - pp[k, 1] * x[1] - pp[k, 2] * x[2]
            vector[i] -= cp[i, k] * x[k] + gain[i, k] * innovation
        for j in range(i + 1):
            shared = gain[i, 0] * cp[j, 0] + gain[i, 1] * cp[j, 1] + gain[i, 2] * cp[j, 2]
            evidence.own[s, i, j] += evidence.cc[s, i, j] - shared
            evidence.own[s, j, i] = evidence.own[s, i, j]


@compiled
def _learn_three(P: FloatArray, information: FloatArray, first: int, work: Workspace) -> None:
    """P ← (P⁻¹ + Λ)⁻¹ with Λ (6, 6) not zero only for three states from ``first`` on: ``P − P (Λ⁻¹ + P)⁻¹ P``
    of them, in place."""
    S, G = work.A, work.X
    weakened_into(S, work.T, information, first, P, first)
    for i in range(6):
        a, b, c = P[i, first], P[i, first + 1], P[i, first + 2]
        for j in range(3):
            G[i, j] = a * S[0, j] + b * S[1, j] + c * S[2, j]
            G[i, 3 + j] = P[i, first + j]
    for i in range(6):
        for j in range(i + 1):
            P[i, j] -= G[i, 0] * G[j, 3] + G[i, 1] * G[j, 4] + G[i, 2] * G[j, 5]
            P[j, i] = P[i, j]
