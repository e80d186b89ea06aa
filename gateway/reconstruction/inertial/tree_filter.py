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
from gateway.geometry.vectors import dot
from gateway.reconstruction.inertial.blocks import (
    inverse,
    product,
    product_transposed,
    times_vector,
    transposed_product,
    transposed_times_vector,
)


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


@compiled
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
def add_own(evidence: Evidence, s: int, row: FloatArray, residual: float, variance: float) -> None:
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
def propagate(P: FloatArray, M: FloatArray, M_other: FloatArray) -> None:
    """P ← F P F_oᵀ with F = [[I, −M], [0, I]], in place; (6, 6), M = R Δt (3, 3), M_other likewise."""
    for j in range(6):
        for i in range(3):
            P[i, j] -= M[i, 0] * P[3, j] + M[i, 1] * P[4, j] + M[i, 2] * P[5, j]
    for i in range(6):
        for j in range(3):
            P[i, j] -= P[i, 3] * M_other[j, 0] + P[i, 4] * M_other[j, 1] + P[i, 5] * M_other[j, 2]


@compiled
def update_tree(parents: IntArray, P: FloatArray, C: FloatArray, evidence: Evidence) -> FloatArray:
    """The errors found, (n, 6); P (n, 6, 6) and C (n, 6, 6; child rows, parent columns) change in place.

    ``evidence`` is used up. parents: (n,), parents first, −1 for the root of a tree (several may be).
    """
    n = len(parents)
    G, W, offset = np.empty((n, 6, 6)), np.empty((n, 6, 6)), np.empty((n, 6))
    inverse_P = np.empty((n, 6, 6))
    for s in range(n):
        inverse_P[s] = inverse(P[s])
    for s in range(n - 1, -1, -1):
        if parents[s] >= 0:
            _gather(s, parents[s], inverse_P, P, C, evidence, G, W, offset)
    x = np.empty((n, 6))
    for s in range(n):
        p = parents[s]
        if p < 0:
            P[s] = inverse(inverse_P[s] + evidence.own[s])
            x[s] = times_vector(P[s], evidence.own_vector[s])
        else:
            x[s] = times_vector(G[s], x[p]) + offset[s]
            C[s] = product(G[s], P[p])
            P[s] = W[s] + product_transposed(C[s], G[s])
            _make_symmetric(P[s])
    return x


@compiled
def _gather(
    s: int,
    p: int,
    inverse_P: FloatArray,
    P: FloatArray,
    C: FloatArray,
    evidence: Evidence,
    G: FloatArray,
    W: FloatArray,
    offset: FloatArray,
) -> None:
    """All that is known beyond the edge is told to the parent: x_s = G x_p + offset, covariance W."""
    A = product(C[s], inverse_P[p])
    conditional = inverse(P[s] - product_transposed(A, C[s]))
    JA = product(conditional, A)
    J_pp = transposed_product(A, JA)
    J_ss, J_sp = conditional + evidence.own[s], -JA
    vector_s, vector_p = evidence.own_vector[s].copy(), np.zeros(6)
    for i in range(3):
        vector_s[i] += evidence.c[s, i]
        vector_p[i] += evidence.p[s, i]
        for j in range(3):
            J_ss[i, j] += evidence.cc[s, i, j]
            J_sp[i, j] += evidence.cp[s, i, j]
            J_pp[i, j] += evidence.pp[s, i, j]
    W[s] = inverse(J_ss)
    G[s] = -product(W[s], J_sp)
    offset[s] = times_vector(W[s], vector_s)
    evidence.own[p] += J_pp + transposed_product(J_sp, G[s])
    _make_symmetric(evidence.own[p])
    evidence.own_vector[p] += vector_p + transposed_times_vector(G[s], vector_s)


@compiled
def _make_symmetric(A: FloatArray) -> None:
    for i in range(6):
        for j in range(i):
            A[i, j] = A[j, i] = 0.5 * (A[i, j] + A[j, i])


@compiled
def update_outward(parents: IntArray, P: FloatArray, evidence: Evidence) -> FloatArray:
    """The same with every segment for itself, its parent taken as found; (n, 6). P changes in place.

    The parent's orientation error is known to ``P_p``, which is handed down: integrated out of the edge's
    evidence it leaves the information ``cc − cp (P_p⁻¹ + pp)⁻¹ cpᵀ`` about the child.
    """
    n = len(parents)
    x = np.empty((n, 6))
    for s in range(n):
        p = parents[s]
        J, vector = inverse(P[s]) + evidence.own[s], evidence.own_vector[s]
        if p >= 0 and evidence.cc[s, 0, 0] + evidence.cc[s, 1, 1] + evidence.cc[s, 2, 2] > 0.0:
            known = inverse(inverse(P[p, :3, :3].copy()) + evidence.pp[s])
            gain = product(evidence.cp[s], known)
            shared = product_transposed(gain, evidence.cp[s])
            innovation = evidence.p[s] - times_vector(evidence.pp[s], x[p, :3])
            told = evidence.c[s] - times_vector(evidence.cp[s], x[p, :3])
            for i in range(3):
                vector[i] += told[i] - dot(gain[i], innovation)
                for j in range(3):
                    J[i, j] += evidence.cc[s, i, j] - shared[i, j]
        P[s] = inverse(J)
        x[s] = times_vector(P[s], vector)
    return x
