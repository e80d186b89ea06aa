"""The method of CN1766831A as published: chain by chain, frame by frame, by BFGS.

Steps 5 to 8: virtual markers from the first frame; the chains' joint rotations by BFGS on the summed squared
distance, from the rules' rotations in the first frame and from the frame before in every later one, until the
gradient's norm is below 0.05; virtual markers anew as means, until the summed distance changes by less
than 0.5;
then quaternions → logarithm → linear time-invariant low-pass → exponential. Distances in mm, the unit of the
source's systems. Offline: it wants all frames at once. The default method is measured against it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from devices.deferred import butter, minimize, sosfiltfilt
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix as rm
from gateway.reconstruction.optical.pose_solver import BodyModel, body_model
from gateway.reconstruction.optical.published_chains import Chain, chain_gradient, chains_of, turned

GRADIENT = 0.05
"""Norm of the gradient at which a chain is solved, mm² per rad or mm."""
CHANGE = 0.5
"""Of the summed distance, mm, under which virtual markers count as found."""
CUTOFF_HZ = 6.0
_MOST_PASSES = 8
_MOST_STEPS = 60
"""Of BFGS in one chain and frame, where rounding keeps the gradient above ``GRADIENT``; the source has no
such bound, nor one on passes."""
_MM = 1e3

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class PublishedMotion:
    """Poses of F frames."""

    R: FloatArray  # (F, S, 3, 3) segment to world
    root: FloatArray  # (F, 3) m
    markers: BodyMarkers
    """With the virtual markers of the last pass."""
    passes: int


@dataclass(frozen=True)
class Trial:
    """F frames of markers, and poses to begin with."""

    observed: FloatArray  # (F, M, 3) m
    rate_hz: float
    axes: FloatArray  # (F, S, 3, 3) by rules; the first frame's is used
    root: FloatArray  # (F, 3) m, likewise


def solve_published(
    skeleton: Skeleton,
    markers: BodyMarkers,
    trial: Trial,
    *,
    refine: bool = True,
    progress: Progress | None = None,
) -> PublishedMotion:
    """Solve all frames.

    refine: False keeps the virtual markers as they are given, for frames the body was not fitted to.
    """
    model = body_model(skeleton, markers)
    observed = trial.observed
    R, places = trial.axes.copy(), trial.root.copy()
    before = np.inf
    passes = 0
    for passes in range(1, (_MOST_PASSES if refine else 1) + 1):  # noqa: B007 - told in the result
        R, places = _one_pass(skeleton, model, observed, R, places, progress)
        distance = _summed_distance(model, observed, R, places)
        if abs(before - distance) < CHANGE or not refine:
            break
        before = distance
        model = model._replace(positions=_mean_places(model, observed, R, places))
    smooth = _smoothed(R, trial.rate_hz)
    found = BodyMarkers(markers.labels, markers.segments, model.positions, markers.sigmas, markers.vertical)
    return PublishedMotion(smooth, places, found, passes)


def _one_pass(
    skeleton: Skeleton,
    model: BodyModel,
    observed: FloatArray,
    R: FloatArray,
    root: FloatArray,
    progress: Progress | None,
) -> tuple[FloatArray, FloatArray]:
    chains = chains_of(skeleton)
    found_R, found_root = np.empty_like(R), np.empty_like(root)
    now_R, now_root = R[0].copy(), root[0].copy()
    for frame, seen in enumerate(observed):
        for chain in chains:
            now_R, now_root = _solve_chain(model, seen, now_R, now_root, chain)
        found_R[frame], found_root[frame] = now_R, now_root
        if progress is not None:
            progress(frame + 1, len(observed))
    return found_R, found_root


def _solve_chain(
    model: BodyModel, seen: FloatArray, R: FloatArray, root: FloatArray, chain: Chain
) -> tuple[FloatArray, FloatArray]:
    """Return a pose with one chain solved.

    By BFGS over the turns of its joints, and over the root's shift where it begins at the world.
    """
    n = 3 * len(chain.segments) + (3 if chain.moves_root else 0)

    def cost(x: FloatArray) -> tuple[float, FloatArray]:
        return chain_gradient(model, seen, chain, R, root, x)

    found = minimize(
        cost,
        np.zeros(n),
        jac=True,
        method="BFGS",
        options={"gtol": GRADIENT, "norm": 2, "maxiter": _MOST_STEPS},
    )
    return turned(model, chain, R, root, found.x)


def _mean_places(model: BodyModel, observed: FloatArray, R: FloatArray, root: FloatArray) -> FloatArray:
    local = np.stack(
        [
            np.einsum(
                "mji,mj->mi",
                R[f][model.segments],
                observed[f] - model.joints_at(R[f], root[f])[model.segments],
            )
            for f in range(len(observed))
        ]
    )
    known = np.isfinite(local).all(axis=2)
    total = np.where(known[..., None], local, 0.0).sum(axis=0)
    mean: FloatArray = np.where(
        known.any(axis=0)[:, None], total / np.maximum(known.sum(axis=0), 1)[:, None], model.positions
    )
    return mean


def _summed_distance(model: BodyModel, observed: FloatArray, R: FloatArray, root: FloatArray) -> float:
    """Return the distance summed over all markers and frames, mm."""
    virtual = np.stack([model.markers_at(R[f], root[f]) for f in range(len(observed))])
    return float(np.nansum(np.linalg.norm(observed - virtual, axis=2)) * _MM)


def _smoothed(R: FloatArray, rate_hz: float) -> FloatArray:
    """Step 8: orientations through the tangent space, relative to each segment's first one; zero phase.

    The logarithm is unwrapped, so that a segment may turn right round.
    """
    n_frames, n_segments = R.shape[:2]
    if n_frames < 30 or rate_hz <= 2.2 * CUTOFF_HZ:
        return R
    sections = butter(2, CUTOFF_HZ, fs=rate_hz, output="sos")
    smooth = np.empty_like(R)
    for s in range(n_segments):
        logs = np.zeros((n_frames, 3))
        for f in range(1, n_frames):
            logs[f] = _nearest_log(rm.increment(R[0, s], R[f, s]), logs[f - 1])
        filtered = sosfiltfilt(sections, logs, axis=0)
        for f in range(n_frames):
            smooth[f, s] = R[0, s] @ rm.from_rotation_vector(filtered[f])
    return smooth


def _nearest_log(vector: FloatArray, before: FloatArray) -> FloatArray:
    """Return of the rotation vectors of one rotation the one nearest the one before; (3,) rad."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return vector
    turns = np.round((before @ vector / angle - angle) / (2.0 * np.pi))
    return vector * (1.0 + 2.0 * np.pi * turns / angle)
