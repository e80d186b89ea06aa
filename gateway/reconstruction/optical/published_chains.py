"""The chains of CN1766831A, and the gradient of one chain's markers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import cross, dot, is_finite, norm, skew
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.pose_solver import BodyModel

_MM = 1e3


class Chain(NamedTuple):
    """Segments whose joints are solved together, from the root outwards."""

    segments: IntArray
    moves_root: bool


def chains_of(skeleton: Skeleton) -> list[Chain]:
    """Return world → root; then every way from the root to a limb's end, cut where ways part.

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


@compiled
def turned(
    model: BodyModel, chain: Chain, R: FloatArray, root: FloatArray, x: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a pose (S, 3, 3), (3,) m after turns x of a chain's joints (rad, 3 each), and, where the root
    moves, its shift (mm, the last three)."""
    delta = np.zeros(3 + 3 * len(model.parents))
    for k in range(len(chain.segments)):
        at = 3 + 3 * chain.segments[k]
        delta[at : at + 3] = x[3 * k : 3 * k + 3]
    if chain.moves_root:
        delta[:3] = x[-3:] / _MM
    return kernels.moved(model.parents, R, root, delta)


@compiled
def chain_gradient(
    model: BodyModel, observed: FloatArray, chain: Chain, R: FloatArray, root: FloatArray, x: FloatArray
) -> tuple[float, FloatArray]:
    """Return Σ |virtual − real|² of the chain's markers, mm², and its gradient by the chain's turns (rad) and
    shift (mm). R (S, 3, 3), root (3,) m: the pose before them.

    The turn x of a joint is exp([x]×) in world
    axes before the turns of the joints above it, so its derivative takes them along and the left Jacobian of
    the exponential (Solà et al. 2018, arXiv 1812.01537, eq. 145).
    """
    R_now, root_now = turned(model, chain, R, root, x)
    p = kernels.places(model.parents, model.offsets, R_now, root_now)
    y = kernels.marker_places(model.segments, model.positions, R_now, p)
    n = len(chain.segments)
    rows = np.full(len(model.parents), -1)
    for k in range(n):
        rows[chain.segments[k]] = k
    torques, force, total = np.zeros((n, 3)), np.zeros(3), 0.0
    for m in range(len(y)):
        row = rows[model.segments[m]]
        if row < 0 or not is_finite(observed[m]):
            continue
        error = (y[m] - observed[m]) * _MM
        total += dot(error, error)
        force += 2.0 * error
        for k in range(row + 1):
            torques[k] += 2.0 * cross((y[m] - p[chain.segments[k]]) * _MM, error)
    gradient = np.zeros(len(x))
    carried = np.eye(3)
    for k in range(n):
        s = chain.segments[k]
        own = rm.rotate_inverse(carried, torques[k])
        gradient[3 * k : 3 * k + 3] = rm.rotate_inverse(left_jacobian(x[3 * k : 3 * k + 3]), own)
        carried = rm.multiply(R_now[s], R[s].T.copy())
    if chain.moves_root:
        gradient[-3:] = force
    return total, gradient


@compiled
def left_jacobian(x: FloatArray) -> FloatArray:
    """Return J with exp([x + d]×) ≈ exp([J d]×) exp([x]×), (3, 3)."""
    angle, X = norm(x), skew(x)
    if angle < 1e-6:
        return np.eye(3) + 0.5 * X
    a = (1.0 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    jacobian: FloatArray = np.eye(3) + a * X + b * rm.multiply(X, X)
    return jacobian
