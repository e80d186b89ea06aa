"""Products of square matrices in plain loops, which skip zeros and compile in a fraction of BLAS's time."""

from __future__ import annotations

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled


@compiled
def product(A: FloatArray, B: FloatArray) -> FloatArray:
    """A B; shapes (n, n), (n, n)."""
    n = A.shape[0]
    C = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            a = A[i, k]
            if a != 0.0:
                for j in range(n):
                    C[i, j] += a * B[k, j]
    return C


@compiled
def product_transposed(A: FloatArray, B: FloatArray) -> FloatArray:
    """A Bᵀ; shapes (n, n), (n, n); for a B that is mostly zeros."""
    n = A.shape[0]
    C = np.zeros((n, n))
    for j in range(n):
        for k in range(n):
            b = B[j, k]
            if b != 0.0:
                for i in range(n):
                    C[i, j] += A[i, k] * b
    return C
