"""Forward kinematics: orientations to joint positions."""

from __future__ import annotations

import numpy as np

from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled


@compiled
def joint_positions(
    parents: IntArray, offsets: FloatArray, q_wb: FloatArray, root_position: FloatArray
) -> FloatArray:
    """Return where each segment's proximal joint is, in world coordinates, m; (n_segments, 3).

    parents: (n_segments,) index of the parent segment, -1 for the root; parents come first.
    offsets: (n_segments, 3) joint centre in the parent segment's axes, m.
    q_wb: (n_segments, 4) segment to world.
    root_position: (3,) where the root's joint is, m.
    NaN beyond a segment whose orientation is NaN.
    """
    p_w = np.empty((len(parents), 3))
    joint_positions_into(p_w, parents, offsets, q_wb, root_position)
    return p_w


@compiled
def joint_positions_into(
    p_w: FloatArray, parents: IntArray, offsets: FloatArray, q_wb: FloatArray, root_position: FloatArray
) -> None:
    """Write joint positions as ``joint_positions`` does into ``p_w`` (n, 3)."""
    for i in range(len(parents)):
        parent = parents[i]
        if parent < 0:
            for k in range(3):
                p_w[i, k] = root_position[k]
        else:
            quaternion.rotate_into(p_w[i], q_wb[parent], offsets[i])
            for k in range(3):
                p_w[i, k] += p_w[parent, k]


def lowest_point(skeleton: Skeleton, q_wb: FloatArray, p_w: FloatArray) -> float:
    """Return height of the lowest joint or tip of a pose, m; q_wb (s, 4), p_w (s, 3) without NaN."""
    tips = [p + quaternion.rotate(q, tip) for q, p, tip in zip(q_wb, p_w, skeleton.tips, strict=True)]
    return float(min(np.min(p_w[:, 2]), np.min(np.array(tips)[:, 2])))
