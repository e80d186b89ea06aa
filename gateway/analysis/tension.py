"""Sharing joint torques out among muscles: one bounded, weighted quadratic programme an instant.

Minimised is ``Σ w (a − b)² + Σ (s / s₀)²`` with ``0 ≤ a ≤ 1`` and, for every torque, ``Σ r F a + s = τ``: a
the activity (tension over the muscle's largest force F), b its bias, w its weight, r its moment arm, and s
the torque that the muscles leave to something else (ligaments, the model's faults). Solved by OSQP (Stellato
et al. 2020, Math. Program. Comput. 12: 637–672), begun from the instant before.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy

from gateway.errors import GatewayError
from gateway.frames import FloatArray

RESERVE_N_M = 1.0
"""s₀: a torque left over of this size costs as much as a muscle at its largest."""
TOLERANCE = 1e-4
_SOLVED = (1, 2)
"""OSQP's states: solved, and solved less exactly."""


class TensionSolver:
    """W muscles against R torques, instant by instant."""

    def __init__(self, peak_force: FloatArray, n_torques: int, weight: FloatArray) -> None:
        """Build the problem once. peak_force: (W,) N. weight: (W,) at least, of the squared activity."""
        self._peak, self._count = peak_force, n_torques
        self._solver: Any = None
        self._base_weight = weight

    def solve(
        self, arms: FloatArray, torques: FloatArray, bias: FloatArray, weight: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return activity (W,) from 0 to 1, and torque left over (R,) N m.

        arms: (R, W) N m for one newton in each muscle. torques: (R,) N m. bias: (W,) from 0 to 1.
        weight: (W,) of this instant; None: as told at first. Raises ``GatewayError`` without a solution.
        """
        weights = self._base_weight if weight is None else weight
        count, rows = len(self._peak), self._count
        linear = np.concatenate([-2.0 * weights * bias, np.zeros(rows)])
        square = np.concatenate([2.0 * weights, np.full(rows, 2.0)])
        low = np.concatenate([torques, np.zeros(count)])
        high = np.concatenate([torques, np.ones(count)])
        block = (arms * self._peak).T.ravel()  # column by column
        if self._solver is None:
            self._begin(square, linear, block, low, high)
        else:
            self._solver.update(Px=square, q=linear, Ax=self._values(block), l=low, u=high)
        found = self._solver.solve(raise_error=False)
        if found.info.status_val not in _SOLVED:
            raise GatewayError(
                f"the share of muscles was not found ({found.info.status}): are the torques numbers, "
                "and of a size that a person has?"
            )
        activity = np.clip(found.x[:count], 0.0, 1.0)
        return activity, torques - (arms * self._peak) @ activity

    def _begin(
        self, square: FloatArray, linear: FloatArray, block: FloatArray, low: FloatArray, high: FloatArray
    ) -> None:
        import osqp  # noqa: PLC0415 - an extra

        self._solver = osqp.OSQP()
        self._solver.setup(
            P=scipy.sparse.diags(square, format="csc"), q=linear, A=self._matrix(block), l=low, u=high,
            verbose=False, eps_abs=TOLERANCE, eps_rel=TOLERANCE, polishing=False, max_iter=10000,
            check_termination=10,
        )  # fmt: skip

    def _matrix(self, block: FloatArray) -> scipy.sparse.csc_matrix:
        """Return torques over activity and what is left; below it the bounds of activity."""
        count, rows = len(self._peak), self._count
        per_muscle = np.arange(rows + 1)
        indices = np.tile(per_muscle, (count, 1))
        indices[:, rows] = rows + np.arange(count)
        reserves = np.arange(rows)
        pointers = np.concatenate([np.arange(count + 1) * (rows + 1), count * (rows + 1) + 1 + reserves])
        return scipy.sparse.csc_matrix(
            (self._values(block), np.concatenate([indices.ravel(), reserves]), pointers),
            shape=(rows + count, count + rows),
        )

    def _values(self, block: FloatArray) -> FloatArray:
        count, rows = len(self._peak), self._count
        muscles = np.hstack([block.reshape(count, rows), np.ones((count, 1))])
        return np.concatenate([muscles.ravel(), np.full(rows, RESERVE_N_M)])
