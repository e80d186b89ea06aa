"""Segment axes after a fit: markers determine a rigid segment, not which of its axes is called x.

While body and poses are sought together, a segment's axes may turn if all that lies on it turns back. They
are put back to where the rules have them, on average, or to the neutral posture of a person who stood in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gateway.frames import FloatArray
from gateway.reconstruction.optical.bundle import Adjusted
from gateway.reconstruction.optical.pose_solver import BodyModel, Pose
from gateway.reconstruction.optical.rule_body import mean_rotation

_STRAIGHT = np.radians(15.0)
"""A joint that is never bent by more shows no plane."""


def turns_to_rules(poses: Sequence[Pose], axes: FloatArray) -> FloatArray:
    """Return (S, 3, 3) constant turns C with R C nearest the rules' axes (K, S, 3, 3) over the poses; NaN
    axes count for nothing."""
    turns = np.empty(axes.shape[1:])
    R = np.stack([pose.R for pose in poses])
    for s in range(axes.shape[1]):
        known = np.isfinite(axes[:, s]).all(axis=(1, 2))
        local = np.einsum("kji,kjl->kil", R[known, s], axes[known, s])
        turns[s] = mean_rotation(local) if known.any() else np.eye(3)
    return turns


def turns_to_neutral(standing: Sequence[Pose], upright: FloatArray) -> FloatArray:
    """Return (S, 3, 3) constant turns after which all segments have the axes ``upright`` (3, 3) in those
    poses."""
    R = np.stack([pose.R for pose in standing])
    return np.stack([mean_rotation(R[:, s]).T @ upright for s in range(R.shape[1])])


def turns_to_bending(model: BodyModel, poses: Sequence[Pose], bending: Sequence[int]) -> FloatArray:
    """Return (S, 3, 3) constant turns of the parents of segments that bend in one plane, about y, their
    length: after them the plane is that of x and y, and bends forward.

    A frame counts by how far the joint is bent; a joint that never is by more than ``_STRAIGHT`` leaves its
    parent as it is.
    """
    turns = np.tile(np.eye(3), (len(model.parents), 1, 1))
    R = np.stack([pose.R for pose in poses])
    for s in bending:
        parent = int(model.parents[s])
        end = -R[:, s, :, 1]  # where the segment leads to, from its joint
        ahead = np.einsum("kij,ki->kj", R[:, parent], end)[:, [0, 2]]
        bent = np.linalg.norm(ahead, axis=1)
        if bent.max() < np.sin(_STRAIGHT):
            continue
        x, z = (bent[:, None] * ahead).sum(axis=0) / (bent**2).sum()
        angle = np.arctan2(-z, x)
        turns[parent] = [
            [np.cos(angle), 0.0, np.sin(angle)],
            [0.0, 1.0, 0.0],
            [-np.sin(angle), 0.0, np.cos(angle)],
        ]
    return turns


def turned(done: Adjusted, tips: FloatArray, turns: FloatArray) -> tuple[Adjusted, FloatArray]:
    """Return the same body and poses with axes turned by C: what lies on a segment turns back. tips: (S, 3)
    m."""
    model = done.model
    parents = np.maximum(model.parents, 0)
    offsets = np.einsum("sji,sj->si", turns[parents], model.offsets)
    positions = np.einsum("mji,mj->mi", turns[model.segments], model.positions)
    poses = [pose._replace(R=pose.R @ turns) for pose in done.poses]
    model = model._replace(offsets=offsets, positions=positions)
    return replace(done, model=model, poses=poses), np.einsum("sji,sj->si", turns, tips)
