"""The 40 degrees of freedom of the body seen by cameras, as columns of small turns. Compiled.

Step 3 of JP2020-042476A asks for 40; these are they, on the 23-segment human:

- 6 of the pelvis in the world;
- 3 of the spine, shared evenly by its four segments, and 3 of neck and head together;
- on each side 2 of the shoulder girdle, 3 of the shoulder, 2 of the elbow (flexion, pronation), 1 of the
  wrist (flexion), 3 of the hip, 1 of the knee and 2 of the ankle.

Joints with three degrees are balls: turns are taken in the axes of the moving segment, so that no posture is
singular. Those with one or two keep their Cardan angles, the others of which stay zero. Toes follow the foot.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.skeleton import Skeleton
from gateway.errors import SettingsError
from gateway.frames import FloatArray, IntArray
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled
from gateway.reconstruction.optical.kernels import cardan

_BALLS = (
    ("l5", "l3", "t12", "thorax"), ("neck", "head"), ("left_upper_arm",), ("right_upper_arm",),
    ("left_thigh",), ("right_thigh",),
)  # fmt: skip
_HINGED = {
    "shoulder_girdle": ("protraction", "elevation"),
    "forearm": ("flexion", "pronation"),
    "hand": ("flexion",),
    "shank": ("flexion",),
    "foot": ("dorsiflexion", "inversion"),
    "toes": (),
}
"""Segment of either side to the angles of its joint that are free."""
DEGREES = 40


class Freedom(NamedTuple):
    """What may turn, as kernels take it."""

    segments: IntArray  # (n_turns,) segment that turns
    columns: IntArray  # (n_turns,) degree of freedom, from 3 on
    axes: FloatArray  # (n_turns, 3) in the segment's own axes, or its parent's
    in_parent: IntArray  # (n_turns,) 1: the axis is the parent's
    shares: FloatArray  # (n_turns,) of the degree of freedom
    first: IntArray  # (n_segments,) of the ball that a segment shares; -1 where it has none
    hinges: IntArray  # (n_segments, 3) axes of the Cardan angles; -1 where it has no such joint
    low: FloatArray  # (n_segments, 3) rad, right-handed: limits of those angles, zero where they are not free
    high: FloatArray  # (n_segments, 3) rad


def freedom_of(skeleton: Skeleton) -> Freedom:
    """Return the degrees of freedom of a body with the segments of ``human_23``. Raises ``SettingsError`` if
    it lacks one."""
    wanted = {name for group in _BALLS for name in group}
    wanted |= {f"{side}_{part}" for side in ("left", "right") for part in _HINGED} | {"pelvis"}
    if missing := sorted(wanted - set(skeleton.segment_names)):
        raise SettingsError(
            f"body '{skeleton.name}' has no segment {', '.join(missing)}: cameras need those of human_23"
        )
    n = skeleton.n_segments
    turns: list[tuple[int, int, FloatArray, int, float]] = []
    first, hinges = np.full(n, -1), np.full((n, 3), -1)
    limits = np.zeros((n, 3, 2))
    turns += [(0, 3 + i, axis, 0, 1.0) for i, axis in enumerate(np.eye(3))]
    column = 6
    for group in _BALLS:
        for name in group:
            first[skeleton.index(name)] = skeleton.index(group[0])
            turns += [
                (skeleton.index(name), column + i, axis, 0, 1.0 / len(group))
                for i, axis in enumerate(np.eye(3))
            ]
        column += 3
    for side in ("left", "right"):
        for part, free in _HINGED.items():
            segment = skeleton.index(f"{side}_{part}")
            joint = next(joint for joint in skeleton.joints if joint.distal == segment)
            for k, angle in enumerate(joint.angles):
                hinges[segment, k] = angle.axis_index
                if angle.name not in free:
                    continue
                limits[segment, k] = sorted(angle.sign * limit for limit in angle.limits)
                is_first_of_two = len(free) == 2 and angle.name == free[0]
                axis = np.eye(3)[angle.axis_index]
                turns.append((segment, column, axis, int(is_first_of_two), 1.0))
                column += 1
    assert column == DEGREES
    segments, columns, axes, in_parent, shares = zip(*turns, strict=True)
    return Freedom(
        np.array(segments), np.array(columns), np.array(axes), np.array(in_parent), np.array(shares),
        first, hinges, np.ascontiguousarray(limits[:, :, 0]), np.ascontiguousarray(limits[:, :, 1]),
    )  # fmt: skip


@compiled
def turn_matrix(freedom: Freedom, parents: IntArray, R: FloatArray) -> FloatArray:
    """Return T (3 + 3 S, 40): small changes of the degrees of freedom to those that ``optical.kernels``
    knows, a shift of the root and a turn of every segment in world axes."""
    T = np.zeros((3 + 3 * len(parents), DEGREES))
    for i in range(3):
        T[i, i] = 1.0
    for row in range(len(freedom.segments)):
        s = freedom.segments[row]
        carrier = parents[s] if freedom.in_parent[row] == 1 else s
        axis = rm.rotate(R[carrier], freedom.axes[row])
        for i in range(3):
            T[3 + 3 * s + i, freedom.columns[row]] += freedom.shares[row] * axis[i]
    return T


@compiled
def kept_free(freedom: Freedom, parents: IntArray, R: FloatArray) -> FloatArray:
    """Return the pose (S, 3, 3) nearest by that has the 40 degrees of freedom alone: hinges inside their
    limits, shared bends equal, what has no freedom in line with its parent."""
    kept = R.copy()
    for s in range(1, len(parents)):
        p = parents[s]
        if freedom.first[s] >= 0:
            f = freedom.first[s]
            local = rm.multiply(R[parents[f]].T.copy(), R[f])
        else:
            angles, _, _ = cardan(R[p], R[s], freedom.hinges[s])
            local = np.eye(3)
            for k in range(3):
                turn = np.zeros(3)
                turn[freedom.hinges[s, k]] = min(max(angles[k], freedom.low[s, k]), freedom.high[s, k])
                local = rm.multiply(local, rm.from_rotation_vector(turn))
        kept[s] = rm.multiply(kept[p], local)
    return kept
