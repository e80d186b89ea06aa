"""The chains of CN1766831A, and the gradient of one chain's markers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.pose_solver import BodyModel

_MM = 1e3


class Chain(NamedTuple):
    """Segments whose joints are solved together, from the root outwards."""

    segments: IntArray
    moves_root: bool


def chains_of(skeleton: Skeleton) -> list[Chain]:
    """World → root; then every way from the root to a limb's end, cut where ways part.

    On a person that is: the root; each leg; waist to chest; chest to head; each arm with its clavicle. Any
    other tree is cut in the same way.
    """
    root = int(np.flatnonzero(skeleton.parents < 0)[0])
    chains = [Chain(np.array([root]), True)]
    children = [np.flatnonzero(skeleton.parents == s).tolist() for s in range(skeleton.n_segments)]
    begun = list(children[root])
    while begun:
        segment = begun.pop(0)
        way = [segment]
        while len(children[way[-1]]) == 1:
            way.append(children[way[-1]][0])
        chains.append(Chain(np.array(way), False))
        begun += children[way[-1]]
    return chains


class Turned(NamedTuple):
    """A pose after turns of some joints."""

    R: FloatArray  # (S, 3, 3) segment to world
    root: FloatArray  # (3,) m
    R_start: FloatArray  # (S, 3, 3), before
    turns: FloatArray  # 3 a segment of the chain, rad; where the root moves also its shift


def chain_gradient(
    model: BodyModel, observed: FloatArray, chain: Chain, pose: Turned
) -> tuple[float, FloatArray]:
    """Return Σ |virtual − real|² of the chain's markers, mm², and its gradient by the chain's turns (rad) and
    shift (mm).

    The turn x of a joint is exp([x]×) in world
    axes before the turns of the joints above it, so its derivative takes them along and the left Jacobian of
    the exponential (Solà et al. 2018, arXiv 1812.01537, eq. 145).
    """
    segments, R = chain.segments, pose.R
    p = kernels.places(model.parents, model.offsets, R, pose.root)
    y = kernels.marker_places(model.segments, model.positions, R, p)
    gradient = np.zeros(3 * len(segments) + (3 if chain.moves_root else 0))
    total = 0.0
    carried = np.eye(3)
    inside = np.isin(model.segments, segments) & np.isfinite(observed).all(axis=1)
    error = np.where(inside[:, None], (y - observed) * _MM, 0.0)
    total = float((error**2).sum())
    for k, s in enumerate(segments.tolist()):
        below = inside & np.isin(model.segments, segments[k:])
        arms = (y[below] - p[s]) * _MM
        torque = 2.0 * np.cross(arms, error[below]).sum(axis=0)
        gradient[3 * k : 3 * k + 3] = left_jacobian(pose.turns[3 * k : 3 * k + 3]).T @ carried.T @ torque
        carried = R[s] @ pose.R_start[s].T
    if chain.moves_root:
        gradient[-3:] = 2.0 * error.sum(axis=0)
    return total, gradient


def left_jacobian(x: FloatArray) -> FloatArray:
    """Return J with exp([x + d]×) ≈ exp([J d]×) exp([x]×), (3, 3)."""
    angle = float(np.linalg.norm(x))
    X = np.array([[0.0, -x[2], x[1]], [x[2], 0.0, -x[0]], [-x[1], x[0], 0.0]])
    if angle < 1e-6:
        return np.eye(3) + 0.5 * X
    a = (1.0 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    jacobian: FloatArray = np.eye(3) + a * X + b * X @ X
    return jacobian
