"""From the readings of several photoelectric cells to the direction of the light. Sans-I/O.

A cell of normal n reads ``max(0, n · v) + a``: v points to the sun and is as long as its direct light is
strong, a is the diffuse light around. Lit cells read more than unlit ones, so the lit are the brightest,
however many they are: least squares for each number, and the one that explains all cells best is right. An
unlit cell says what a is, and that its side has no part of v.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.frames import FloatArray


class CellSolution(NamedTuple):
    """What one reading of all cells shows."""

    direction: FloatArray  # (3,) unit, to the light, sensor axes; NaN if there is no direct light
    direct: float
    """Direct light, share of full scale."""
    diffuse: float
    """Diffuse light on every cell."""
    residual: float
    """Root of the mean square of what the cells read beside this, share of full scale."""


class CellArray:
    """The cells of one module."""

    def __init__(self, normals: FloatArray) -> None:
        """Prepare cells with normals (k, 3) in sensor axes. Raises ``ValueError`` unless they span space."""
        lengths = np.linalg.norm(normals, axis=1)
        if np.linalg.matrix_rank(normals) < 3 or not (lengths > 0.0).all():
            raise ValueError("normals of photoelectric cells must span all three directions")
        self._normals: FloatArray = normals / lengths[:, None]
        self._inverses: dict[bytes, FloatArray] = {}

    def solve(self, readings: FloatArray) -> CellSolution:
        """Return the direction of the light in sensor axes, from readings (k,) as a share of full scale.

        A cell that faces away sees diffuse light only, which a linear fit must not use. Cells are left out
        one by one, darkest first; the fit with the least mean square error over all cells wins.
        """
        order, least, found = np.argsort(readings), np.inf, np.zeros(4)
        is_lit = np.ones(len(readings), bool)
        for darkest in order:
            candidate = self._inverse(is_lit) @ readings
            explained = np.maximum(self._normals @ candidate[:3], 0.0) + candidate[3]
            square = float(np.mean((readings - explained) ** 2))
            if square < least:
                least, found = square, candidate
            is_lit[darkest] = False
        residual = float(np.sqrt(least))
        direct = float(np.linalg.norm(found[:3]))
        direction = found[:3] / direct if direct > 0.0 else np.full(3, np.nan)
        return CellSolution(direction, direct, float(found[3]), residual)

    def _inverse(self, is_lit: NDArray[np.bool_]) -> FloatArray:
        """Return (4, k) readings to v and a: the pseudo-inverse, so a side without lit cells gets no part of
        v."""
        key = is_lit.tobytes()
        if key not in self._inverses:
            design = np.hstack([self._normals * is_lit[:, None], np.ones((len(is_lit), 1))])
            self._inverses[key] = np.linalg.pinv(design)
        return self._inverses[key]
