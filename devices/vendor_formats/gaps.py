"""What was lost, as rows of NaN: from counters, or from time stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from devices.emulators.bodies import FloatArray
from devices.vendor_formats.sheets import FormatError

IntArray = NDArray[np.int64]

_RATES = (0.5, 20_000.0)
"""Hz, the lowest and the highest."""
_MOST_GAPS = 20
"""Times as many rows lost as there are: no loss, but counters that mean nothing."""


def unwrapped(counter: FloatArray, bits: int, path: Path, column: str) -> IntArray:
    """Return a counter (n,) that goes on where it wrapped. Raises ``FormatError`` where it stands still."""
    if not np.isfinite(counter).all():
        raise FormatError(f"{path}: row {_first(~np.isfinite(counter))} has no '{column}'")
    whole = counter.astype(np.int64)
    size = 1 << bits
    steps = np.diff(whole) % size
    if (steps == 0).any():
        raise FormatError(f"{path}: row {_first(steps == 0) + 1} has the same '{column}' as the one before")
    # More than half of the counter's range ahead is taken for a step back.
    if (steps > size // 2).any():
        raise FormatError(f"{path}: row {_first(steps > size // 2) + 1}: '{column}' goes back")
    return np.concatenate([whole[:1], whole[0] + np.cumsum(steps)])


def index_of_times(times: FloatArray, path: Path) -> IntArray:
    """Return the number of each row (n,) at the usual interval, gaps counted. Raises ``FormatError``."""
    steps = np.diff(times)
    if not np.isfinite(times).all() or (steps <= 0).any():
        bad = ~np.isfinite(times)
        bad[1:] |= ~(steps > 0)
        raise FormatError(f"{path}: row {_first(bad)}: the time does not grow")
    if not len(steps):
        return np.zeros(1, np.int64)
    return np.concatenate([[0], np.cumsum(np.maximum(np.rint(steps / np.median(steps)), 1))]).astype(np.int64)


def rate_of(steps: FloatArray, path: Path, decimals: int = 1) -> float:
    """Hz, of the usual one of some intervals, s. Raises ``FormatError`` for what no module samples at."""
    with np.errstate(divide="ignore"):
        return round(checked_rate(float(np.float64(1.0) / np.median(steps)), path), decimals)


def checked_rate(rate_hz: float, path: Path) -> float:
    """Return the rate. Raises ``FormatError`` for one that no module samples at."""
    lowest, highest = _RATES
    if not lowest <= rate_hz <= highest:
        raise FormatError(
            f"{path}: {rate_hz:g} samples a second; from {lowest:g} to {highest:g} are read. Is its time in "
            "another unit?"
        )
    return rate_hz


def spread(
    index: IntArray, times: FloatArray, values: FloatArray, path: Path
) -> tuple[FloatArray, FloatArray]:
    """Return times (m,) and values (m, k) with a row of NaN for every number missing in ``index`` (n,)."""
    at = index - index[0]
    length = int(at[-1]) + 1
    if length > _MOST_GAPS * len(at) + 1000:
        raise FormatError(f"{path}: {len(at)} rows counted up to {length}: its counter or its times jump")
    whole = np.full((length, values.shape[1]), np.nan)
    whole[at] = values
    return np.interp(np.arange(length), at, times), whole


def _first(mask: NDArray[np.bool_]) -> int:
    """Number of the first such row, counted from 1."""
    return int(np.flatnonzero(mask)[0]) + 1
