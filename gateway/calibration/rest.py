"""Stretches in which a module lies still, found while its readings come. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gateway.frames import FloatArray, Vector3

WINDOW_NS = 400_000_000
"""Rest is judged over windows of this length."""
SHORTEST_NS = 1_000_000_000
"""A stretch counts from this length on."""
FORCE_SIGMA = 0.25
"""Largest standard deviation of an axis of the specific force at rest, m/s²."""
RATE_SIGMA = np.radians(1.5)
"""Largest standard deviation of an axis of the angular rate at rest, rad/s."""
LARGEST_BIAS = np.radians(12.0)
"""A mean angular rate beyond this is a rotation, not a bias, rad/s."""
_DRIFT = 0.25  # m/s²: the mean of a window stays so near that of the stretch


@dataclass
class RestStretch:
    """Means over one stretch."""

    begin_ns: int
    end_ns: int
    windows: list[tuple[int, FloatArray, FloatArray]] = field(default_factory=list)
    """Of each: samples, mean specific force (3,) m/s², mean angular rate (3,) rad/s."""

    @property
    def duration_s(self) -> float:
        """Its length, s."""
        return (self.end_ns - self.begin_ns) * 1e-9

    @property
    def specific_force(self) -> FloatArray:
        """(3,) mean, m/s²."""
        return self._mean(1)

    @property
    def angular_rate(self) -> FloatArray:
        """(3,) mean, rad/s: the gyroscope's bias."""
        return self._mean(2)

    def _mean(self, which: int) -> FloatArray:
        counts = np.array([window[0] for window in self.windows], dtype=np.float64)
        means = np.stack([window[which] for window in self.windows])
        return np.average(means, axis=0, weights=counts)


class RestDetector:
    """Collects the stretches of one module."""

    def __init__(self) -> None:
        self._done: list[RestStretch] = []
        self._now: RestStretch | None = None
        self._begin_ns: int | None = None
        self._samples: list[tuple[Vector3, Vector3]] = []

    @property
    def stretches(self) -> list[RestStretch]:
        """Long enough ones, the one that still lasts included."""
        now = [] if self._now is None or self._now.duration_s * 1e9 < SHORTEST_NS else [self._now]
        return self._done + now

    @property
    def is_at_rest(self) -> bool:
        """As of the last window."""
        return self._now is not None

    def add(self, time_ns: int, specific_force: Vector3, angular_rate: Vector3) -> None:
        """Add a reading, in order of time; m/s² and rad/s."""
        if self._begin_ns is None:
            self._begin_ns = time_ns
        if time_ns - self._begin_ns >= WINDOW_NS:
            self._close_window(time_ns)
        self._samples.append((specific_force, angular_rate))

    def _close_window(self, time_ns: int) -> None:
        assert self._begin_ns is not None
        values = np.array(self._samples)
        begin_ns, self._begin_ns, self._samples = self._begin_ns, time_ns, []
        if len(values) < 4 or not _is_still(values):
            self._end_stretch()
            return
        force, rate = values.mean(axis=0)
        if self._now is not None and np.linalg.norm(force - self._now.specific_force) > _DRIFT:
            self._end_stretch()
        if self._now is None:
            self._now = RestStretch(begin_ns, time_ns)
        self._now.windows.append((len(values), force, rate))
        self._now.end_ns = time_ns

    def _end_stretch(self) -> None:
        self._done = self.stretches
        self._now = None


def _is_still(values: FloatArray) -> bool:
    """Return whether (n, 2, 3) readings of specific force and angular rate are of a module at rest."""
    force_sigma, rate_sigma = values.std(axis=0).max(axis=1)
    turning = np.abs(values[:, 1].mean(axis=0)).max()
    return bool(force_sigma < FORCE_SIGMA and rate_sigma < RATE_SIGMA and turning < LARGEST_BIAS)
