"""A static start: while the body rests, every module is a plumb line and a compass."""

from __future__ import annotations

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.reconstruction.inertial.observations import SegmentObservations


class StaticStart:
    """Watches for rest of the whole body; gives all orientations once it has lasted long enough.

    n_frames: how many successive frames rest must last.
    norm_tolerance: how far the mean specific force may be from |g|, m/s².
    deviation: largest standard deviation of an axis of the specific force, m/s².
    """

    def __init__(
        self, gravity: FloatArray, field: FloatArray, n_frames: int, norm_tolerance: float, deviation: float
    ) -> None:
        self._gravity, self._field = gravity, field
        self._n_frames, self._norm_tolerance, self._deviation = n_frames, norm_tolerance, deviation
        self.reset()

    def reset(self) -> None:
        """Begin to watch anew."""
        self._history: list[SegmentObservations] = []

    def add(self, observations: SegmentObservations) -> FloatArray | None:
        """Orientations (n_segments, 3, 3) when the body has rested, NaN without module; else None."""
        self._history = [*self._history[1 - self._n_frames :], observations]
        if len(self._history) < self._n_frames:
            return None
        force = np.array([o.specific_force for o in self._history])  # (n_frames, n_segments, 3)
        observed = np.isfinite(force).all(axis=(0, 2))
        if not observed.any() or not self._is_static(force[:, observed]):
            return None
        magnetic = np.array([o.magnetic_field for o in self._history]).mean(axis=0)
        mean = force.mean(axis=0)
        up = -self._gravity
        vectors = zip(mean, magnetic, strict=True)
        vectors = zip(mean, magnetic, strict=True)
        return np.stack([rotation_matrix.from_two_vectors(f, x, up, self._field) for f, x in vectors])

    def _is_static(self, force: FloatArray) -> bool:
        norms = np.linalg.norm(force.mean(axis=0), axis=-1)
        off_norm = np.abs(norms - np.linalg.norm(self._gravity))
        return bool(off_norm.max() < self._norm_tolerance and force.std(axis=0).max() < self._deviation)
