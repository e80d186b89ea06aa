"""Whether the body on the page does what its wearer does: five movements, and which segments follow them.

A segment follows when its long axis points where the movement brings it. It says nothing about how exact a
pose is; it finds modules that are worn the wrong way round, exchanged, silent, or not assigned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from gateway.contract.messages import Quaternion
from gateway.frames import FloatArray
from gateway.geometry import quaternion

FORWARD = np.array([1.0, 0.0, 0.0])
_DISTAL, _UP = np.array([0.0, -1.0, 0.0]), np.array([0.0, 1.0, 0.0])
"""Of a segment with ISB axes: y superior."""
_FAR_ENOUGH = 0.4
"""Component of the long axis along the movement: it is turned by 24° or more."""
_SEEN = 0.5
"""Share of the poses in which a segment must be known."""


class MovementVerdict(StrEnum):
    """How a segment did."""

    FOLLOWS = "follows"
    STILL = "still"
    """It did not turn that way."""
    OPPOSITE = "opposite"
    """It turned the other way: its module is worn the wrong way round."""
    UNKNOWN = "unknown"
    """Nothing is heard of it."""
    DOUBTFUL = "doubtful"
    """The gateway found something against how its module is worn."""


@dataclass(frozen=True)
class Movement:
    """One thing to do."""

    name: str
    segments: tuple[str, ...]
    axis: FloatArray
    """(3,) of each segment, segment axes: what the movement brings forward."""


def _limb(side: str, *parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for part in parts)


MOVEMENTS: tuple[Movement, ...] = (
    Movement("left_arm", _limb("left", "upper_arm", "forearm", "hand"), _DISTAL),
    Movement("right_arm", _limb("right", "upper_arm", "forearm", "hand"), _DISTAL),
    Movement("left_leg", _limb("left", "thigh", "shank", "foot"), _DISTAL),
    Movement("right_leg", _limb("right", "thigh", "shank", "foot"), _DISTAL),
    Movement("bow", ("thorax", "head"), _UP),
)
"""The stretched limb forward; the trunk bent forward."""


class SegmentMovement(NamedTuple):
    """How one segment did in a movement."""

    segment: str
    verdict: MovementVerdict
    most: float
    """Largest component of its axis forward, -1 to 1; 0 where nothing is known."""


class MovementCheck:
    """Watches one movement of a body. Sans-I/O."""

    def __init__(self, movement: Movement, segments: Sequence[str]) -> None:
        """Judge a movement by ``segments``, those with modules; others are not judged."""
        self.movement = movement
        self._forward: dict[str, list[float]] = {name: [] for name in movement.segments if name in segments}
        self._doubtful: set[str] = set()
        self._poses = 0

    def add(self, q_wb: Mapping[str, Quaternion | None], status: Mapping[str, str], root: FloatArray) -> None:
        """Add a pose; ``root`` (4,) is the root segment's orientation, whose heading says what is forward."""
        ahead = quaternion.rotate(root, FORWARD)
        ahead = ahead * np.array([1.0, 1.0, 0.0])
        length = float(np.linalg.norm(ahead))
        if length < 0.2:  # it lies on its back or front
            return
        self._poses += 1
        for name, seen in self._forward.items():
            known = q_wb.get(name)
            if known is None or status.get(name) in {"missing", "predicted", None}:
                continue
            if status[name] == "doubtful":
                self._doubtful.add(name)
            axis = quaternion.rotate(np.array(known, np.float64), self.movement.axis)
            seen.append(float(axis @ ahead) / length)

    def seen(self) -> list[SegmentMovement]:
        """Return how every segment of the movement did, so far."""
        return [self._judged(name, forward) for name, forward in self._forward.items()]

    def _judged(self, name: str, forward: list[float]) -> SegmentMovement:
        if not forward or len(forward) < _SEEN * self._poses:
            return SegmentMovement(name, MovementVerdict.UNKNOWN, 0.0)
        most, least = max(forward), min(forward)
        if most >= _FAR_ENOUGH and most >= -least:
            return SegmentMovement(
                name, MovementVerdict.DOUBTFUL if name in self._doubtful else MovementVerdict.FOLLOWS, most
            )
        verdict = MovementVerdict.OPPOSITE if least <= -_FAR_ENOUGH else MovementVerdict.STILL
        return SegmentMovement(name, verdict, most)
