"""Lengths and markers' places that explain all poses best: the poses and the body found together.

Gauss–Newton over the poses of K frames and what is constant in all of them (joint offsets, markers' places);
poses are eliminated frame by frame by the Schur complement, as in bundle adjustment (Triggs et al. 2000,
Vision
Algorithms: 298–372). Joint centres that the motion shows are so found from motion (functional centres, as
Reinbolt et al. 2005, J. Biomech. 38(3): 621–626, do by nested optimisation); those that it does not show stay
where the rules have them, each by its trust.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.errors import GatewayError
from gateway.frames import FloatArray, IntArray
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.bundle_kernels import Reduced, back_substituted, eliminate
from gateway.reconstruction.optical.pose_solver import (
    FIXED_SIGMA,
    BodyModel,
    Held,
    Pose,
    everyone,
    solve_pose,
)

INDEPENDENT_FRAMES = 2.0
"""Frames count as no more than so many independent ones: skin moves alike in frames near each other."""
PLACE_TRUST = 0.004
"""How far a marker's place may move against others on its segment from the mean that rules give, 1 σ, m. It
holds the segments' axes."""
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
    """m, over all markers seen, each with its robust weight."""
    steps: int


def adjusted(
    model: BodyModel,
    observed: FloatArray,
    poses: list[Pose],
    trust: FloatArray,
    scale: float,
    bending: Sequence[int] = (),
) -> Adjusted:
    """Return the body that fits K frames.

    observed: (K, M, 3) m, NaN where not seen; poses: K to begin with; trust: (S,) m, 1 σ of every joint's
    place in its parent. scale: see ``solve_pose``. bending: segments whose joints bend in one plane only.
    """
    allowed, model = model, _loose(model, bending)
    first = np.concatenate([model.offsets[model.parents >= 0].ravel(), model.positions.ravel()])
    joints = int((model.parents >= 0).sum())
    stiffness = _stiffness(model, trust)
    temper = min(1.0, INDEPENDENT_FRAMES / len(observed))
    now, steps = first.copy(), 0
    change = np.inf
    while steps < _STEPS and change > _CONVERGED:
        steps += 1
        delta, turns = _step(model, observed, poses, stiffness @ (first - now), stiffness, temper)
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
            solve_pose(model, everyone(seen, scale), R, root, Held(R), 4)
            for seen, (R, root) in zip(observed, starts, strict=True)
        ]
    model = model._replace(stiffness=allowed.stiffness, limit_stiffness=allowed.limit_stiffness)
    return Adjusted(model, poses, weighted_rmse(poses), steps)


def _stiffness(model: BodyModel, trust: FloatArray) -> FloatArray:
    """Return the inverse covariance of what is constant: joint offsets, then markers' places, (n, n), 1/m².

    What lies on a segment, its markers and the joints it carries, keeps its shape, each by its own trust; the
    joint in which the segment hangs may move against all of them together, by the segment's trust.
    """
    carried = np.flatnonzero(model.parents >= 0)
    owners = np.concatenate([model.parents[carried], model.segments])
    own = np.concatenate([trust[carried], np.full(len(model.segments), PLACE_TRUST)]) ** -2.0
    inverse = np.diag(own)
    for s in range(len(model.parents)):
        on = np.flatnonzero(owners == s)
        if len(on):
            # (D⁻¹ + t² 1 1ᵀ)⁻¹ by Sherman and Morrison
            inverse[np.ix_(on, on)] -= np.outer(own[on], own[on]) / (trust[s] ** -2.0 + own[on].sum())
    stiffness: FloatArray = np.asarray(np.kron(inverse, np.eye(3)), dtype=np.float64)
    return stiffness


def _loose(model: BodyModel, bending: Sequence[int] = ()) -> BodyModel:
    """Return the model with joints that hold poses which markers leave open, but do not bend the body.

    A segment with a single marker of its own keeps its stiffness: how it turns about the line through marker
    and joint is not seen, and turns made up for it would move the joints on it. One that bends in a plane
    keeps that of the angles it does not have: skin turns about a bone's length by more than such a joint.
    """
    looseness = np.where(own_markers(model)[model.distals] == 1, 1.0, LOOSENESS)[:, None]
    is_held = np.isin(model.distals, bending)[:, None] & (model.stiffness >= FIXED_SIGMA**-2)
    stiffness = model.stiffness * np.where(is_held, 1.0, looseness)
    return model._replace(stiffness=stiffness, limit_stiffness=0.0)


def own_markers(model: BodyModel) -> IntArray:
    """Return (S,) how many markers each segment carries."""
    return np.bincount(model.segments, minlength=len(model.parents))


def weighted_rmse(poses: list[Pose]) -> float:
    """Return the root mean square of the residuals, m, by their robust weights."""
    robust_weights = np.array([pose.weights for pose in poses])
    squares = np.nan_to_num(np.array([pose.residuals for pose in poses])) ** 2
    return float(np.sqrt((robust_weights * squares).sum() / max(robust_weights.sum(), 1e-12)))


def with_sigmas(model: BodyModel, poses: list[Pose], smallest: float) -> BodyModel:
    """Return the model with every marker's σ as its residuals show it, per coordinate, m, not below
    ``smallest``."""
    robust_weights = np.array([pose.weights for pose in poses])
    squares = np.nan_to_num(np.array([pose.residuals for pose in poses])) ** 2
    mean = (robust_weights * squares).sum(axis=0) / np.maximum(robust_weights.sum(axis=0), 1e-12)
    return model._replace(sigmas=np.maximum(np.sqrt(mean / 3.0), smallest))


def _step(
    model: BodyModel,
    observed: FloatArray,
    poses: list[Pose],
    pull: FloatArray,
    stiffness: FloatArray,
    temper: float,
) -> tuple[FloatArray, list[FloatArray]]:
    """Return changes of what is constant, and of every pose (3 + 3 S)."""
    schur, right = stiffness.copy(), pull.copy()
    reduced = Reduced(schur, right)
    eliminated = [
        eliminate(model, seen, pose, reduced, temper) for seen, pose in zip(observed, poses, strict=True)
    ]
    schur[np.diag_indices_from(schur)] *= 1.0 + 1e-6
    if not kernels.cholesky(schur):
        raise GatewayError("the markers do not determine a body: too few of them, or all in one place")
    delta = kernels.substituted(schur, right)
    return delta, [back_substituted(factor, shared, own, delta) for factor, shared, own in eliminated]
