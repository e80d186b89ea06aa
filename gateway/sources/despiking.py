"""Single wild values taken out of raw samples, as a module's firmware would before it fuses them.

The middle of three successive samples is a spike where it lies further from their median than any motion
goes in one sampling interval and back in the next. It becomes the median. That costs one sample of delay.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.frames import INERTIAL_SAMPLE, FloatArray


@dataclass(frozen=True)
class SpikeLimits:
    """How far the middle one of three samples may stand out, on any axis."""

    specific_force: float = 60.0
    """m/s²"""
    angular_rate: float = 12.0
    """rad/s"""
    magnetic_field: float = 40.0
    """µT"""


class Despiker:
    """Samples in, samples out, one later; each module by itself."""

    def __init__(self, limits: SpikeLimits | None = None) -> None:
        self.spikes: Counter[int] = Counter()
        """Values of a sensor that were replaced, by module."""
        chosen = limits or SpikeLimits()
        self._limits = chosen.specific_force, chosen.angular_rate, chosen.magnetic_field
        self._last: dict[int, tuple[np.void | None, np.void]] = {}

    def add(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """Return the sample of each module before each of these (n,) ``INERTIAL_SAMPLE``, clean; none for a
        module's first.

        Only three samples in a row are compared: around lost ones everything passes as it is.
        """
        found = map(self._add, samples.copy())
        return np.array([sample for sample in found if sample is not None], INERTIAL_SAMPLE)

    @property
    def held_back(self) -> int:
        """Samples taken in and not given out yet: the newest of each module."""
        return len(self._last)

    def summary(self) -> dict[str, int]:
        """For the health message: spikes by module."""
        return {str(module): count for module, count in sorted(self.spikes.items()) if count}

    def _add(self, sample: np.void) -> np.void | None:
        module = int(sample["module"])
        before, middle = self._last.get(module, (None, None))
        self._last[module] = (middle, sample)
        if middle is None or before is None:
            return middle
        if before["sequence"] + 1 == middle["sequence"] == sample["sequence"] - 1:
            self._clean(before["measured"], middle, sample["measured"])
        return middle

    def _clean(self, before: FloatArray, middle: np.void, after: FloatArray) -> None:
        """Replace what stands out in the middle one of three, by sensor. before, after: (3, 3)."""
        measured = middle["measured"]
        for sensor, limit in enumerate(self._limits):
            three = np.stack((before[sensor], measured[sensor], after[sensor]))
            if np.isnan(three).any():
                continue
            median = np.sort(three, axis=0)[1]
            if (np.abs(measured[sensor] - median) > limit).any():
                measured[sensor] = median
                self.spikes[int(middle["module"])] += 1
