"""A Kalman filter over a tree: 6 states a segment, cost linear in the number of segments. Compiled.

The state of a segment is the error of its orientation (rotation vector in **world** axes, rad: the true
``R = exp(δ) R̂``) and of its gyroscope's bias (rad/s, segment axes). Segments are driven by independent noise
and every observation involves one segment or two neighbours. The joint covariance is kept as that of a
Gaussian Markov tree: the blocks of every segment and of every edge; the rest follows from them. One update
of such a tree is exact in two sweeps (leaves to root, root to leaves: belief propagation). Between updates
the prediction would couple more than neighbours; what is kept is the tree nearest to it in the sense of
Kullback and Leibler, which is the one with the same blocks (Chow & Liu 1968).
"""

from __future__ import annotations

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.reconstruction.inertial.blocks import (
    inverse_into,
    product_into,
    symmetric_sum_into,
    times_block,
    times_vector_into,
    weakened_into,
)
from gateway.reconstruction.inertial.chain_state import (
    Evidence,
    Link,
    Segment,
    SegmentWork,
    SharedWork,
    Work,
)

Three = tuple[float, float, float]
"""A vector of numbers, for which no array has to be made."""


@compiled
def clear(evidence: Evidence) -> None:
    """Forget all that has been told."""
    for i in range(6):
        evidence.own_vector[i] = 0.0
        for j in range(6):
            evidence.own[i, j] = 0.0
    for i in range(3):
        evidence.c[i], evidence.p[i] = 0.0, 0.0
        for j in range(3):
            evidence.cc[i, j], evidence.cp[i, j], evidence.pp[i, j] = 0.0, 0.0, 0.0


@compiled
def add_own(evidence: Evidence, row: FloatArray | Three, residual: float, variance: float) -> None:
    """One scalar row on the orientation of a segment; row (3,)."""
    for i in range(3):
        evidence.own_vector[i] += row[i] * residual / variance
        for j in range(3):
            evidence.own[i, j] += row[i] * row[j] / variance


@compiled
def add_edge(
    evidence: Evidence,
    row: FloatArray | Three,
    row_p: FloatArray | Three,
    residual: float,
    variance: float,
) -> None:
    """One scalar row on the orientations of a segment and of its parent; rows (3,)."""
    for i in range(3):
        evidence.c[i] += row[i] * residual / variance
        evidence.p[i] += row_p[i] * residual / variance
        for j in range(3):
            evidence.cc[i, j] += row[i] * row[j] / variance
            evidence.cp[i, j] += row[i] * row_p[j] / variance
            evidence.pp[i, j] += row_p[i] * row_p[j] / variance


@compiled
def add_joint(evidence: Evidence, m: Three, residual: Three, variance: float) -> None:
    """``residual = [m]× (δ − δ_p)``, of a segment and its parent; (3,), variance of each component.

    In closed form, with ``[m]×ᵀ [m]× = (m · m) I − m mᵀ``.
    """
    weight, square = 1.0 / variance, m[0] * m[0] + m[1] * m[1] + m[2] * m[2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        across = residual[j] * m[k] - residual[k] * m[j]
        evidence.c[i] += weight * across
        evidence.p[i] -= weight * across
        for j in range(3):
            information = weight * ((square if i == j else 0.0) - m[i] * m[j])
            evidence.cc[i, j] += information
            evidence.cp[i, j] -= information
            evidence.pp[i, j] += information


@compiled
def add_known(evidence: Evidence, m: Three, residual: Three, variance: float) -> None:
    """``residual = [m]× δ``, of a segment; (3,), variance of each component."""
    weight, square = 1.0 / variance, m[0] * m[0] + m[1] * m[1] + m[2] * m[2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        evidence.own_vector[i] += weight * (residual[j] * m[k] - residual[k] * m[j])
        for j in range(3):
            evidence.own[i, j] += weight * ((square if i == j else 0.0) - m[i] * m[j])


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


@compiled
def update_tree(links: Records[Link], segments: Records[Segment], work: Work) -> None:
    """Find the errors, ``x`` of each segment's work; P and C of the segments change in place.

    The evidence is used up. Parents stand before their children; several segments may have none.
    """
    n, works, shared = len(links), work.segments, work.shared
    for s in range(n):
        works[s].is_known = 0
    for s in range(n - 1, -1, -1):
        p, now = links[s].parent, works[s]
        if p < 0 and not now.is_known:
            inverse_into(now.known, segments[s].P)
        if p >= 0:
            above = works[p]
            if not above.is_known:
                inverse_into(above.known, segments[p].P)
                above.is_known = 1
            _gather(segments[s], now, above, shared)
    for s in range(n):
        p, now = links[s].parent, works[s]
        if p < 0:
            _add_into(shared.X, now.known, now.evidence.own)
            inverse_into(segments[s].P, shared.X)
            times_vector_into(now.x, segments[s].P, now.evidence.own_vector)
        else:
            _hand_down(segments[s], segments[p], now, works[p])


@compiled
def _gather(child: Segment, now: SegmentWork, above: SegmentWork, shared: SharedWork) -> None:
    """All that is known beyond the edge is told to the parent.

    A priori ``x_s = A x_p + noise of covariance Σ``. With Λ the information about x_s and B that about
    both ends, ``W = (Σ⁻¹ + Λ)⁻¹``, ``T = Λ A + B``, ``G = A − W T``; the parent is told ``Bᵀ A + Gᵀ T``: the
    usual ``Aᵀ Σ⁻¹ A − …`` without its difference of large numbers.
    """
    A, T, X, W, G = shared.A, shared.B, shared.X, now.W, now.G
    evidence = now.evidence
    own, own_p, B = evidence.own, above.evidence.own, evidence.cp
    product_into(A, child.C, above.known)
    symmetric_sum_into(W, child.P, -1.0, A, child.C)
    inverse_into(X, W)
    for i in range(3):
        evidence.own_vector[i] += evidence.c[i]
        for j in range(3):
            own[i, j] += evidence.cc[i, j]
            own_p[i, j] += evidence.pp[i, j]
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
        row = times_block((G[0, i], G[1, i], G[2, i], G[3, i], G[4, i], G[5, i]), T)
        for j in range(i + 1):
            told = row[j]
            if i < 3:
                told += B[0, i] * A[0, j] + B[1, i] * A[1, j] + B[2, i] * A[2, j]
            own_p[i, j] += told
            own_p[j, i] = own_p[i, j]
    times_vector_into(now.offset, W, evidence.own_vector)
    for i in range(6):
        if i < 3:
            above.evidence.own_vector[i] += evidence.p[i]
        for k in range(6):
            above.evidence.own_vector[i] += G[k, i] * evidence.own_vector[k]


@compiled
def _hand_down(child: Segment, parent: Segment, now: SegmentWork, above: SegmentWork) -> None:
    """What the parent has been found to be is told to the child."""
    times_vector_into(now.x, now.G, above.x)
    for i in range(6):
        now.x[i] += now.offset[i]
    product_into(child.C, now.G, parent.P)
    symmetric_sum_into(child.P, now.W, 1.0, child.C, now.G)


@compiled
def _add_into(C: FloatArray, A: FloatArray, B: FloatArray) -> None:
    for i in range(6):
        for j in range(6):
            C[i, j] = A[i, j] + B[i, j]


@compiled
def update_outward(links: Records[Link], segments: Records[Segment], work: Work) -> None:
    """The same with every segment for itself, its parent taken as found. P changes in place.

    The parent's orientation error is known to ``P_p``, which is handed down: integrated out of the edge's
    evidence it leaves the information ``cc − cp (P_p⁻¹ + pp)⁻¹ cpᵀ`` about the child. What is then known of
    the orientation, and at rest of the bias, are blocks of three of the six states.
    """
    works, shared = work.segments, work.shared
    for s in range(len(links)):
        p, now, P = links[s].parent, works[s], segments[s].P
        cc, own = now.evidence.cc, now.evidence.own
        if p >= 0 and cc[0, 0] + cc[1, 1] + cc[2, 2] > 0.0:
            _integrate_parent_out(segments[p], now, works[p], shared)
        for first in range(0, 6, 3):
            if own[first, first] + own[first + 1, first + 1] + own[first + 2, first + 2] > 0.0:
                _learn_three(P, own, first, shared)
        times_vector_into(now.x, P, now.evidence.own_vector)


@compiled
def _integrate_parent_out(parent: Segment, now: SegmentWork, above: SegmentWork, shared: SharedWork) -> None:
    """Adds to what is told of a segment itself what its edge tells of it."""
    evidence, x, gain, known = now.evidence, above.x, shared.B, shared.A
    pp, cp, vector = evidence.pp, evidence.cp, evidence.own_vector
    weakened_into(known, shared.X, parent.P, 0, pp, 0)
    for i in range(3):
        for j in range(3):
            gain[i, j] = cp[i, 0] * known[0, j] + cp[i, 1] * known[1, j] + cp[i, 2] * known[2, j]
    for i in range(3):
        vector[i] += evidence.c[i]
        for k in range(3):
            innovation = evidence.p[k] - pp[k, 0] * x[0] - pp[k, 1] * x[1] - pp[k, 2] * x[2]
            vector[i] -= cp[i, k] * x[k] + gain[i, k] * innovation
        for j in range(i + 1):
            shared_part = gain[i, 0] * cp[j, 0] + gain[i, 1] * cp[j, 1] + gain[i, 2] * cp[j, 2]
            evidence.own[i, j] += evidence.cc[i, j] - shared_part
            evidence.own[j, i] = evidence.own[i, j]


@compiled
def _learn_three(P: FloatArray, information: FloatArray, first: int, shared: SharedWork) -> None:
    """P ← (P⁻¹ + Λ)⁻¹ with Λ (6, 6) not zero only for three states from ``first`` on: ``P − P (Λ⁻¹ + P)⁻¹ P``
    of them, in place."""
    S, G = shared.A, shared.X
    weakened_into(S, shared.B, information, first, P, first)
    for i in range(6):
        a, b, c = P[i, first], P[i, first + 1], P[i, first + 2]
        for j in range(3):
            G[i, j] = a * S[0, j] + b * S[1, j] + c * S[2, j]
            G[i, 3 + j] = P[i, first + j]
    for i in range(6):
        for j in range(i + 1):
            P[i, j] -= G[i, 0] * G[j, 3] + G[i, 1] * G[j, 4] + G[i, 2] * G[j, 5]
            P[j, i] = P[i, j]
