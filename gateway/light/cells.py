"""From the readings of several photoelectric cells to the direction of the light. Sans-I/O.

A cell of normal n reads ``max(0, n · v) + a``: v points to the sun and is as long as its direct light is
strong, a is the diffuse light around. Which cells are lit depends on v, so the least squares over them is
repeated until the set stands. An unlit cell says that its side has no part of v.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray

_MOST_ROUNDS = 6


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
        """normals: (k, 3) sensor axes. Raises ``ValueError`` unless they span space."""
        lengths = np.linalg.norm(normals, axis=1)
        if np.linalg.matrix_rank(normals) < 3 or not (lengths > 0.0).all():
            raise ValueError("normals of photoelectric cells must span all three directions")
        self._normals: FloatArray = normals / lengths[:, None]
        self._inverses: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def solve(self, readings: FloatArray) -> CellSolution:
        """readings: (k,) share of full scale."""
        is_lit = np.ones(len(readings), bool)  # of opposite cells the difference is right at once
        for _ in range(_MOST_ROUNDS):
            design, inverse = self._fit(is_lit)
            found = inverse @ readings
            now_lit = self._normals @ found[:3] > 0.0
            if (now_lit == is_lit).all():
                break
            is_lit = now_lit
        residual = float(np.sqrt(np.mean((readings - design @ found) ** 2)))
        direct = float(np.linalg.norm(found[:3]))
        direction = found[:3] / direct if direct > 0.0 else np.full(3, np.nan)
        return CellSolution(direction, direct, float(found[3]), residual)

    def _fit(self, is_lit: np.ndarray) -> tuple[FloatArray, FloatArray]:
        """Rows of the model and their pseudo-inverse: the side without lit cells gets no part of v."""
        key = is_lit.tobytes()
        if key not in self._inverses:
            design = np.hstack([self._normals * is_lit[:, None], np.ones((len(is_lit), 1))])
            self._inverses[key] = design, np.linalg.pinv(design)
        return self._inverses[key]
