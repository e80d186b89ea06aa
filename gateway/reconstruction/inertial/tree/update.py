"""A Kalman filter over a tree: 6 states a segment, cost linear in the number of segments. Compiled.

The state of a segment is the error of its orientation (rotation vector in **world** axes, rad: the true
``R = exp(δ) R̂``) and of its gyroscope's bias (rad/s, segment axes). Segments are driven by independent noise
and every observation involves one segment or two neighbours. The covariance of all is kept as that of a
Gaussian Markov tree: the blocks of every segment and of every edge; the rest follows from them. One update
of such a tree is exact in two sweeps (leaves to root, root to leaves: belief propagation). Between updates
the prediction would couple more than neighbours; what is kept is the tree nearest to it in the sense of
Kullback and Leibler, which is the one with the same blocks (Chow & Liu 1968).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.reconstruction.inertial.tree.state import Evidence, Link, Segment, SegmentWork, SharedWork, Work

Three = tuple[float, float, float]
"""A vector of numbers, for which no array has to be made."""


# The information of rows


@compiled
def clear(evidence: Evidence) -> None:
    """Set all evidence to zero."""
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
    """Add one scalar row on the orientation of a segment to Λ_s and η_s of section 5; row (3,)."""
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
    """Add one scalar row on the orientations of a segment and its parent to the edge's Λ and η; rows (3,)."""
    for i in range(3):
        evidence.c[i] += row[i] * residual / variance
        evidence.p[i] += row_p[i] * residual / variance
        for j in range(3):
            evidence.cc[i, j] += row[i] * row[j] / variance
            evidence.cp[i, j] += row[i] * row_p[j] / variance
            evidence.pp[i, j] += row_p[i] * row_p[j] / variance


@compiled
def add_joint(evidence: Evidence, m: Three, residual: Three, variance: float) -> None:
    """Add the row (13), ``residual = [m]× (δ − δ_p)``, of a segment and its parent.

    m, residual: (3,). variance: of each component. In closed form, with ``[m]×ᵀ [m]× = (m · m) I − m mᵀ``.
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
    """Add the row (14), ``residual = [m]× δ``, of a segment; m, residual (3,), variance of each component."""
    weight, square = 1.0 / variance, m[0] * m[0] + m[1] * m[1] + m[2] * m[2]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        evidence.own_vector[i] += weight * (residual[j] * m[k] - residual[k] * m[j])
        for j in range(3):
            evidence.own[i, j] += weight * ((square if i == j else 0.0) - m[i] * m[j])


# The whole tree


@compiled
def update_tree(links: Records[Link], segments: Records[Segment], work: Work) -> None:
    """Find the errors ``x`` of all segments and update P and C in place, equations (47) to (51).

    The evidence is used up. Parents stand before their children; several segments may have no parent.
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
            # (50) P_root, x_root
            _add_into(shared.X, now.known, now.evidence.own)
            inverse_into(segments[s].P, shared.X)
            times_vector_into(now.x, segments[s].P, now.evidence.own_vector)
        else:
            _hand_down(segments[s], segments[p], now, works[p])


@compiled
def _gather(child: Segment, now: SegmentWork, above: SegmentWork, shared: SharedWork) -> None:
    """Pass all information from beyond the edge on to the parent, equations (47) to (49).

    A priori ``x_s = A x_p + noise of covariance Σ``. With Λ the information about x_s and B that about both
    ends, ``W = (Σ⁻¹ + Λ)⁻¹``, ``T = Λ A + B``, ``G = A − W T``; the parent receives ``Bᵀ A + Gᵀ T``: the
    usual ``Aᵀ Σ⁻¹ A − …`` without its difference of large numbers.
    """
    A, T, X, W, G = shared.A, shared.B, shared.X, now.W, now.G
    evidence = now.evidence
    own, own_p, B = evidence.own, above.evidence.own, evidence.cp
    # (47) A = C_s P_p⁻¹, Σ = P_s − A C_sᵀ, here in W; then its inverse, in X
    product_into(A, child.C, above.known)
    symmetric_sum_into(W, child.P, -1.0, A, child.C)
    inverse_into(X, W)
    for i in range(3):
        evidence.own_vector[i] += evidence.c[i]
        for j in range(3):
            own[i, j] += evidence.cc[i, j]
            own_p[i, j] += evidence.pp[i, j]
    # (48) W = (Σ⁻¹ + Λ_s)⁻¹, T = Λ_s A + B, G = A − W T
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
        # (49) Λ_p ← … + Gᵀ T + Bᵀ A
        row = times_block((G[0, i], G[1, i], G[2, i], G[3, i], G[4, i], G[5, i]), T)
        for j in range(i + 1):
            product = row[j]
            if i < 3:
                product += B[0, i] * A[0, j] + B[1, i] * A[1, j] + B[2, i] * A[2, j]
            own_p[i, j] += product
            own_p[j, i] = own_p[i, j]
    # (49) η_p ← … + η_edge + Gᵀ η_s; W η_s is kept for (51)
    times_vector_into(now.offset, W, evidence.own_vector)
    for i in range(6):
        if i < 3:
            above.evidence.own_vector[i] += evidence.p[i]
        for k in range(6):
            above.evidence.own_vector[i] += G[k, i] * evidence.own_vector[k]


@compiled
def _hand_down(child: Segment, parent: Segment, now: SegmentWork, above: SegmentWork) -> None:
    """Set the child's errors and covariances from those found of its parent, equation (51)."""
    # (51) x_s = G x_p + W η_s, C_s ← G P_p, P_s ← W + G C_sᵀ
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


# Segment by segment


@compiled
def update_outward(links: Records[Link], segments: Records[Segment], work: Work) -> None:
    """Find the errors ``x`` segment by segment, each parent taken as found, (52) and (53).

    P changes in place. The parent's orientation error is known to ``P_p``: integrated out of the edge's
    evidence it leaves the information ``cc − cp (P_p⁻¹ + pp)⁻¹ cpᵀ`` about the child. The evidence then
    concerns the orientation, and at rest the bias: blocks of three of the six states.
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
    """Add the edge's evidence, its parent integrated out, to the segment's own; (52), (53)."""
    evidence, x, gain, known = now.evidence, above.x, shared.B, shared.A
    pp, cp, vector = evidence.pp, evidence.cp, evidence.own_vector
    # (P_p⁻¹ + Λ_pp)⁻¹
    weakened_into(known, shared.X, parent.P, 0, pp, 0)
    for i in range(3):
        for j in range(3):
            gain[i, j] = cp[i, 0] * known[0, j] + cp[i, 1] * known[1, j] + cp[i, 2] * known[2, j]
    for i in range(3):
        vector[i] += evidence.c[i]
        for k in range(3):
            # (53) η_p − Λ_pp x_p
            innovation = evidence.p[k] - pp[k, 0] * x[0] - pp[k, 1] * x[1] - pp[k, 2] * x[2]
            vector[i] -= cp[i, k] * x[k] + gain[i, k] * innovation
        for j in range(i + 1):
            # (52)
            shared_part = gain[i, 0] * cp[j, 0] + gain[i, 1] * cp[j, 1] + gain[i, 2] * cp[j, 2]
            evidence.own[i, j] += evidence.cc[i, j] - shared_part
            evidence.own[j, i] = evidence.own[i, j]


@compiled
def _learn_three(P: FloatArray, information: FloatArray, first: int, shared: SharedWork) -> None:
    """Update P ← (P⁻¹ + Λ)⁻¹ in place, where Λ (6, 6) is zero but for three states from ``first`` on.

    It is ``P − P (Λ⁻¹ + P)⁻¹ P`` of these states.
    """
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


# Products and inverses of the 6 × 6 blocks that covariances are made of, into given arrays
#
# Plain loops of fixed length over arrays that exist already: at this size they beat a call of BLAS, and a
# small array made inside them would cost as much as the arithmetic. No output may be one of the inputs.


LEAST_PIVOT = 1e-14
"""A pivot below it is rounding: the block counts as having that little variance."""


Row = tuple[float, float, float, float, float, float]
"""A row or a column, as numbers that the compiler keeps in registers."""


@compiled
def along(row: Row, B: FloatArray, j: int) -> float:
    """Return a row times column j of B (6, 6)."""
    product: float = (
        (row[0] * B[0, j] + row[1] * B[1, j])
        + (row[2] * B[2, j] + row[3] * B[3, j])
        + (row[4] * B[4, j] + row[5] * B[5, j])
    )
    return product


@compiled
def times_block(row: Row, B: FloatArray) -> Row:
    """Return a row times B (6, 6).

    All elements are computed before any is written: the compiler, which cannot know that no output is an
    input, then takes several columns at a time.
    """
    return (
        along(row, B, 0), along(row, B, 1), along(row, B, 2),
        along(row, B, 3), along(row, B, 4), along(row, B, 5),
    )  # fmt: skip


@compiled
def product_into(C: FloatArray, A: FloatArray, B: FloatArray) -> None:
    """Fill C with A B; shapes (6, 6)."""
    for i in range(6):
        row = times_block((A[i, 0], A[i, 1], A[i, 2], A[i, 3], A[i, 4], A[i, 5]), B)
        C[i, 0], C[i, 1], C[i, 2], C[i, 3], C[i, 4], C[i, 5] = row


@compiled
def symmetric_sum_into(C: FloatArray, D: FloatArray, sign: float, A: FloatArray, B: FloatArray) -> None:
    """Fill C with D + sign A Bᵀ, which must be symmetric; shapes (6, 6). D may be C."""
    for i in range(6):
        a = A[i, 0], A[i, 1], A[i, 2], A[i, 3], A[i, 4], A[i, 5]
        row = _dot(a, B, 0), _dot(a, B, 1), _dot(a, B, 2), _dot(a, B, 3), _dot(a, B, 4), _dot(a, B, 5)
        for j in range(i + 1):
            C[i, j] = D[i, j] + sign * row[j]
            C[j, i] = C[i, j]


@compiled
def _dot(row: Row, B: FloatArray, j: int) -> float:
    """Return a row times row j of B (6, 6)."""
    product: float = (
        (row[0] * B[j, 0] + row[1] * B[j, 1])
        + (row[2] * B[j, 2] + row[3] * B[j, 3])
        + (row[4] * B[j, 4] + row[5] * B[j, 5])
    )
    return product


@compiled
def times_vector_into(y: FloatArray, A: FloatArray, x: FloatArray) -> None:
    """Fill y with A x; shapes (6,), (6, 6), (6,)."""
    for i in range(6):
        y[i] = (
            (A[i, 0] * x[0] + A[i, 1] * x[1])
            + (A[i, 2] * x[2] + A[i, 3] * x[3])
            + (A[i, 4] * x[4] + A[i, 5] * x[5])
        )


def _inverse_of(n: int) -> Callable[[FloatArray, FloatArray], None]:
    """Return a kernel that inverts blocks (n, n).

    Loops of a length that the compiler knows are twice as fast.
    """

    @compiled
    def into(M: FloatArray, A: FloatArray) -> None:
        """Fill M with A⁻¹, by Cholesky.

        Below its diagonal M holds L (diagonal inverted), then L⁻¹, then L⁻ᵀ L⁻¹.
        """
        for i in range(n):
            for j in range(i + 1):
                total = A[i, j]
                for k in range(j):
                    total -= M[i, k] * M[j, k]
                M[i, j] = 1.0 / math.sqrt(max(total, LEAST_PIVOT)) if i == j else total * M[j, j]
        for i in range(n):
            for j in range(i):
                total = 0.0
                for k in range(j, i):
                    total -= M[i, k] * M[k, j]
                M[i, j] = total * M[i, i]
        for i in range(n):
            for j in range(i + 1):
                total = 0.0
                for k in range(i, n):
                    total += M[k, i] * M[k, j]
                M[i, j] = total
                M[j, i] = total

    return into


inverse_into = _inverse_of(6)
"""M ← A⁻¹ of a symmetric positive definite block, symmetric to the last bit; shapes (6, 6)."""


inverse_3_into = _inverse_of(3)
"""The same for (3, 3)."""


@compiled
def weakened_into(S: FloatArray, M: FloatArray, A: FloatArray, a: int, B: FloatArray, b: int) -> None:
    """Fill S with (A⁻¹ + B)⁻¹ = (I + A B)⁻¹ A of symmetric blocks of three, of which either may be singular.

    The blocks are A[a:a+3, a:a+3], B[b:b+3, b:b+3] and S[:3, :3], which is symmetric to the last bit; M (3,
    3) or larger is overwritten: the inverse is the matrix of cofactors over the determinant.
    """
    for i in range(3):
        for j in range(3):
            S[i, j] = A[a + i, a] * B[b, b + j] + A[a + i, a + 1] * B[b + 1, b + j]
            S[i, j] += A[a + i, a + 2] * B[b + 2, b + j]
        S[i, i] += 1.0
    for i in range(3):
        k, m = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            p, q = (j + 1) % 3, (j + 2) % 3
            M[i, j] = S[p, k] * S[q, m] - S[p, m] * S[q, k]
    scale = 1.0 / (S[0, 0] * M[0, 0] + S[0, 1] * M[1, 0] + S[0, 2] * M[2, 0])
    for j in range(3):
        x, y, z = scale * A[a, a + j], scale * A[a + 1, a + j], scale * A[a + 2, a + j]
        for i in range(j, 3):
            S[i, j] = M[i, 0] * x + M[i, 1] * y + M[i, 2] * z
            S[j, i] = S[i, j]
