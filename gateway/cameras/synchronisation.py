"""Whether cameras are in step: where one is some pictures behind, rays through one keypoint pass each other
now on this side and now on that, as the keypoint moves.

The signed distance of two rays has a part that stays, of calibration and of what a network takes for a
joint, and one that varies. Only the second shrinks when pictures of the same instant are compared: its mean,
after the median of every keypoint is taken out, tells a few pictures even where somebody moves slowly.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from gateway.frames import FloatArray

_LONGEST = 15
"""Pictures by which a camera may be off for it to be found; in a short capture a third of it."""
_SURE = 2
"""Pictures from which an offset counts; one may be half of one and the noise of the network."""
_LEAST_LIKELIHOOD = 0.5
_PARALLEL = 0.1
"""Sine of the angle between two rays under which they say little."""
_FARTHEST = 0.1
"""What is farther off than this, m, is another person or the other arm."""
_LEAST_SHARE = 0.08
"""Of the unrest, that must go with the offsets for them to count, in either half of the instants too."""
_FEWEST = 10
"""Instants of a keypoint."""

Unrest = Mapping[tuple[int, int], FloatArray]
"""By pair of cameras, (2 n + 1,) m: the second's pictures taken -n to n later; NaN: too little is seen."""


@dataclass(frozen=True)
class Synchronisation:
    """How the cameras are in step."""

    offsets: list[int]
    """By camera, pictures behind the first one; all 0 where nothing else is clearly better."""
    before: float
    after: float
    """Mean unrest of all pairs, m, as the pictures are and with the offsets taken out."""


def synchronisation_of(positions: FloatArray, directions: FloatArray, likely: FloatArray) -> Synchronisation:
    """Find how cameras are in step, which stand at positions (C, 3) m with rays (F, C, K, 3) through
    keypoints of likelihood (F, C, K)."""
    n = len(positions)
    whole = _unrest(positions, directions, likely)
    offsets = _best(whole, n)
    before, after = _total(whole, [0] * n), _total(whole, offsets)
    half = len(directions) // 2
    is_clear = max(map(abs, offsets)) >= _SURE and all(
        _is_better(_unrest(positions, directions[part], likely[part]), offsets)
        for part in (slice(None), slice(0, half), slice(half, None))
    )
    return Synchronisation(offsets, before, after) if is_clear else Synchronisation([0] * n, before, before)


def _is_better(unrest: Unrest, offsets: Sequence[int]) -> bool:
    before, after = _total(unrest, [0] * len(offsets)), _total(unrest, offsets)
    return not np.isfinite(before) or after < (1.0 - _LEAST_SHARE) * before


def _unrest(positions: FloatArray, directions: FloatArray, likely: FloatArray) -> Unrest:
    return {
        (a, b): _of_pair(positions[b] - positions[a], directions[:, [a, b]], likely[:, [a, b]])
        for a, b in itertools.combinations(range(len(positions)), 2)
    }


def _of_pair(between: FloatArray, rays: FloatArray, likely: FloatArray) -> FloatArray:
    """Return (2 n + 1,) m of two cameras ``between`` (3,) apart; rays: (F, 2, K, 3); likely: (F, 2, K)."""
    curve = np.full(2 * _LONGEST + 1, np.nan)
    n = len(rays)
    longest = min(_LONGEST, n // 3)
    for offset in range(-longest, longest + 1):
        early = slice(max(0, -offset), n - max(0, offset))
        late = slice(max(0, offset), n - max(0, -offset))
        apart = signed_distances(
            between, rays[early, 0], rays[late, 1], np.minimum(likely[early, 0], likely[late, 1])
        )
        apart = apart[:, np.isfinite(apart).sum(axis=0) >= _FEWEST]
        if apart.size:
            varying = np.abs(apart - np.nanmedian(apart, axis=0))
            curve[offset + _LONGEST] = np.nanmean(np.minimum(varying, _FARTHEST))
    return curve


def signed_distances(
    between: FloatArray, first: FloatArray, second: FloatArray, likely: FloatArray
) -> FloatArray:
    """Return (F, K) m by which rays (F, K, 3) of two cameras ``between`` (3,) apart pass each other; the sign
    tells on which side. NaN where they are nearly parallel, or not likely (F, K)."""
    common = np.cross(first, second)
    sine = np.linalg.norm(common, axis=-1)
    sure = (likely > _LEAST_LIKELIHOOD) & (sine > _PARALLEL)
    return np.where(sure, common @ between / np.where(sure, sine, 1.0), np.nan)


def _best(unrest: Unrest, n: int) -> list[int]:
    """Return pictures by which each camera is behind the first, where all pairs together are calmest."""
    starts = [[0] * n]
    for reference in range(n):
        offsets = [_best_of_pair(unrest, reference, c) for c in range(n)]
        starts.append([offset - offsets[0] for offset in offsets])
    return min((_descended(unrest, start) for start in starts), key=lambda found: _total(unrest, found))


def _best_of_pair(unrest: Unrest, a: int, b: int) -> int:
    if a == b:
        return 0
    curve = unrest[min(a, b), max(a, b)]
    if np.isnan(curve).all():
        return 0
    offset = int(np.nanargmin(curve)) - _LONGEST
    return offset if a < b else -offset


def _descended(unrest: Unrest, start: list[int]) -> list[int]:
    """Shift one camera after the other to where all agree best."""
    offsets = list(start)
    for _ in range(3):
        for c in range(1, len(offsets)):
            tried = [[*offsets[:c], o, *offsets[c + 1 :]] for o in range(-_LONGEST, _LONGEST + 1)]
            offsets = min([offsets, *tried], key=lambda each: _total(unrest, each))
    return offsets


def _total(unrest: Unrest, offsets: Sequence[int]) -> float:
    """Return the mean over all pairs at these offsets, m; infinite where one is out of reach."""
    values = [
        _at(curve, offsets[b] - offsets[a]) for (a, b), curve in unrest.items() if np.isfinite(curve).any()
    ]
    return float(np.mean(values)) if values else np.inf


def _at(curve: FloatArray, offset: int) -> float:
    """Return the value of a curve over offsets; infinite beyond its ends, and where too little is seen."""
    value = float(curve[offset + _LONGEST]) if abs(offset) <= _LONGEST else np.nan
    return np.inf if np.isnan(value) else value
