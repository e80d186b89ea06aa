"""From frame to frame: where to begin, and which marker is which."""

from __future__ import annotations

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite
from gateway.reconstruction.optical.pose_solver import BodyModel, Pose, solve_pose

NEAR = 0.03
"""Distance at which a marker begins to lose its say once the pose is known, m."""
_SCALES = (2.0, 0.3, 0.1, NEAR)
"""The same while a pose is sought from nowhere: all markers speak at first."""
_LONGEST = 60


@compiled
def rigid(here: FloatArray, there: FloatArray) -> tuple[FloatArray, FloatArray]:
    """R, t with there ≈ R here + t over the rows known in both (n, 3): Kabsch 1976 (Acta Cryst. A32: 922)."""
    n = 0
    a, b = np.zeros(3), np.zeros(3)
    for i in range(len(here)):
        if is_finite(there[i]) and is_finite(here[i]):
            a += here[i]
            b += there[i]
            n += 1
    a /= n
    b /= n
    C = np.zeros((3, 3))
    for i in range(len(here)):
        if is_finite(there[i]) and is_finite(here[i]):
            for j in range(3):
                for k in range(3):
                    C[j, k] += (there[i, j] - b[j]) * (here[i, k] - a[k])
    u, _, vt = np.linalg.svd(C)
    d = np.eye(3)
    d[2, 2] = np.sign(np.linalg.det(u @ vt))
    R = u @ d @ vt
    return R, b - rm.rotate(R, a)


@compiled
def turned_on(before: FloatArray, now: FloatArray, fraction: float) -> FloatArray:
    """Orientations (S, 3, 3) turned on by a fraction of the turn between two poses."""
    ahead = np.empty_like(now)
    for s in range(len(now)):
        ahead[s] = rm.multiply(now[s], rm.from_rotation_vector(fraction * rm.increment(before[s], now[s])))
    return ahead


def start_pose(model: BodyModel, observed: FloatArray, neutral: FloatArray) -> Pose | None:
    """The pose of markers (M, 3) from nothing but them; None with fewer than three markers.

    neutral: (3, 3) of every segment in the neutral posture. The neutral body is laid over the markers as if
    it were rigid, and then let loose.
    """
    if np.isfinite(observed).all(axis=1).sum() < 3:
        return None
    n = len(model.parents)
    R = np.tile(neutral, (n, 1, 1))
    everyone = np.ones(len(observed))
    rest = _neutral_markers(model, neutral)
    turn, shift = rigid(rest, observed)
    R = turn @ R
    pose: Pose | None = None
    for scale in _SCALES:
        begin = (R, shift) if pose is None else (pose.R, pose.root)
        pose = solve_pose(model, observed, everyone, *begin, scale, _LONGEST, begin[0], 0.0)
    return pose


def _neutral_markers(model: BodyModel, neutral: FloatArray) -> FloatArray:
    """(M, 3) with the root at the origin, m."""
    p = np.zeros((len(model.parents), 3))
    for s, parent in enumerate(model.parents.tolist()):
        if parent >= 0:
            p[s] = p[parent] + neutral @ model.offsets[s]
    return p[model.segments] + model.positions @ neutral.T
