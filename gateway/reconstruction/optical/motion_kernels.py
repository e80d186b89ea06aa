"""The equations of a stretch of motion: poses of neighbouring frames, drawn together by how bodies move.

Every joint's turn and the root's place x follow a motion whose rate is a Matérn process of smoothness 3/2
(Rasmussen & Williams 2006, Gaussian Processes for Machine Learning, 4.2.1): its spectrum 1 / (ω² (ω² + λ²)²)
is that of the cost

    ½ Σ Δt / q · (|x‴|² + 2 λ² |x″|² + λ⁴ |x′|²),

q the spectral density of jerk and 1/λ the time in which a rate is forgotten. Short gaps are so crossed with
the least jerk (Flash & Hogan 1985, J. Neurosci. 5: 1688), long ones by the straight way. Differences of turns
are taken in the chart about a pose in their middle (Solà et al. 2018, arXiv 1812.01537). Compiled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, IntArray
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, is_finite, norm, skew
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.pose_solver import (
    BodyModel,
    WeighedMarkers,
    marker_weights,
    normal_equations,
)

REACH = 4
"""Frames that a third difference takes: as far apart may frames be that know of each other."""


class Differences(NamedTuple):
    """Finite differences of D stencils: which frames, with which factors, and how much each counts."""

    first: IntArray  # (D,) its first frame
    frames: IntArray  # (D,) its frames, 2 to ``REACH``
    factors: FloatArray  # (D, REACH) 1/s^order
    joint_weight: FloatArray  # (D,) for rad / s^order
    place_weight: FloatArray  # (D,) for m / s^order


class UsualTurns(NamedTuple):
    """What a person's joints usually do: every joint's mean turn, and how far it is from that."""

    mean: FloatArray  # (S, 3, 3) in the parent's axes
    precision: FloatArray  # (S, 3, 3) 1/rad², of the turn from the mean in the segment's axes
    weights: FloatArray  # (F,) how much each frame counts


class Evidence(NamedTuple):
    """What a motion is found from: markers, a body, how motions go on, and what joints usually do."""

    model: BodyModel
    observed: FloatArray  # (F, M, 3) m, NaN where not seen
    scale: float  # m, as in ``WeighedMarkers``
    differences: Differences
    posture: UsualTurns


class MovingPoses(NamedTuple):
    """Poses of F frames, of which those from ``free`` on may move."""

    R: FloatArray  # (F, S, 3, 3)
    root: FloatArray  # (F, 3) m
    free: int


@compiled
def motion_cost(evidence: Evidence, motion: MovingPoses) -> float:
    """Return what markers, joints, motion and posture cost together."""
    model, observed, scale, differences, posture = evidence
    total = 0.0
    nobody = np.zeros(observed.shape[1])
    for f in range(motion.free, len(observed)):
        R = motion.R[f]
        p = kernels.places(model.parents, model.offsets, R, motion.root[f])
        y = kernels.marker_places(model.segments, model.positions, R, p)
        for m in range(len(y)):
            if is_finite(observed[f, m]):
                r = norm(observed[f, m] - y[m])
                c = max(scale, 4.0 * model.sigmas[m])
                total += 0.5 * (r / model.sigmas[m]) ** 2 / (1.0 + (r / c) ** 2)
        total += normal_equations(model, observed[f], nobody, R, p)[2]
    joints = joint_turns(model.parents, motion.R)
    for f in range(motion.free, len(observed)):
        for s in range(joints.shape[1]):
            u = rm.increment(posture.mean[s], joints[f, s])
            total += 0.5 * posture.weights[f] * dot(u, rm.rotate(posture.precision[s], u))
    for d in range(len(differences.first)):
        for s in range(joints.shape[1]):
            e = _difference(joints, differences, d, s)
            total += 0.5 * differences.joint_weight[d] * dot(e, e)
        e = _place_difference(motion.root, differences, d)
        total += 0.5 * differences.place_weight[d] * dot(e, e)
    return total


@compiled
def assembled(evidence: Evidence, motion: MovingPoses) -> tuple[FloatArray, FloatArray]:
    """Return the normal equations of the free frames' changes, n = (3 + 3 S) each.

    The matrix is (frames n, REACH n): element [i, k] is that of row i + k and column i.
    """
    model, observed, scale, differences, posture = evidence
    n = 3 + 3 * len(model.parents)
    free = motion.free
    band = np.zeros(((len(observed) - free) * n, REACH * n))
    right = np.zeros((len(observed) - free) * n)
    everybody = np.ones(observed.shape[1])
    for f in range(free, len(observed)):
        R, at = motion.R[f], (f - free) * n
        p = kernels.places(model.parents, model.offsets, R, motion.root[f])
        y = kernels.marker_places(model.segments, model.positions, R, p)
        robust_weights = marker_weights(model, WeighedMarkers(observed[f], everybody, scale), y)
        H, g, _ = normal_equations(model, observed[f], robust_weights, R, p)
        for i in range(n):
            right[at + i] += g[i]
            for j in range(i, n):
                band[at + i, j - i] += H[i, j]
    joints = joint_turns(model.parents, motion.R)
    for f in range(free, len(observed)):
        _add_posture(band, right, motion, joints, posture, f)
    for d in range(len(differences.first)):
        _add_places(band, right, motion, differences, d, n)
        for s in range(joints.shape[1]):
            _add_turns(band, right, motion, joints, differences, d, s)
    return band, right


@compiled
def stepped(model: BodyModel, motion: MovingPoses, change: FloatArray) -> MovingPoses:
    """Return the motion with its free frames changed, (free frames (3 + 3 S),)."""
    R, root = motion.R.copy(), motion.root.copy()
    n = 3 + 3 * len(model.parents)
    for f in range(motion.free, len(R)):
        at = (f - motion.free) * n
        R[f], root[f] = kernels.moved(model.parents, R[f], root[f], change[at : at + n])
    return MovingPoses(R, root, motion.free)


@compiled
def joint_turns(parents: IntArray, R: FloatArray) -> FloatArray:
    """Return (F, S, 3, 3) every segment in its parent's axes, the root in the world's."""
    turns = R.copy()
    for f in range(len(R)):
        for s in range(len(parents)):
            if parents[s] >= 0:
                turns[f, s] = rm.multiply(R[f, parents[s]].T.copy(), R[f, s])
    return turns


@compiled
def _difference(joints: FloatArray, differences: Differences, d: int, s: int) -> FloatArray:
    """Return (3,) the difference of a joint's turns, in the chart about that in the middle."""
    first, count = differences.first[d], differences.frames[d]
    e = np.zeros(3)
    for k in range(count):
        e += differences.factors[d, k] * rm.increment(joints[first + count // 2, s], joints[first + k, s])
    return e


@compiled
def _by_turn_in_world(u: FloatArray, R: FloatArray) -> FloatArray:
    """Return how a chart's vector u changes by a turn in the world of the segment at R: the inverse right
    Jacobian, to first order."""
    jacobian = 0.5 * skew(u)
    for i in range(3):
        jacobian[i, i] += 1.0
    return rm.multiply(jacobian, R.T.copy())


@compiled
def _add_posture(
    band: FloatArray, right: FloatArray, motion: MovingPoses, joints: FloatArray, posture: UsualTurns, f: int
) -> None:
    n = 3 + 3 * joints.shape[1]
    for s in range(joints.shape[1]):
        row = (f - motion.free) * n + 3 + 3 * s
        u = rm.increment(posture.mean[s], joints[f, s])
        J = _by_turn_in_world(u, motion.R[f, s])
        drawn = posture.weights[f] * rm.multiply(J.T.copy(), posture.precision[s])
        H, pull = rm.multiply(drawn, J), rm.rotate(drawn, u)
        for i in range(3):
            right[row + i] -= pull[i]
            for j in range(i, 3):
                band[row + i, j - i] += H[i, j]


@compiled
def _place_difference(root: FloatArray, differences: Differences, d: int) -> FloatArray:
    e = np.zeros(3)
    for k in range(differences.frames[d]):
        e += differences.factors[d, k] * root[differences.first[d] + k]
    return e


@compiled
def _add_places(
    band: FloatArray, right: FloatArray, motion: MovingPoses, differences: Differences, d: int, n: int
) -> None:
    first, count, weight = differences.first[d], differences.frames[d], differences.place_weight[d]
    e = _place_difference(motion.root, differences, d)
    for a in range(count):
        row = (first + a - motion.free) * n
        if row < 0:
            continue
        for i in range(3):
            right[row + i] -= weight * differences.factors[d, a] * e[i]
            for b in range(a, count):
                both = differences.factors[d, a] * differences.factors[d, b]
                band[row + i, (b - a) * n] += weight * both


@compiled
def _add_turns(
    band: FloatArray,
    right: FloatArray,
    motion: MovingPoses,
    joints: FloatArray,
    differences: Differences,
    d: int,
    s: int,
) -> None:
    first, count, weight = differences.first[d], differences.frames[d], differences.joint_weight[d]
    n = 3 + 3 * joints.shape[1]
    e = np.zeros(3)
    jacobians = np.empty((REACH, 3, 3))
    for k in range(count):
        u = rm.increment(joints[first + count // 2, s], joints[first + k, s])
        e += differences.factors[d, k] * u
        jacobians[k] = differences.factors[d, k] * _by_turn_in_world(u, motion.R[first + k, s])
    for a in range(count):
        row = (first + a - motion.free) * n + 3 + 3 * s
        if row < 0:
            continue
        A = jacobians[a]
        for i in range(3):
            right[row + i] -= weight * (A[0, i] * e[0] + A[1, i] * e[1] + A[2, i] * e[2])
        for b in range(a, count):
            B = jacobians[b]
            for i in range(3):
                for j in range(i if a == b else 0, 3):
                    both = A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j]
                    band[row + i, (b - a) * n + j - i] += weight * both
