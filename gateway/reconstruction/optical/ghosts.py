"""What distances between markers tell: points that are not what they are called, trials of two people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

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
    """Of the values that are known; NaN for none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan


def _neighbours(marker_set: MarkerSet) -> list[IntArray]:
    """Of every marker those on its segment, the one that bears it, and those that it bears."""
    body = marker_set.body
    on = np.array([body.index(marker_set.carriers[label]) for label in marker_set.labels])
    parents = body.parents[on]
    is_near = (on[:, None] == on) | (parents[:, None] == on) | (on[:, None] == parents)
    np.fill_diagonal(is_near, val=False)
    return [np.flatnonzero(row) for row in is_near]
