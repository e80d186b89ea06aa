"""The last seconds of some series, for plots."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from gateway.frames import FloatArray


class History:
    """Rows of values against time; those older than the span are forgotten."""

    def __init__(self, names: Sequence[str], span_s: float) -> None:
        self.names = tuple(names)
        self._span_s = span_s
        self._rows: deque[tuple[float, tuple[float, ...]]] = deque()

    def add(self, time_s: float, values: Sequence[float]) -> None:
        """Add one row; a time before the last clears the rest, as playback has jumped back."""
        if self._rows and time_s < self._rows[-1][0]:
            self._rows.clear()
        self._rows.append((time_s, tuple(values)))
        while self._rows[0][0] < time_s - self._span_s:
            self._rows.popleft()

    def arrays(self) -> tuple[FloatArray, ...]:
        """Return times relative to the last, s, then each series; one row of NaN where there is none yet."""
        if not self._rows:
            return (np.zeros(1), *(np.full(1, np.nan) for _ in self.names))
        times = np.array([time_s for time_s, _ in self._rows])
        values = np.array([row for _, row in self._rows])
        return (times - times[-1], *(np.ascontiguousarray(column) for column in values.T))
