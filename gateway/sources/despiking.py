"""Single wild values taken out of raw samples, as a module's firmware would before it fuses them.

The middle of three successive samples is a spike where it lies further from their median than any motion
goes in one sampling interval and back in the next. It becomes the median. That costs one sample of delay.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.frames import INERTIAL_SAMPLE, FloatArray, IntArray
from gateway.geometry.compiled import compiled


@dataclass(frozen=True)
class SpikeLimits:
    """How far the middle one of three samples may stand out, on any axis."""

    specific_force: float = 60.0
    """m/s²"""
    angular_rate: float = 12.0
    """rad/s"""
    magnetic_field: float = 40.0
    """µT"""


_WATCHED = np.dtype([("n_seen", np.int64), ("spikes", np.int64)])
"""Of one module: samples so far, at most two, and values replaced since the last report of that."""


class Despiker:
    """Samples in, samples out, one later; each module by itself."""

    def __init__(self, limits: SpikeLimits | None = None) -> None:
        self.spikes: Counter[int] = Counter()
        """Values of a sensor that were replaced, by module."""
        chosen = limits or SpikeLimits()
        self._limits = np.array([chosen.specific_force, chosen.angular_rate, chosen.magnetic_field], float)
        self._rows: dict[int, int] = {}  # of modules that have been heard
        self._watched = np.zeros(0, _WATCHED)
        self._last = np.zeros((0, 2), INERTIAL_SAMPLE)  # the two newest of each, the newest last
        self.add(np.zeros(0, INERTIAL_SAMPLE))  # compile now, not when the first sample waits

    def add(self, samples: NDArray[np.void]) -> NDArray[np.void]:
        """Return the sample of each module before each of these (n,) ``INERTIAL_SAMPLE``, clean; none for a
        module's first.

        Only three samples in a row are compared: around lost ones everything passes as it is.
        """
        rows = np.array([self._row_of(module) for module in samples["module"].tolist()], np.int64)
        clean = samples.copy()
        n_clean, found = _despike(clean, rows, self._watched, self._last, self._limits)
        if found:
            self._count_spikes()
        return clean[:n_clean]

    @property
    def held_back(self) -> int:
        """Samples taken in and not given out yet: the newest of each module."""
        return len(self._rows)

    def summary(self) -> dict[str, int]:
        """Return the number of spikes by module, for the health message."""
        return {str(module): count for module, count in sorted(self.spikes.items()) if count}

    def _row_of(self, module: int) -> int:
        """Return the row of a module, with room for it."""
        row = self._rows.setdefault(module, len(self._rows))
        if row == len(self._watched):
            self._watched = np.concatenate((self._watched, np.zeros(row + 1, _WATCHED)))
            self._last = np.concatenate((self._last, np.zeros((row + 1, 2), INERTIAL_SAMPLE)))
        return row

    def _count_spikes(self) -> None:
        """Add to ``spikes`` what the kernel has counted since."""
        for module, row in self._rows.items():
            if self._watched["spikes"][row]:
                self.spikes[module] += int(self._watched["spikes"][row])
        self._watched["spikes"] = 0


@compiled
def _despike(
    samples: NDArray[np.void],
    rows: IntArray,
    watched: NDArray[np.void],
    last: NDArray[np.void],
    limits: FloatArray,
) -> tuple[int, int]:
    """Replace samples (n,), of modules in ``rows`` (n,), by those before them, clean.

    last: (m, 2) samples of each module; limits: (3,) by sensor. Returns how many they are now, and how many
    values were replaced.
    """
    n_clean, found = 0, 0
    for index in range(len(samples)):
        row = rows[index]
        before, middle, n_seen = last[row, 0], last[row, 1], watched[row].n_seen
        is_next = middle.sequence == samples[index].sequence - 1 and before.sequence + 1 == middle.sequence
        if n_seen == 2 and is_next:
            for sensor in range(3):
                if _clean(
                    before.measured[sensor], middle.measured[sensor], samples[index].measured[sensor],
                    limits[sensor],
                ):  # fmt: skip
                    watched[row].spikes += 1
                    found += 1
        last[row, 0] = last[row, 1]
        last[row, 1] = samples[index]
        if n_seen > 0:
            samples[n_clean] = last[row, 0]  # never beyond the one just read
            n_clean += 1
        watched[row].n_seen = min(n_seen + 1, 2)
    return n_clean, found


@compiled
def _clean(before: FloatArray, middle: FloatArray, after: FloatArray, limit: float) -> bool:
    """Replace the middle one of three values (3,) by their median where it stands out; returns whether."""
    stands_out = False
    for i in range(3):
        median = _median(before[i], middle[i], after[i])
        if np.isnan(median):
            return False
        stands_out |= abs(middle[i] - median) > limit
    if stands_out:
        for i in range(3):
            middle[i] = _median(before[i], middle[i], after[i])
    return stands_out


@compiled
def _median(a: float, b: float, c: float) -> float:
    """Return the middle one; NaN if any is."""
    if np.isnan(a) or np.isnan(b) or np.isnan(c):
        return np.nan
    return max(min(a, b), min(max(a, b), c))
