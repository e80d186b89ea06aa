"""Points of a trial that cannot be the markers they are called: far from all that sits beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from devices.marker_files import MarkerTrial
from gateway.frames import IntArray
from gateway.reconstruction.optical.marker_set import MarkerSet

_FEWEST_FRAMES = 5
"""That tell how far apart two markers usually are."""
_FEWEST_NEIGHBOURS = 2
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


def _neighbours(marker_set: MarkerSet) -> list[IntArray]:
    """Of every marker those on its segment, the one that bears it, and those that it bears."""
    body = marker_set.body
    on = np.array([body.index(marker_set.carriers[label]) for label in marker_set.labels])
    parents = body.parents[on]
    is_near = (on[:, None] == on) | (parents[:, None] == on) | (on[:, None] == parents)
    np.fill_diagonal(is_near, val=False)
    return [np.flatnonzero(row) for row in is_near]
