"""The sun as sensor X: photoelectric cells on the modules, and where the sun stands."""

from __future__ import annotations

from gateway.sources.light.cells import CellArray, CellSolution
from gateway.sources.light.sun_compass import Rejected, SunCompass, sun_direction

__all__ = ["CellArray", "CellSolution", "Rejected", "SunCompass", "sun_direction"]
