"""Products and inverses of the 6 × 6 blocks that covariances are made of, into given arrays. Compiled.

Plain loops of fixed length over arrays that exist already: at this size they beat a call of BLAS, and a
small array made inside them would cost as much as the arithmetic. No output may be one of the inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled

LEAST_PIVOT = 1e-14
"""A pivot below it is rounding: the block counts as having that little variance."""


Six = tuple[float, float, float, float, float, float]
"""A row or a column, as numbers that the compiler keeps in registers."""


@compiled
def along(row: Six, B: FloatArray, j: int) -> float:
    """Return a row times column j of B (6, 6)."""
    product: float = (
        (row[0] * B[0, j] + row[1] * B[1, j])
        + (row[2] * B[2, j] + row[3] * B[3, j])
        + (row[4] * B[4, j] + row[5] * B[5, j])
    )
    return product


@compiled
def times_block(row: Six, B: FloatArray) -> Six:
    """Return a row times B (6, 6).

    No element is written before all are known: the compiler, which cannot know that no output is an input,
    then takes several columns at a time.
    """
    return (
        along(row, B, 0), along(row, B, 1), along(row, B, 2),
        along(row, B, 3), along(row, B, 4), along(row, B, 5),
    )  # fmt: skip


@compiled
def product_into(C: FloatArray, A: FloatArray, B: FloatArray) -> None:
    """C ← A B; shapes (6, 6)."""
    for i in range(6):
        row = times_block((A[i, 0], A[i, 1], A[i, 2], A[i, 3], A[i, 4], A[i, 5]), B)
        C[i, 0], C[i, 1], C[i, 2], C[i, 3], C[i, 4], C[i, 5] = row


@compiled
def symmetric_sum_into(C: FloatArray, D: FloatArray, sign: float, A: FloatArray, B: FloatArray) -> None:
    """C ← D + sign A Bᵀ where that is known to be symmetric; shapes (6, 6). D may be C."""
    for i in range(6):
        a = A[i, 0], A[i, 1], A[i, 2], A[i, 3], A[i, 4], A[i, 5]
        row = _dot(a, B, 0), _dot(a, B, 1), _dot(a, B, 2), _dot(a, B, 3), _dot(a, B, 4), _dot(a, B, 5)
        for j in range(i + 1):
            C[i, j] = D[i, j] + sign * row[j]
            C[j, i] = C[i, j]


@compiled
def _dot(row: Six, B: FloatArray, j: int) -> float:
    """Return a row times row j of B (6, 6)."""
    product: float = (
        (row[0] * B[j, 0] + row[1] * B[j, 1])
        + (row[2] * B[j, 2] + row[3] * B[j, 3])
        + (row[4] * B[j, 4] + row[5] * B[j, 5])
    )
    return product


@compiled
def times_vector_into(y: FloatArray, A: FloatArray, x: FloatArray) -> None:
    """y ← A x; shapes (6,), (6, 6), (6,)."""
    for i in range(6):
        y[i] = (
            (A[i, 0] * x[0] + A[i, 1] * x[1])
            + (A[i, 2] * x[2] + A[i, 3] * x[3])
            + (A[i, 4] * x[4] + A[i, 5] * x[5])
        )


def _inverse_of(n: int) -> Callable[[FloatArray, FloatArray], None]:
    """Return the inverse of blocks (n, n), in loops of a length that the compiler knows: twice as fast."""

    @compiled
    def into(M: FloatArray, A: FloatArray) -> None:
        """By Cholesky. Below the diagonal M holds L (its diagonal inverted), then L⁻¹, then L⁻ᵀ L⁻¹."""
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
    """S ← (A⁻¹ + B)⁻¹ = (I + A B)⁻¹ A of symmetric blocks of three, of which either may be singular.

    The blocks are A[a:a+3, a:a+3], B[b:b+3, b:b+3] and S[:3, :3], which is symmetric to the last bit; M is
    used on the way: the inverse is the matrix of cofactors over the determinant.
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
