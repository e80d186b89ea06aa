"""What a body looks like: every segment a bone from its joint to its tip, and to the joints it carries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion

_SIDES = 6
_AROUND = 2 * np.pi * np.arange(_SIDES) / _SIDES
_THICKEST_AT = 0.22
BONE_VERTICES: FloatArray = np.vstack(
    [
        [0.0, 0.0, 0.0],
        np.column_stack([np.full(_SIDES, _THICKEST_AT), np.cos(_AROUND), np.sin(_AROUND)]),
        [1.0, 0.0, 0.0],
    ]
)
"""A double pyramid along x with a hexagon between: length 1, half width 1 at about a fifth of it."""
BONE_FACES: IntArray = np.array(
    [
        face
        for k in range(_SIDES)
        for a, b in [(1 + k, 1 + (k + 1) % _SIDES)]
        for face in ((0, b, a), (_SIDES + 1, a, b))
    ],
    dtype=np.int64,
)
SHORTEST_BONE_M = 0.01
APART_M = 0.02
"""A carried joint nearer to the tip than that gets no bone of its own."""
WIDTH_OF_LENGTH = 0.17
THINNEST_M, THICKEST_M = 0.018, 0.07


@dataclass(frozen=True)
class Bones:
    """Constant for a body; ``n`` bones of its segments."""

    segment: IntArray  # (n,) the segment that carries it
    q_segment_from_bone: FloatArray  # (n, 4) takes the bone's x axis to its direction in the segment
    scale: FloatArray  # (n, 3) length and half widths, m

    def turned(self, q_wb: FloatArray) -> FloatArray:
        """Return how the bones stand, (n, 4), in a posture q_wb (s, 4)."""
        pairs = zip(q_wb[self.segment], self.q_segment_from_bone, strict=True)
        return np.array([quaternion.multiply(q_segment, q_bone) for q_segment, q_bone in pairs])


def bones_of(skeleton: Skeleton) -> Bones:
    """Return the bones of a skeleton: at least one a segment, be it a point."""
    segments: list[int] = []
    ends: list[NDArray[np.float64]] = []
    for s in range(skeleton.n_segments):
        children = skeleton.offsets[skeleton.parents == s]
        own = [skeleton.tips[s]] if _length(skeleton.tips[s]) >= SHORTEST_BONE_M else []
        # A child's joint near the tip would draw a second bone inside the first.
        own += [
            joint
            for joint in children
            if _length(joint) >= SHORTEST_BONE_M and _length(joint - skeleton.tips[s]) > APART_M
        ]
        # A segment of length zero still needs something to be seen and clicked.
        own = own or [np.array([SHORTEST_BONE_M, 0.0, 0.0])]
        segments += [s] * len(own)
        ends += own

    vectors = np.array(ends)
    lengths = np.linalg.norm(vectors, axis=1)
    widths = np.clip(WIDTH_OF_LENGTH * lengths, THINNEST_M, THICKEST_M)
    return Bones(
        segment=np.array(segments, np.int64),
        q_segment_from_bone=np.array([_from_x_axis(v) for v in vectors / lengths[:, None]]),
        scale=np.column_stack([lengths, widths, widths]),
    )


def _length(v: FloatArray) -> float:
    return float(np.linalg.norm(v))


def _from_x_axis(direction: FloatArray) -> FloatArray:
    """Return the shortest rotation that takes x to a unit vector."""
    x, y, z = direction
    if x < -1.0 + 1e-9:
        return np.array([0.0, 0.0, 0.0, 1.0])
    q = np.array([1.0 + x, 0.0, -z, y])
    unit: FloatArray = q / np.linalg.norm(q)
    return unit
