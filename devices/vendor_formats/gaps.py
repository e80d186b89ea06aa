"""What was lost, as rows of NaN: from counters, or from time stamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from devices.vendor_formats.sheets import FloatArray, FormatError, Sheet

IntArray = NDArray[np.int64]

RATES = (0.5, 20_000.0)
"""Hz, the lowest and the highest."""
_STEP_DECIMALS = 6
"""To which steps between times, s, count as equal: seconds since 1970 keep no more."""
_ROUNDED_SHARE = 0.1
"""Of all steps, at least, that the rarer of the two has which rounded times take turns between."""
_ROUNDED_SHARE_SHORTER = 0.02
"""The same where the rarer one is the shorter one, which no loss makes."""
_ROUNDED_OVER = 64
"""Steps over which rounded times are held against a straight line."""
_MOST_SLIPS = 0.05
"""Share of the rows that may be there twice, or late."""
_FARTHEST_ROWS = 200
"""That a late row may be from its place."""
_MOST_GAPS = 20
"""Times as many rows lost as there are: no loss, but counters that mean nothing."""


def unwrapped(counter: FloatArray, bits: int, path: Path, column: str) -> IntArray:
    """Return a counter (n,) that goes on where it wrapped. Raises ``FormatError`` where there is none."""
    if not np.isfinite(counter).all():
        raise FormatError(f"{path}: row {_first(~np.isfinite(counter))} has no '{column}'")
    whole = counter.astype(np.int64)
    size = 1 << bits
    # More than half of the counter's range ahead is taken for a step back.
    steps = (np.diff(whole) + size // 2 - 1) % size - (size // 2 - 1)
    return np.concatenate([whole[:1], whole[0] + np.cumsum(steps)])


def in_order(stamps: FloatArray | IntArray, sheet: Sheet, column: str) -> IntArray:
    """Return the rows (m,) in the order of their stamps (n,), each stamp once.

    Loggers write some rows twice, or late: the sheet notes how many. Raises ``FormatError`` where that is no
    slip: many rows, or one from far away, as of a second capture in the same file.
    """
    rows: IntArray = np.arange(len(stamps))
    steps = np.diff(stamps)
    if not np.isfinite(stamps).all():
        raise FormatError(f"{sheet.path}: row {_first(~np.isfinite(stamps))} has no '{column}'")
    if (steps > 0).all():
        return rows
    repeated, late = int((steps == 0).sum()), int((steps < 0).sum())
    sorted_rows = np.argsort(stamps, kind="stable")
    farthest = int(np.abs(sorted_rows - rows).max())
    if repeated + late > _MOST_SLIPS * len(stamps) or farthest > _FARTHEST_ROWS:
        row = _first(steps <= 0) + 1
        is_same = steps[row - 2] == 0
        how = f" has the same '{column}' as the one before" if is_same else f": '{column}' goes back"
        raise FormatError(
            f"{sheet.path}: row {row}{how} ({repeated + late} of {len(stamps)} rows do not go on): split a "
            "file of several captures; a CSV whose time is too coarse can be read by its rate_hz"
        )
    _, first = np.unique(stamps, return_index=True)
    sheet.add_note(
        f"{sheet.path}: {len(stamps) - len(first)} rows were there twice and left out, {late} that came late "
        "were put in their place"
    )
    return first


def index_of_times(times: FloatArray) -> IntArray:
    """Return the number of each row (n,) at the usual interval, gaps counted, of times that grow."""
    steps = np.diff(times)
    if not len(steps):
        return np.zeros(1, np.int64)
    taken = np.maximum(np.rint(steps / usual_interval(steps)), 1)
    return np.concatenate([[0], np.cumsum(taken)]).astype(np.int64)


def usual_interval(steps: FloatArray) -> float:
    """Return the interval (s) at which samples usually follow each other, of steps (n,) greater than 0.

    It is the median, but for times that are rounded: at 400 Hz whole milliseconds take turns between steps of
    2 and 3 ms, of which neither is the interval.
    """
    median = float(np.median(steps))
    rounded = np.round(steps, _STEP_DECIMALS)
    values, counts = np.unique(rounded, return_counts=True)
    if len(values) < 2:
        return median
    less, most = np.argsort(counts, kind="stable")[-2:]
    apart = abs(float(values[most] - values[less]))
    of_both = steps[np.isin(rounded, values[[less, most]])]
    mean = float(of_both.mean())
    length = min(_ROUNDED_OVER, len(of_both))
    walks = np.cumsum(of_both[: len(of_both) // length * length].reshape(-1, length) - mean, axis=1)
    # Rounding leaves a straight line by less than its own step, and takes turns; losses come at random.
    least = _ROUNDED_SHARE if values[less] > values[most] else _ROUNDED_SHARE_SHORTER
    is_rounded = counts[less] >= least * len(steps) and (
        float(np.median(np.ptp(walks, axis=1))) <= apart * (1 + 1e-3)
    )
    return mean if is_rounded else median


def rate_of(steps: FloatArray, path: Path, decimals: int = 1) -> float:
    """Hz, of the usual one of some intervals, s. Raises ``FormatError`` for what no module samples at."""
    with np.errstate(divide="ignore"):
        return round(checked_rate(float(np.float64(1.0) / usual_interval(steps)), path), decimals)


def checked_rate(rate_hz: float, path: Path) -> float:
    """Return the rate. Raises ``FormatError`` for one that no module samples at."""
    lowest, highest = RATES
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
    """Return the number of the first such row, counted from 1."""
    return int(np.flatnonzero(mask)[0]) + 1
