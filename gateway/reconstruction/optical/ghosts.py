"""What distances between markers tell: points that are not what they are called, trials of two people.

This is asked before there is a body. The solver has one, and questions names by where the body is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from devices.marker_files import MarkerTrial
from gateway.frames import FloatArray, IntArray
from gateway.reconstruction.optical.marker_set import MarkerSet

_FEWEST_FRAMES = 5
"""That tell how far apart two markers usually are."""
_FEWEST_NEIGHBOURS = 2
_OTHER_SIZE = 0.07
_TIMES = 2.5
_MORE_M = 0.05
"""Farther apart than so many times as usual and so much more: no joint bends two markers of neighbouring
segments so far apart."""
_LONGEST_GAP_S = 0.1
"""Over which a pair's last places tell which is which."""
_LEAP_M, _NEARER = 0.1, 0.5
"""By so much, and by such a share, a pair goes less far if its names are exchanged."""


def sides_kept(marker_set: MarkerSet, trial: MarkerTrial) -> tuple[MarkerTrial, Mapping[str, int]]:
    """Return the trial with the left and the right marker of each pair where they go on from, and in how many
    frames they had been exchanged, by the left one.

    Exchanged names leap to the other side, both at once. Of the two stretches that is the wrong one in which
    left lies to the right, by the markers of pelvis and head; the shorter, where those do not tell.
    """
    positions, found = trial.positions, dict[str, int]()
    leftwards = _leftwards(marker_set, trial)
    for pair in _pairs(marker_set):
        if not {*pair} <= {*trial.labels}:
            continue
        columns = np.array([trial.labels.index(label) for label in pair])
        is_other = _exchanged(trial.positions[:, columns], leftwards, _LONGEST_GAP_S * trial.rate_hz)
        if is_other.any():
            positions = positions.copy() if positions is trial.positions else positions
            positions[np.ix_(is_other, columns)] = trial.positions[np.ix_(is_other, columns[::-1])]
            found[pair[0]] = int(is_other.sum())
    return (replace(trial, positions=positions), found) if found else (trial, {})


def _pairs(marker_set: MarkerSet) -> list[tuple[str, str]]:
    """Return the markers of left segments, each with the one at the same place of the right."""
    own = marker_set.file.markers
    return [
        pair
        for name, labels in own.items()
        if name.startswith("left_")
        and len(labels) == len(own.get(right := name.replace("left", "right", 1), []))
        for pair in zip(labels, own[right], strict=True)
    ]


def _leftwards(marker_set: MarkerSet, trial: MarkerTrial) -> FloatArray:
    """Return (F, 3) m, from right to left by markers of segments that have no side; 0 where none tells."""
    on_middle = [
        label
        for name, labels in marker_set.file.markers.items()
        if not name.startswith(("left_", "right_"))
        for label in labels
    ]
    lefts = [label for label in on_middle if label[0] == "L" and f"R{label[1:]}" in on_middle]
    rights = tuple(f"R{label[1:]}" for label in lefts)
    apart = trial.columns(tuple(lefts)) - trial.columns(rights)
    summed: FloatArray = np.nan_to_num(apart).sum(axis=1)
    return summed


def _exchanged(pair: FloatArray, leftwards: FloatArray, longest_gap: float) -> NDArray[np.bool_]:
    """Return in which frames the two points of a pair (F, 2, 3) have each other's name."""
    is_other = np.zeros(len(pair), dtype=bool)
    seen = np.flatnonzero(np.isfinite(pair).all(axis=(1, 2)))
    if len(seen) < _FEWEST_FRAMES:
        return is_other
    before, after = pair[seen[:-1]], pair[seen[1:]]
    own = np.linalg.norm(after - before, axis=2).sum(axis=1)
    crossed = np.linalg.norm(after - before[:, ::-1], axis=2).sum(axis=1)
    leaps = (crossed < _NEARER * own) & (own - crossed > _LEAP_M) & (np.diff(seen) <= max(1.0, longest_gap))
    if not leaps.any():
        return is_other
    turns = np.cumsum(leaps) % 2 == 1
    to_left = ((pair[seen, 0] - pair[seen, 1]) * leftwards[seen]).sum(axis=1)[1:]
    is_left = float(np.where(turns, -to_left, to_left).sum()) or 0.5 * len(turns) - turns.sum()
    if is_left < 0:
        turns = ~turns
        is_other[: seen[0] + 1] = True
    # A frame that sees only one of the two has the names of the one before it.
    for first, last, other in zip(seen[1:], [*seen[2:], len(pair)], turns, strict=True):
        is_other[first:last] = other
    return is_other


def without_ghosts(marker_set: MarkerSet, trial: MarkerTrial) -> tuple[MarkerTrial, Mapping[str, int]]:
    """Return the trial without points that lie far from most markers of their own and neighbouring segments,
    and how many those were, by marker."""
    labels = marker_set.labels
    places = trial.columns(labels)
    if len(places) < _FEWEST_FRAMES:
        return trial, {}
    positions, found = trial.positions.copy(), dict[str, int]()
    for m, neighbours in enumerate(_neighbours(marker_set)):
        apart = np.linalg.norm(places[:, neighbours] - places[:, m, None], axis=2)
        enough = np.isfinite(apart).sum(axis=0) >= _FEWEST_FRAMES
        apart = apart[:, enough]
        if apart.shape[1] < _FEWEST_NEIGHBOURS:
            continue
        known = np.isfinite(apart).sum(axis=1)
        far = (apart > _TIMES * np.nanmedian(apart, axis=0) + _MORE_M).sum(axis=1)
        is_ghost = (known >= _FEWEST_NEIGHBOURS) & (2 * far > known)
        if is_ghost.any():
            positions[is_ghost, trial.labels.index(labels[m])] = np.nan
            found[labels[m]] = int(is_ghost.sum())
    return (replace(trial, positions=positions), found) if found else (trial, {})


def other_sizes(marker_set: MarkerSet, trials: Sequence[MarkerTrial]) -> dict[str, float]:
    """Return how many times as far apart as in the first trial the markers of one segment are, median, of
    trials in which that is no question of skin."""
    carriers = marker_set.carriers
    pairs = [(a, b) for a, b in combinations(marker_set.labels, 2) if carriers[a] == carriers[b]]
    apart = []
    for trial in trials:
        places = dict(
            zip(marker_set.labels, trial.columns(marker_set.labels).transpose(1, 0, 2), strict=True)
        )
        apart.append([_median(np.linalg.norm(places[a] - places[b], axis=1)) for a, b in pairs])
    found = {}
    for trial, own in zip(trials[1:], apart[1:], strict=True):
        ratio = _median(np.divide(own, apart[0]))
        if abs(ratio - 1.0) > _OTHER_SIZE:
            found[trial.name] = ratio
    return found


def _median(values: FloatArray) -> float:
    """Return the median of the values that are known; NaN for none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _neighbours(marker_set: MarkerSet) -> list[IntArray]:
    """Return for every marker those on its segment, on the one that bears it, and on those that it bears."""
    body = marker_set.body
    on = np.array([body.index(marker_set.carriers[label]) for label in marker_set.labels])
    parents = body.parents[on]
    is_near = (on[:, None] == on) | (parents[:, None] == on) | (on[:, None] == parents)
    np.fill_diagonal(is_near, val=False)
    return [np.flatnonzero(row) for row in is_near]
