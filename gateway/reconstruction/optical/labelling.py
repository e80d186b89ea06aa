"""Which marker is which: swapped names put right, nameless points given one, ghosts left alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray

LOST = 0.04
"""A marker farther than this from its virtual one, and than six of its σ, is not where its name says, m."""
CLAIM = 0.025
"""A point nearer than this to a virtual marker may be it, m."""


class Labelled(NamedTuple):
    """Markers after their names have been questioned."""

    positions: FloatArray  # (M, 3) m; NaN where no point may be the marker
    renamed: tuple[tuple[int, int], ...]
    """(marker, whose point it had been given; -1 for a nameless one)."""
    rejected: tuple[int, ...]
    """Markers whose point is nobody's: ghosts, or displaced."""


def relabelled(
    observed: FloatArray, virtual: FloatArray, sigmas: FloatArray, unlabelled: FloatArray
) -> Labelled | None:
    """Return markers and nameless points given to the virtual markers they lie at; None when nothing is in
    doubt.

    observed: (M, 3) m, NaN rows for markers not seen; virtual: (M, 3) m; sigmas: (M,) m; unlabelled: (U, 3).
    Points are taken from markers that lie off and given away in order of distance, the nearest pair first.
    """
    distance = np.linalg.norm(observed - virtual, axis=1)
    seen = np.isfinite(distance)
    off = seen & (distance > np.maximum(LOST, 6.0 * sigmas))
    nameless = unlabelled[np.isfinite(unlabelled).all(axis=1)]
    if not off.any() and (seen.all() or not len(nameless)):
        return None
    wanting = np.flatnonzero(off | ~seen)
    sources = [*np.flatnonzero(off).tolist(), *([-1] * len(nameless))]
    points = np.vstack([observed[off], nameless])
    positions = observed.copy()
    positions[off] = np.nan
    renamed = []
    for marker, point in _nearest_pairs(virtual[wanting], points):
        positions[wanting[marker]] = points[point]
        if sources[point] != wanting[marker]:
            renamed.append((int(wanting[marker]), sources[point]))
    rejected = tuple(m for m in np.flatnonzero(off).tolist() if np.isnan(positions[m, 0]))
    return Labelled(positions, tuple(renamed), rejected)


def _nearest_pairs(virtual: FloatArray, points: FloatArray) -> list[tuple[int, int]]:
    """Return (virtual, point) pairs nearer than ``CLAIM``, each used once, the nearest first."""
    if not len(points) or not len(virtual):
        return []
    distance = np.linalg.norm(virtual[:, None] - points[None], axis=2)
    pairs: list[tuple[int, int]] = []
    for flat in np.argsort(distance, axis=None):
        marker, point = divmod(int(flat), len(points))
        if distance[marker, point] > CLAIM:
            break
        if all(marker != m and point != p for m, p in pairs):
            pairs.append((marker, point))
    return pairs
