"""What a chunk gives, in order of arrival: samples in batches, with other readings between them."""

from __future__ import annotations

import numpy as np

from gateway.frames import INERTIAL_SAMPLE, InertialBatch, Reading, Sample

_ROOM = 128
"""Samples made room for at a time, which costs as much as ten of them."""


class ReadingCollector:
    """Collects the readings of a chunk, of one after another; samples with nothing between are a batch."""

    def __init__(self) -> None:
        self.rows = np.empty(_ROOM, INERTIAL_SAMPLE)
        """Samples; those of earlier chunks belong to the caller that got them."""
        self.n_rows = 0
        """Samples so far."""
        self.total = 0
        """Readings of all chunks."""
        self._n_batched = 0
        self._found: list[Reading] = []

    def begin(self, most: int) -> None:
        """Begin a chunk of at most so many readings."""
        if self.n_rows + most > len(self.rows):
            self.rows, self.n_rows = np.empty(max(most, _ROOM), INERTIAL_SAMPLE), 0
        self._n_batched, self._found = self.n_rows, []

    def add_sample(self, sample: Sample) -> None:
        """Add a sample."""
        self.rows[self.n_rows] = sample
        self.n_rows += 1

    def add(self, reading: Reading) -> None:
        """Add a reading of another kind."""
        self._end_batch()
        self._found.append(reading)
        self.total += 1

    def end(self) -> list[Reading]:
        """Return all readings of the chunk."""
        self._end_batch()
        return self._found

    def _end_batch(self) -> None:
        begin, end = self._n_batched, self.n_rows
        if end > begin:
            self._found.append(InertialBatch(self.rows[begin:end]))
            self.total += end - begin
            self._n_batched = end
