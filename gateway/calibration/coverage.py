"""Which directions of a sphere have been seen: readings of a turned sensor, sorted into equal cells."""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray, IntArray

CELLS = 60
"""Cells of the sphere; each is about 30° wide."""

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


def _spiral(n: int) -> FloatArray:
    """Return (n, 3) unit vectors spread evenly over the sphere (Fibonacci lattice; González 2010)."""
    k = np.arange(n)
    z = 1.0 - (2.0 * k + 1.0) / n
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(k * _GOLDEN_ANGLE), radius * np.sin(k * _GOLDEN_ANGLE), z], axis=1)


DIRECTIONS = _spiral(CELLS)
"""(CELLS, 3) the middles of the cells."""

SIDES = {
    "+x": (1, 0, 0),
    "-x": (-1, 0, 0),
    "+y": (0, 1, 0),
    "-y": (0, -1, 0),
    "+z": (0, 0, 1),
    "-z": (0, 0, -1),
}
"""Directions of the sensor's axes by name."""

_SIDE_WIDTH = math.cos(math.radians(40.0))


def cells_of(vectors: FloatArray) -> IntArray:
    """Return (n,) the cell that each of (n, 3) vectors points into."""
    cells: IntArray = np.argmax(vectors @ DIRECTIONS.T, axis=1)
    return cells


def coverage(vectors: FloatArray, centre: FloatArray | None = None) -> float:
    """Return share of the sphere's cells, 0 to 1, that vectors (n, 3) seen from a centre point into."""
    if len(vectors) == 0:
        return 0.0
    seen = vectors if centre is None else vectors - centre
    return len(np.unique(cells_of(seen))) / CELLS


def missing_sides(vectors: FloatArray, centre: FloatArray | None = None) -> list[str]:
    """Return axis directions such as ``-z`` within 40° of which there is none of the vectors (n, 3), seen
    from a centre (3,)."""
    if len(vectors) == 0:
        return list(SIDES)
    seen = vectors if centre is None else vectors - centre
    unit = seen / np.maximum(np.linalg.norm(seen, axis=1, keepdims=True), 1e-12)
    return [name for name, side in SIDES.items() if (unit @ np.array(side)).max() < _SIDE_WIDTH]


def evenly(vectors: FloatArray, centre: FloatArray, most: int) -> FloatArray:
    """Return at most ``most`` of the vectors (n, 3) from each cell about a centre (3,), spread over time, so
    that no rest dominates."""
    cells = cells_of(vectors - centre)
    kept = [_spread(np.flatnonzero(cells == cell), most) for cell in np.unique(cells)]
    return vectors[np.sort(np.concatenate(kept))] if kept else vectors


def _spread(rows: IntArray, most: int) -> IntArray:
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.int64)]
