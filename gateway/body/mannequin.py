"""A body as a mannequin: closed limbs with volume, a head that has a face, hands and feet.

Every part is the same rounded spindle, stretched along three axes, so that a page draws all of them at once.
Widths are in proportion to the segment's own length, as of a person of 1.75 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray

_AROUND, _ALONG = 16, 11
SIDES = ("trunk", "left", "right", "face")
"""What a part is coloured by."""


def _spindle() -> tuple[FloatArray, IntArray]:
    """Return vertices (n, 3) of a closed spindle along x from −1 to 1, thicker at −1, and faces (m, 3)."""
    angle = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    x = -np.cos(np.pi * np.arange(1, _ALONG) / _ALONG)
    radius = (1.0 - np.abs(x) ** 2.6) ** 0.5 * (1.0 - 0.14 * x)
    rings = [
        np.column_stack([np.full(_AROUND, at), wide * np.cos(angle), wide * np.sin(angle)])
        for at, wide in zip(x, radius, strict=True)
    ]

    vertices = np.vstack([[-1.0, 0.0, 0.0], *rings, [1.0, 0.0, 0.0]])
    last = len(vertices) - 1
    faces = []
    for k in range(_AROUND):
        after = (k + 1) % _AROUND
        faces.append((0, 1 + after, 1 + k))
        for ring in range(_ALONG - 2):
            a, b = 1 + ring * _AROUND + k, 1 + ring * _AROUND + after
            # Two triangles for each quadrilateral between neighbouring rings, seen from outside.
            faces += [(a, b, a + _AROUND), (b, b + _AROUND, a + _AROUND)]
        end = 1 + (_ALONG - 2) * _AROUND
        faces.append((last, end + k, end + after))
    return vertices, np.array(faces, np.int64)


SPINDLE_VERTICES, SPINDLE_FACES = _spindle()


@dataclass(frozen=True)
class Mannequin:
    """Constant for a body; ``n`` parts of its segments."""

    segment: IntArray
    """(n,) the segment that carries it."""
    q_segment_from_part: FloatArray
    """(n, 4) the part's x axis is its length, y and z its depth and width."""
    centre: FloatArray
    """(n, 3) in segment axes, m."""
    half: FloatArray
    """(n, 3) half length, half depth and half width, m."""
    side: tuple[str, ...]
    """(n,) of ``SIDES``."""
    soles: IntArray
    """(k,) the segments that stand on the floor: the feet."""


_LIMBS = {
    "upper_arm": (0.15, 0.15),
    "forearm": (0.15, 0.15),
    "thigh": (0.19, 0.19),
    "shank": (0.135, 0.125),
    "hand": (0.11, 0.22),
    "shoulder_girdle": (0.27, 0.24),
    "neck": (0.45, 0.45),
}
"""Half depth and half width, as parts of the length."""
_DOWN = np.array([0.5**0.5, 0.0, 0.0, -(0.5**0.5)])
"""Takes x, the spindle's, to −y, which hangs down; its y to x, forward."""
_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def mannequin_of(skeleton: Skeleton) -> Mannequin | None:
    """Return the mannequin of a person's skeleton; None for a body that is none, which is shown by its
    bones."""
    names = skeleton.segment_names
    if "pelvis" not in names or not any(name.endswith("_thigh") for name in names):
        return None
    parts: list[tuple[int, FloatArray, FloatArray, tuple[float, float, float], str]] = []
    for s, name in enumerate(names):
        side, _, part = name.partition("_")
        side, part = (side, part) if side in ("left", "right") else ("trunk", name)
        parts += [(s, *rest, side) for rest in _parts(part, skeleton, s)]
        if part == "head":
            # A face shows which way the person looks.
            high = float(np.linalg.norm(skeleton.tips[s]))
            parts.append(
                (s, _DOWN, high * np.array([0.31, 0.56, 0.0]), _times(high, (0.13, 0.14, 0.25)), "face")
            )

    segments, turns, centres, halves, sides = zip(*parts, strict=True)
    return Mannequin(
        segment=np.array(segments, np.int64),
        q_segment_from_part=np.array(turns),
        centre=np.array(centres),
        half=np.array(halves),
        side=sides,
        soles=np.array([s for s, name in enumerate(names) if name.endswith("_foot")], np.int64),
    )


def _parts(
    part: str, skeleton: Skeleton, s: int
) -> list[tuple[FloatArray, FloatArray, tuple[float, float, float]]]:
    """Return turn, centre and half sizes, m, of what a segment consists of."""
    tip = skeleton.tips[s]
    length = float(np.linalg.norm(tip))
    # A segment without length has no direction in which a part could lie.
    if length < 0.01:
        return []
    if part == "pelvis":
        wide = 1.05 * _half_width(skeleton, s)
        return [(_DOWN, np.array([-0.005, 0.2 * length, 0.0]), (1.45 * length, 0.115, wide))]
    if part in ("thorax", "lumbar"):
        wide = 0.92 * _half_width(skeleton, 0) if part == "thorax" else 0.85 * _half_width(skeleton, 0)
        return [(_DOWN, 0.47 * tip, (0.56 * length, 0.115, wide))]
    if part == "head":
        skull = (_DOWN, 0.55 * tip + [0.012, 0.0, 0.0], _times(length, (0.5, 0.4, 0.31)))
        neck = (_DOWN, np.array([0.0, 0.04 * length, 0.0]), _times(length, (0.3, 0.2, 0.2)))
        return [skull, neck]
    if part == "foot":
        heel, toe, down = -0.3 * tip[0], tip[0] + 0.01, tip[1]
        half = 0.5 * (toe - heel)
        return [(_LEVEL, np.array([heel + half, 0.6 * down, 0.0]), (half, -0.42 * down, 0.22 * tip[0]))]
    deep, wide = _LIMBS.get(part, (0.12, 0.12))
    turn = _along(tip / length)
    return [(turn, 0.5 * tip, (0.5 * length + 0.5 * min(deep, wide) * length, deep * length, wide * length))]


def _half_width(skeleton: Skeleton, root: int) -> float:
    """Return the distance from a hip to the middle, m."""
    hips = skeleton.offsets[skeleton.parents == root]
    return max(0.1, float(np.abs(hips[:, 2]).max(initial=0.0)))


def _times(size: float, of: tuple[float, float, float]) -> tuple[float, float, float]:
    return size * of[0], size * of[1], size * of[2]


def _along(direction: FloatArray) -> FloatArray:
    """Return the turn from the spindle to a direction in segment axes; what hangs down keeps its depth
    forward."""
    if direction[1] < -0.9:
        return _DOWN
    across = np.cross([1.0, 0.0, 0.0], direction)
    if np.linalg.norm(across) < 1e-9:
        return _LEVEL
    q = np.array([1.0 + direction[0], *across])
    unit: FloatArray = q / np.linalg.norm(q)
    return unit
