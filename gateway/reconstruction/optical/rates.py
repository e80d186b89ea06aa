"""How fast segments turn and joints are accelerated, from the last few poses."""

from __future__ import annotations

from collections import deque

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled

WINDOW = 9
"""Poses that a parabola is laid through."""
_LONGEST_GAP_NS = 100_000_000


class Rates:
    """Angular rate and acceleration at the newest pose: a parabola by least squares through the last nine.

    Causal, without delay for motion that is a parabola; the noise of single poses is averaged.
    """

    def __init__(self) -> None:
        self._poses: deque[tuple[int, FloatArray, FloatArray]] = deque(maxlen=WINDOW)

    def reset(self) -> None:
        """Forget all poses."""
        self._poses.clear()

    def add(self, time_ns: int, R: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Add a pose R (S, 3, 3), p (S, 3) m; return its angular rates (S, 3) rad/s in segment axes, and
        accelerations (S, 3) m/s² in world axes. NaN until there are enough poses without a long gap."""
        if self._poses and not 0 < time_ns - self._poses[-1][0] < _LONGEST_GAP_NS:
            self._poses.clear()
        self._poses.append((time_ns, R, p))
        if len(self._poses) < WINDOW:
            unknown = np.full(p.shape, np.nan)
            return unknown, unknown.copy()
        times = np.array([time - time_ns for time, _, _ in self._poses]) * 1e-9
        fit = np.linalg.pinv(np.stack([np.ones_like(times), times, 0.5 * times**2], axis=1))
        turns = _turns(np.stack([R for _, R, _ in self._poses]))
        rate = np.einsum("k,ksi->si", fit[1], turns)
        acceleration = np.einsum("k,ksi->si", fit[2], np.stack([p for _, _, p in self._poses]))
        return rate, acceleration


@compiled
def _turns(R: FloatArray) -> FloatArray:
    """Return (K, S, 3): rotation vectors from the last of K orientations (K, S, 3, 3) to each, its
    axes, rad."""
    turns = np.empty(R.shape[:3])
    for k in range(len(R)):
        for s in range(R.shape[1]):
            turns[k, s] = rm.increment(R[-1, s], R[k, s])
    return turns
