"""Vectors of three numbers. Compiled; arguments are never changed."""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled


@compiled
def vector(x: float, y: float, z: float) -> FloatArray:
    """Return a new (3,) array."""
    v = np.empty(3)
    v[0], v[1], v[2] = x, y, z
    return v


@compiled
def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a × b; shapes (3,), (3,) -> (3,)."""
    return vector(a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@compiled
def dot(a: FloatArray, b: FloatArray) -> float:
    """Return a · b; shapes (3,), (3,)."""
    product: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


@compiled
def norm(a: FloatArray) -> float:
    """Return length of a (3,) vector."""
    return math.sqrt(dot(a, a))


@compiled
def horizontal_square(a: FloatArray | tuple[float, float, float]) -> float:
    """Return the square of the length of the first two components of a (3,) vector."""
    square: float = a[0] * a[0] + a[1] * a[1]
    return square


@compiled
def skew(a: FloatArray) -> FloatArray:
    """Return the (3, 3) matrix [a]× with [a]× b = a × b."""
    m = np.zeros((3, 3))
    m[0, 1], m[0, 2] = -a[2], a[1]
    m[1, 0], m[1, 2] = a[2], -a[0]
    m[2, 0], m[2, 1] = -a[1], a[0]
    return m


@compiled
def is_finite(a: FloatArray) -> bool:
    """Return True when none of the three of a (3,) is NaN or infinite."""
    return math.isfinite(a[0]) and math.isfinite(a[1]) and math.isfinite(a[2])
