"""One pose of a bundle adjustment taken out of the equations. Compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.pose_solver import BodyModel, Pose, normal_equations


class Reduced(NamedTuple):
    """The equations of the constants alone: n = 3 (S − 1) + 3 M."""

    schur: FloatArray  # (n, n), lower triangle
    right: FloatArray  # (n,)


@compiled
def eliminate(
    model: BodyModel, observed: FloatArray, pose: Pose, reduced: Reduced, temper: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Take one pose out of the equations: adds to what is left of them.

    With H = L Lᵀ of the pose, C its coupling to the constants and g its gradient: X = L⁻¹ C and x = L⁻¹ g,
    schur += Jᵀ W J − Xᵀ X, right += Jᵀ W r − Xᵀ x. Returns L, X, x. (No BLAS: its threads cost more here.)
    """
    robust_weights, R, schur, right = pose.weights, pose.R, reduced.schur, reduced.right
    p = kernels.places(model.parents, model.offsets, R, pose.root)
    L, x, _ = normal_equations(model, observed, robust_weights, R, p)
    kernels.mirrored(L)
    n, m = len(x), len(right)
    for i in range(n):
        L[i, i] += 1e-6 * L[i, i] + 1e-9
    kernels.cholesky(L)
    moving, constant, weights, residual = jacobians(model, observed, robust_weights, R, p)
    X = np.zeros((n, m))
    for row in range(len(weights)):
        filled = np.flatnonzero(constant[row])
        for c in filled:
            weighted = weights[row] * constant[row, c]
            right[c] += temper * weighted * residual[row]
            for d in filled:
                schur[c, d] += temper * weighted * constant[row, d]
            for k in range(n):
                X[k, c] += weighted * moving[row, k]
    for k in range(n):
        for j in range(k):
            x[k] -= L[k, j] * x[j]
            X[k] -= L[k, j] * X[j]
        x[k] /= L[k, k]
        X[k] /= L[k, k]
        for i in range(m):
            right[i] -= temper * X[k, i] * x[k]
            schur[i, : i + 1] -= temper * X[k, i] * X[k, : i + 1]
    return L, X, x


@compiled
def back_substituted(L: FloatArray, X: FloatArray, x: FloatArray, delta: FloatArray) -> FloatArray:
    """Return the change of a pose (3 + 3 S) once that of the constants is known: Lᵀ d = x − X δ."""
    n = len(x)
    d = x.copy()
    for k in range(n):
        for i in range(len(delta)):
            d[k] -= X[k, i] * delta[i]
    kernels.solve_transposed(L, d)
    return d


@compiled
def jacobians(
    model: BodyModel, observed: FloatArray, robust_weights: FloatArray, R: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the Jacobians of all markers by the pose (3 M, 3 + 3 S) and by the constants
    (3 M, 3 (S−1) + 3 M), their weights and residuals.

    Rows of markers that were not seen are zero.
    """
    n_markers, n_segments = len(observed), len(model.parents)
    moving = np.zeros((3 * n_markers, 3 + 3 * n_segments))
    constant = np.zeros((3 * n_markers, 3 * (n_segments - 1) + 3 * n_markers))
    weights, residual = np.zeros(3 * n_markers), np.zeros(3 * n_markers)
    y = kernels.marker_places(model.segments, model.positions, R, p)
    for m in range(n_markers):
        if not robust_weights[m] > 0.0:
            continue
        s = model.segments[m]
        for i in range(3):
            row = 3 * m + i
            weights[row] = robust_weights[m] / model.sigmas[m] ** 2
            residual[row] = observed[m, i] - y[m, i]
            moving[row, i] = 1.0
            for j in range(3):
                constant[row, 3 * (n_segments - 1) + 3 * m + j] = R[s, i, j]
        a = s
        while a >= 0:
            d, at = y[m] - p[a], 3 + 3 * a
            moving[3 * m, at + 1], moving[3 * m, at + 2] = d[2], -d[1]
            moving[3 * m + 1, at], moving[3 * m + 1, at + 2] = -d[2], d[0]
            moving[3 * m + 2, at], moving[3 * m + 2, at + 1] = d[1], -d[0]
            parent = model.parents[a]
            if parent >= 0:  # segments stand after their parents, so the root is the first
                for i in range(3):
                    for j in range(3):
                        constant[3 * m + i, 3 * (a - 1) + j] = R[parent, i, j]
            a = parent
    return moving, constant, weights, residual
