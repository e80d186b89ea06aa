"""Lengths and markers' places that explain all poses best: the poses and the body found together.

Gauss–Newton over the poses of K frames and what is constant in all of them (joint offsets, markers' places);
poses are eliminated frame by frame by the Schur complement, as in bundle adjustment (Triggs et al. 2000, Vision
Algorithms: 298–372). Joint centres that the motion shows are so found from motion (functional centres, as
Reinbolt et al. 2005, J. Biomech. 38(3): 621–626, do by nested optimisation); those that it does not show stay
where the rules have them, each by its trust.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.pose_solver import BodyModel, Pose, normal_equations, solve_pose

INDEPENDENT_FRAMES = 20.0
"""Frames count as no more than so many independent ones: skin moves alike in frames near each other."""
PLACE_TRUST = 0.03
"""How far a marker's place may move from the mean that rules give, 1 σ, m. It holds the segments' axes."""
LOOSENESS = 0.01
"""Of the joints' stiffness while the body itself is sought."""
_STEPS = 25
_CONVERGED = 2e-5  # m


@dataclass(frozen=True)
class Adjusted:
    """What came of it."""

    model: BodyModel
    poses: list[Pose]
    rmse: float
    """m, over all markers seen, each with the say it had."""
    steps: int


def adjusted(
    model: BodyModel, observed: FloatArray, poses: list[Pose], trust: FloatArray, scale: float
) -> Adjusted:
    """The body that fits K frames.

    observed: (K, M, 3) m, NaN where not seen; poses: K to begin with; trust: (S,) m, 1 σ of every joint's
    place in its parent. scale: see ``solve_pose``.
    """
    allowed, model = model, _loose(model)
    first = np.concatenate([model.offsets[model.parents >= 0].ravel(), model.positions.ravel()])
    joints = int((model.parents >= 0).sum())
    stiffness = np.concatenate(
        [np.repeat(trust[model.parents >= 0] ** -2, 3), np.full(model.positions.size, PLACE_TRUST**-2)]
    )
    temper = min(1.0, INDEPENDENT_FRAMES / len(observed))
    everyone = np.ones(observed.shape[1])
    now, steps = first.copy(), 0
    change = np.inf
    while steps < _STEPS and change > _CONVERGED:
        steps += 1
        delta, turns = _step(model, observed, poses, stiffness * (first - now), stiffness, temper)
        now = now + delta
        change = float(np.abs(delta).max())
        offsets = model.offsets.copy()
        offsets[model.parents >= 0] = now[: 3 * joints].reshape(-1, 3)
        model = model._replace(offsets=offsets, positions=now[3 * joints :].reshape(-1, 3))
        starts = [
            kernels.moved(model.parents, pose.R, pose.root, turn)
            for pose, turn in zip(poses, turns, strict=True)
        ]
        poses = [
            solve_pose(model, seen, everyone, R, root, scale, 4)
            for seen, (R, root) in zip(observed, starts, strict=True)
        ]
    model = model._replace(stiffness=allowed.stiffness, limit_stiffness=allowed.limit_stiffness)
    return Adjusted(model, poses, weighted_rmse(poses), steps)


def _loose(model: BodyModel) -> BodyModel:
    """What joints are allowed must hold poses that markers leave open, and not bend the body to fit."""
    return model._replace(stiffness=model.stiffness * LOOSENESS, limit_stiffness=0.0)


def weighted_rmse(poses: list[Pose]) -> float:
    """Root mean square of the residuals, m, weighted by the say of each."""
    say = np.array([pose.weights for pose in poses])
    squares = np.nan_to_num(np.array([pose.residuals for pose in poses])) ** 2
    return float(np.sqrt((say * squares).sum() / max(say.sum(), 1e-12)))


def with_sigmas(model: BodyModel, poses: list[Pose], smallest: float) -> BodyModel:
    """The model with every marker's σ as its residuals show it, per coordinate, m, not below ``smallest``."""
    say = np.array([pose.weights for pose in poses])
    squares = np.nan_to_num(np.array([pose.residuals for pose in poses])) ** 2
    mean = (say * squares).sum(axis=0) / np.maximum(say.sum(axis=0), 1e-12)
    return model._replace(sigmas=np.maximum(np.sqrt(mean / 3.0), smallest))


def _step(
    model: BodyModel,
    observed: FloatArray,
    poses: list[Pose],
    pull: FloatArray,
    stiffness: FloatArray,
    temper: float,
) -> tuple[FloatArray, list[FloatArray]]:
    """Changes of what is constant, and of every pose (3 + 3 S)."""
    schur, right = np.diag(stiffness), pull.copy()
    eliminated = [
        _eliminate(model, seen, pose.weights, pose.R, pose.root, schur, right, temper)
        for seen, pose in zip(observed, poses, strict=True)
    ]
    schur[np.diag_indices_from(schur)] *= 1.0 + 1e-6
    if not kernels.cholesky(schur):
        raise GatewayError("the markers do not determine a body: too few of them, or all in one place")
    delta = kernels.substituted(schur, right)
    return delta, [_back_substituted(factor, shared, own, delta) for factor, shared, own in eliminated]


@compiled
def _eliminate(
    model: BodyModel, observed: FloatArray, say: FloatArray, R: FloatArray, root: FloatArray,
    schur: FloatArray, right: FloatArray, temper: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Take one pose out of the equations: adds to ``schur`` (lower triangle) and ``right``.

    With H = L Lᵀ of the pose, C its coupling to the constants and g its gradient: X = L⁻¹ C and x = L⁻¹ g,
    schur += Jᵀ W J − Xᵀ X, right += Jᵀ W r − Xᵀ x. Returns L, X, x. (No BLAS: its threads cost more here.)
    """
    p = kernels.places(model.parents, model.offsets, R, root)
    L, x, _ = normal_equations(model, observed, say, R, p)
    kernels.mirrored(L)
    n, m = len(x), len(right)
    for i in range(n):
        L[i, i] += 1e-6 * L[i, i] + 1e-9
    kernels.cholesky(L)
    moving, constant, weights, residual = _jacobians(model, observed, say, R, p)
    X = np.zeros((n, m))
    for row in range(len(weights)):
        filled = np.flatnonzero(constant[row])
        for i in filled:
            weighted = weights[row] * constant[row, i]
            right[i] += temper * weighted * residual[row]
            for j in filled:
                schur[i, j] += temper * weighted * constant[row, j]
            for k in range(n):
                X[k, i] += weighted * moving[row, k]
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
def _back_substituted(L: FloatArray, X: FloatArray, x: FloatArray, delta: FloatArray) -> FloatArray:
    """The change of a pose (3 + 3 S) once that of the constants is known: Lᵀ d = x − X δ."""
    n = len(x)
    d = x.copy()
    for k in range(n):
        for i in range(len(delta)):
            d[k] -= X[k, i] * delta[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            d[i] -= L[k, i] * d[k]
        d[i] /= L[i, i]
    return d


@compiled
def _jacobians(
    model: BodyModel, observed: FloatArray, say: FloatArray, R: FloatArray, p: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Of all markers by the pose (3 M, 3 + 3 S) and by the constants (3 M, 3 (S−1) + 3 M); weights, residuals.

    Rows of markers that were not seen are zero.
    """
    n_markers, n_segments = len(observed), len(model.parents)
    moving = np.zeros((3 * n_markers, 3 + 3 * n_segments))
    constant = np.zeros((3 * n_markers, 3 * (n_segments - 1) + 3 * n_markers))
    weights, residual = np.zeros(3 * n_markers), np.zeros(3 * n_markers)
    y = kernels.marker_places(model.segments, model.positions, R, p)
    for m in range(n_markers):
        if not say[m] > 0.0:
            continue
        s = model.segments[m]
        for i in range(3):
            row = 3 * m + i
            weights[row] = say[m] / model.sigmas[m] ** 2
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

