"""Single wild values taken out of raw samples, as a module's firmware would before it fuses them.

The middle of three successive samples is a spike where it lies further from their median than any motion
goes in one sampling interval and back in the next. It becomes the median. That costs one sample of delay.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

from gateway.frames import InertialReading, Vector3


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
    """Readings in, readings out, one later; each module by itself."""

    def __init__(self, limits: SpikeLimits | None = None) -> None:
        self.spikes: Counter[int] = Counter()
        """Values of a sensor that were replaced, by module."""
        self._limits = limits or SpikeLimits()
        self._last: dict[int, tuple[InertialReading | None, InertialReading]] = {}

    def add(self, reading: InertialReading) -> InertialReading | None:
        """The reading before this one, clean; None for the first.

        Only three samples in a row are compared: around lost ones everything passes as it is.
        """
        before, middle = self._last.get(reading.module, (None, None))
        self._last[reading.module] = (middle, reading)
        if middle is None or before is None:
            return middle
        if not before.sequence + 1 == middle.sequence == reading.sequence - 1:
            return middle
        clean = self._cleaned(before, middle, reading)
        self._last[reading.module] = (clean, reading)
        return clean

    @property
    def held_back(self) -> int:
        """Readings taken in and not given out yet: the newest of each module."""
        return len(self._last)

    def summary(self) -> dict[str, int]:
        """For the health message: spikes by module."""
        return {str(module): count for module, count in sorted(self.spikes.items()) if count}

    def _cleaned(
        self, before: InertialReading, middle: InertialReading, after: InertialReading
    ) -> InertialReading:
        changes: dict[str, Vector3] = {}
        for name in ("specific_force", "angular_rate", "magnetic_field"):
            three = getattr(before, name), getattr(middle, name), getattr(after, name)
            if None in three:
                continue
            median = tuple(sorted(values)[1] for values in zip(*three, strict=True))
            limit = getattr(self._limits, name)
            if any(abs(a - b) > limit for a, b in zip(three[1], median, strict=True)):
                x, y, z = median
                changes[name] = (x, y, z)
        self.spikes[middle.module] += len(changes)
        return replace(middle, **changes) if changes else middle  # type: ignore[arg-type]
