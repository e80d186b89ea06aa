"""What a joint is: two segments, and the angles by which the distal one turns against the proximal one.

In the neutral posture all segments' axes are parallel and every angle is zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from gateway.frames import Vector3

WORLD = -1
"""In place of the proximal segment: the world, turned as the segments are in the neutral posture."""


class Decomposition(IntEnum):
    """How the rotation of a joint becomes angles."""

    CARDAN = 0
    """Three successive rotations about axes of the moving segment: x, y, z in any order (Cardan), or
    with the first axis again as the third (Euler)."""
    SWING_TWIST = 1
    """A twist about the long axis (third angle) after a swing across it, whose rotation vector has the first
    two angles as components. Singular only where the swing reaches 180°."""
    HINGE = 2
    """One angle about one axis of any direction."""


@dataclass(frozen=True)
class Angle:
    """One angle of a joint."""

    name: str
    """The movement in which it grows: ``flexion``."""
    axis: Vector3
    """Unit axis in segment axes, such that the angle grows with a right-handed turn about it. For CARDAN and
    SWING_TWIST one of ±x, ±y, ±z."""
    limits: tuple[float, float] = (float("-inf"), float("inf"))
    """What a healthy joint, or the machine, can do; rad."""

    @property
    def axis_index(self) -> int:
        """0, 1 or 2: the axis x, y or z that this one lies along most."""
        return max(range(3), key=lambda i: abs(self.axis[i]))

    @property
    def sign(self) -> int:
        """Of the axis along that direction: 1 or -1."""
        return 1 if self.axis[self.axis_index] >= 0 else -1


@dataclass(frozen=True)
class Joint:
    """A joint between two segments, neighbours or not (the thorax and an upper arm)."""

    name: str
    proximal: int
    """Index of the proximal segment, or ``WORLD``."""
    distal: int
    """Index of the distal segment."""
    decomposition: Decomposition
    angles: tuple[Angle, ...]
    """In the order of the rotations: one (HINGE) or three."""
    free: tuple[str, ...]
    """Names of the angles that the joint is modelled to have; the others stay small (a knee's adduction)."""
    source: str = ""
    """Where the definition comes from."""

    @property
    def kind(self) -> str:
        """``hinge``, ``universal`` or ``spherical``, by the number of free angles."""
        return ("fixed", "hinge", "universal", "spherical")[len(self.free)]

    @property
    def sequence(self) -> str:
        """The order of rotations: ``zxy``, ``yxy``, ``swing_twist`` or ``hinge``."""
        if self.decomposition is Decomposition.CARDAN:
            return "".join("xyz"[angle.axis_index] for angle in self.angles)
        return self.decomposition.name.lower()
