"""Smoothing of step 6 of JP2020-042476A: an order-6 recursive low-pass over positions, three frames late.

A Butterworth low-pass of order N delays slow motion by c / ω seconds, with ω its corner and c the sum of the
sines of its poles' angles, 3.864 at order 6. The corner is laid so that this is three frames, and the result
is dated three frames earlier. The first frame stands three times in front: the filter begins at rest in it.
"""

from __future__ import annotations

import numpy as np

from devices.deferred import butter, sosfilt, sosfilt_zi
from gateway.frames import FloatArray

ORDER = 6
DELAY = 3
"""Frames from a position to its smoothed one."""
_DELAY_OF_UNIT_CORNER = float(np.sum(np.sin((2 * np.arange(1, ORDER + 1) - 1) * np.pi / (2 * ORDER))))
CORNER = float(np.arctan(_DELAY_OF_UNIT_CORNER / (2 * DELAY)) / np.pi)
"""Of the frame rate: the corner at which the filter, discretised by the bilinear transform, is so late."""


class LowPass:
    """The filter over any number of coordinates at once."""

    def __init__(self) -> None:
        self._sections: FloatArray = butter(ORDER, CORNER, fs=1.0, output="sos")
        self._states: FloatArray | None = None

    def reset(self) -> None:
        """Take the next value for the first."""
        self._states = None

    def add(self, values: FloatArray) -> FloatArray:
        """Return the smoothed values (any shape), which belong to ``DELAY`` values before."""
        flat = values.reshape(1, -1)
        if self._states is None:
            self._states = sosfilt_zi(self._sections)[:, :, None] * flat
        smoothed, self._states = sosfilt(self._sections, flat, axis=0, zi=self._states)
        return np.asarray(smoothed, dtype=np.float64).reshape(values.shape)
