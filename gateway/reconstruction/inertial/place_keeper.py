"""Where the body is while the device that measures it is silent, and when it speaks again.

Meanwhile the last place stands. What the device then says is further off the longer it was silent: the body
does not jump there but goes, e-fold within ``RETURN_S``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gateway.frames import FloatArray

RETURN_S = 0.5


class PlaceKeeper:
    """NaN until the first measurement."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all places."""
        self._place = np.full(3, np.nan)
        self._offset = np.zeros(3)
        self._is_lost = False
        self._time_ns = -1

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Return all that is remembered, as arrays."""
        return {
            "kept_place.place": self._place.copy(),
            "kept_place.offset": self._offset.copy(),
            "kept_place.is_lost": np.array([self._is_lost]),
            "kept_place.time_ns": np.array([self._time_ns], np.int64),
        }

    def set_state(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Go on from what ``state`` has returned."""
        self._place = np.array(state["kept_place.place"], np.float64)
        self._offset = np.array(state["kept_place.offset"], np.float64)
        self._is_lost = bool(state["kept_place.is_lost"][0])
        self._time_ns = int(state["kept_place.time_ns"][0])

    def at(self, measured: FloatArray, time_ns: int) -> FloatArray:
        """(3,) m, of an instant not before the last one; measured: NaN while the device is silent."""
        dt = (time_ns - self._time_ns) * 1e-9 if self._time_ns >= 0 else 0.0
        self._time_ns = time_ns
        if not np.isfinite(measured).all():
            self._is_lost = True
            return self._place
        self._offset *= math.exp(-dt / RETURN_S)
        if self._is_lost and np.isfinite(self._place).all():
            self._offset = self._place - measured
        self._is_lost = False
        self._place = measured + self._offset
        return self._place
