"""Into which world axes poses are exported."""

from __future__ import annotations

from enum import StrEnum


class Axes(StrEnum):
    """World axes of an export. Segment axes never change: x anterior, y superior, z to the right."""

    Z_UP = "z-up"
    """East, north, up: as published."""
    Y_UP = "y-up"
    """x east, y up, z south: BVH, glTF, OpenSim."""
