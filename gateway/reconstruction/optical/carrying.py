"""How joints go on turning while no marker shows it: at the rate they had, less and less of it."""

from __future__ import annotations

import numpy as np

from gateway.frames import FloatArray, IntArray
from gateway.geometry import rotation_matrix as rm
from gateway.geometry.compiled import compiled

LEARNT_S = 0.1
"""Time constant in which a joint's rate is learnt, s: a shorter one takes the markers' noise for motion."""
FORGOTTEN_S = 0.2
"""Time constant in which a joint comes to rest that no marker shows, s: nobody turns on and on."""
_LONGEST_STEP_S = 0.06


class Carrying:
    """Where every joint would be at the next instant, from the poses so far. Deterministic.

    Directions that markers show follow the markers; those that they do not follow what is given here, and so
    keep their own rate until it is forgotten.
    """

    def __init__(self, parents: IntArray) -> None:
        self._parents = parents
        self._rates = np.zeros((len(parents), 3))  # rad/s, of every joint, axes of its distal segment
        self._time_ns = 0
        self._R: FloatArray | None = None

    def reset(self) -> None:
        """Forget all poses."""
        self._R = None
        self._rates[:] = 0.0

    def add(self, time_ns: int, R: FloatArray) -> None:
        """Add the pose R (S, 3, 3), segment to world, of an instant."""
        step = 1e-9 * (time_ns - self._time_ns)
        if self._R is None or not 0.0 < step < _LONGEST_STEP_S:
            self._rates[:] = 0.0
        else:
            share = 1.0 - np.exp(-step / LEARNT_S)
            self._rates += share * (_rates(self._parents, self._R, R, step) - self._rates)
            self._rates *= np.exp(-step / FORGOTTEN_S)
        self._time_ns, self._R = time_ns, R

    def ahead(self, time_ns: int) -> FloatArray:
        """Return (S, 3, 3) with all joints turned on to an instant, the root as it is. Wants a pose
        before."""
        assert self._R is not None
        step = 1e-9 * (time_ns - self._time_ns)
        return _turned_on(
            self._parents, self._R, self._rates * (step if 0.0 < step < _LONGEST_STEP_S else 0.0)
        )


@compiled
def _rates(parents: IntArray, before: FloatArray, now: FloatArray, step: float) -> FloatArray:
    """Return (S, 3) rad/s, from two poses (S, 3, 3); the root's is that in the world."""
    rates = np.empty((len(parents), 3))
    for s in range(len(parents)):
        p = parents[s]
        if p < 0:
            rates[s] = rm.increment(before[s], now[s]) / step
        else:
            there = rm.multiply(now[p], rm.multiply(before[p].T.copy(), before[s]))
            rates[s] = rm.increment(there, now[s]) / step
    return rates


@compiled
def _turned_on(parents: IntArray, R: FloatArray, turns: FloatArray) -> FloatArray:
    ahead = np.empty_like(R)
    for s in range(len(parents)):
        p = parents[s]
        if p < 0:
            ahead[s] = R[s]
        else:
            joint = rm.multiply(R[p].T.copy(), R[s])
            ahead[s] = rm.multiply(ahead[p], rm.multiply(joint, rm.from_rotation_vector(turns[s])))
    return ahead
