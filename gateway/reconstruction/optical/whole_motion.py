"""All poses of a trial found together: what markers show at any instant helps every other one.

A gap is bridged by all that is seen while it lasts, through the chain of joints, by what joints may do, and
by how bodies move (``motion_kernels``): Gauss–Newton over whole stretches of frames, each with those after it
that still matter to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from devices.deferred import Rotation, Slerp
from gateway.frames import FloatArray, IntArray
from gateway.reconstruction.optical.motion_kernels import (
    REACH,
    Differences,
    Evidence,
    MovingPoses,
    UsualTurns,
    assembled,
    motion_cost,
    stepped,
)
from gateway.reconstruction.optical.pose_solver import BodyModel, Pose

FORGOTTEN_S = 1.0
"""Time in which a joint's rate, and the root's, is forgotten, s."""
TURN_JERK = 1300.0
"""Spectral density of joints' jerk, rad²/s⁵."""
JERK = 150.0
"""The same of the root's place, m²/s⁵."""
_WINDOW, _AHEAD = 400, 150
"""Frames of a stretch, and those after it that have a say in it."""
_MOST_STEPS = 10
_CONVERGED = 2e-3  # m and rad
_SHORTER, _SHORTEST = 0.3, 0.01
_FLOOR = 1e-9
"""Added to the diagonal, 1/m² and 1/rad²: of a turn that nothing holds."""

Done = Callable[[int], None]


def bridged(
    parents: IntArray, times_s: FloatArray, poses: list[Pose | None]
) -> tuple[FloatArray, FloatArray]:
    """Return R (F, S, 3, 3) and the root's places (F, 3) m, joints turned evenly through frames without a
    pose. The first and the last must have one."""
    known = [f for f, pose in enumerate(poses) if pose is not None]
    R = np.array([pose.R for pose in poses if pose is not None])
    roots = np.array([pose.root for pose in poses if pose is not None])
    if len(known) == len(poses):
        return R, roots
    at, filled = times_s[known], np.empty((len(poses), *R.shape[1:]))
    for s, parent in enumerate(parents.tolist()):
        joint = R[:, s] if parent < 0 else np.swapaxes(R[:, parent], 1, 2) @ R[:, s]
        turn = Slerp(at, Rotation.from_matrix(joint))(times_s).as_matrix()
        filled[:, s] = turn if parent < 0 else filled[:, parent] @ turn
    return filled, np.column_stack([np.interp(times_s, at, roots[:, i]) for i in range(3)])


def found_together(
    model: BodyModel,
    times_s: FloatArray,
    observed: FloatArray,
    begun: tuple[FloatArray, FloatArray],
    scales: tuple[float, ...],
    posture: UsualTurns,
    done: Done | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return R (F, S, 3, 3) and the root's places (F, 3) m that explain all frames best, near those given.

    observed: (F, M, 3) m, NaN where not seen; scales: m, distances at which a marker begins to lose its say,
    one after the other; posture: what joints are drawn to.
    """
    R, roots = begun[0].copy(), begun[1].copy()
    for first, end, kept in _windows(len(times_s)):
        fixed = max(0, first - REACH + 1)
        motion = MovingPoses(R[fixed:end], roots[fixed:end], first - fixed)
        differences = _differences(times_s[fixed:end], motion.free)
        for scale in scales:
            evidence = Evidence(
                model, np.ascontiguousarray(observed[fixed:end]), scale, differences,
                posture._replace(weights=posture.weights[fixed:end]),
            )  # fmt: skip
            motion = _settled(evidence, motion)
        R[first:end], roots[first:end] = motion.R[motion.free :], motion.root[motion.free :]
        if done is not None:
            done(kept)
    return R, roots


def _windows(n: int) -> Iterator[tuple[int, int, int]]:
    """Yield first frame, end, and the end of what is kept of it."""
    first = 0
    while first < n:
        end = min(first + _WINDOW + _AHEAD, n)
        kept = end if end == n else first + _WINDOW
        yield first, end, kept
        first = kept


def _settled(evidence: Evidence, motion: MovingPoses) -> MovingPoses:
    """Return the motion at the least cost.

    Steps are shortened where they do not lead down; damping would keep long gaps as they are, which change by
    hardly any of the cost.
    """
    from scipy.linalg import solveh_banded  # noqa: PLC0415 - takes a moment to import

    cost = motion_cost(evidence, motion)
    for _ in range(_MOST_STEPS):
        band, right = assembled(evidence, motion)
        band[:, 0] += _FLOOR
        change = solveh_banded(band.T, right, lower=True, overwrite_ab=True, check_finite=False)
        share = 1.0
        moved = stepped(evidence.model, motion, change)
        while not (after := motion_cost(evidence, moved)) < cost:
            share *= _SHORTER
            if share < _SHORTEST:
                return motion
            moved = stepped(evidence.model, motion, share * change)
        motion, cost = moved, after
        if share * float(np.abs(change).max()) < _CONVERGED:
            break
    return motion


def _differences(times_s: FloatArray, free: int) -> Differences:
    """Return first, second and third differences in which a frame from ``free`` on takes part."""
    rate = 1.0 / FORGOTTEN_S
    shares = {1: rate**4, 2: 2.0 * rate**2, 3: 1.0}
    firsts, counts, factors, weights = [], [], [], []
    for order, share in shares.items():
        for first in range(max(0, free - order), len(times_s) - order):
            at = times_s[first : first + order + 1]
            firsts.append(first)
            counts.append(order + 1)
            factors.append(np.append(_divided(at), np.zeros(REACH - 1 - order)))
            weights.append(share * (at[-1] - at[0]) / order)
    n = np.array(weights)
    return Differences(
        np.array(firsts, dtype=np.int64), np.array(counts, dtype=np.int64),
        np.array(factors).reshape(-1, REACH), n / TURN_JERK, n / JERK,
    )  # fmt: skip


def _divided(at: FloatArray) -> FloatArray:
    """Return factors of values at so many instants that give their highest derivative."""
    apart = at[:, None] - at[None, :]
    np.fill_diagonal(apart, 1.0)
    factors: FloatArray = np.prod(np.arange(1, len(at))) / np.prod(apart, axis=1)
    return factors
