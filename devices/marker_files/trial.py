"""Marker trajectories of one trial, whatever file they came from."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class MarkerTrial:
    """F frames of M points, in the axes of the file."""

    name: str
    labels: tuple[str, ...]
    """As in the file, without a subject's prefix. Those of unlabelled points are empty or begin with
    ``*``."""
    rate_hz: float
    positions: FloatArray
    """(F, M, 3) m; NaN where a marker was not seen."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Numbers that the file has beside the points, names in capitals, in the file's own units."""
    metres_per_unit: float = 1.0
    """Of the file's lengths."""
    begins_s: float = 0.0
    """Time of the first frame, by the file's own count: forces and other files of the trial have it too."""

    notes: tuple[str, ...] = ()
    """What is odd about the file and was got over, a sentence each."""

    @property
    def n_frames(self) -> int:
        """How many frames were captured."""
        return len(self.positions)

    @property
    def duration_s(self) -> float:
        """How long the trial lasts, s."""
        return self.n_frames / self.rate_hz

    def columns(self, labels: tuple[str, ...]) -> FloatArray:
        """Return the named points (F, len(labels), 3), m; NaN columns for those that the trial lacks."""
        chosen = np.full((self.n_frames, len(labels), 3), np.nan)
        # Of two points with one label the first counts: read backwards, it is the one that stays.
        index = {label: i for i, label in reversed(list(enumerate(self.labels)))}
        for k, label in enumerate(labels):
            if label in index:
                chosen[:, k] = self.positions[:, index[label]]
        return chosen

    def unlabelled(self) -> FloatArray:
        """Return the points (F, U, 3), m, that the system could not name."""
        chosen = [i for i, label in enumerate(self.labels) if not label or label.startswith("*")]
        return self.positions[:, chosen]


FARTHEST_M = 1000.0
"""From the origin."""


def seen_points(points: FloatArray) -> FloatArray:
    """Return points (F, M, 3) m, NaN where one coordinate is no number or farther away than ``FARTHEST_M``,
    or all three are the same number: 0, -9999 or 9999999, by which programs tell that a marker was not
    seen."""
    with np.errstate(invalid="ignore"):
        is_seen = (points != points[..., :1]).any(axis=2) & (np.abs(points) <= FARTHEST_M).all(axis=2)
    return np.where(is_seen[..., None], points, np.nan)


_PIECE = re.compile(r"(.+?)[\s_.-]+\(?\d+\)?")
"""A marker that its program found anew after a gap: ``LASI_1``, ``LASI-2``, ``LASI (2)``, beside ``LASI``."""


def joined_pieces(
    labels: Sequence[str], points: FloatArray, source: object
) -> tuple[tuple[str, ...], FloatArray, tuple[str, ...]]:
    """Return labels, points (F, M, 3) and notes with one column a marker whose trajectory is in pieces.

    Those are points of one name, or of one with a number behind it, of which no frame sees two. Of others of
    one name the first counts, which is a note.
    """
    columns: dict[str, list[int]] = {}
    for m, label in enumerate(labels):
        piece = _PIECE.fullmatch(label)
        name = piece[1] if piece is not None and piece[1] in labels else label
        if name and not name.startswith("*"):
            columns.setdefault(name, []).append(m)
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=2))
    places = points
    joined, twice, gone = list[str](), list[str](), set[int]()
    for name, own in columns.items():
        if len(own) == 1:
            continue
        if seen[:, own].any(axis=0).sum() > 1 and (seen[:, own].sum(axis=1) <= 1).all():
            places = places.copy() if places is points else places
            for m in own[1:]:
                places[seen[:, m], own[0]] = points[seen[:, m], m]
            joined.append(name)
            gone.update(own[1:])
        elif [labels[m] for m in own].count(name) > 1:
            twice.append(name)
    kept = [m for m in range(len(labels)) if m not in gone]
    notes = []
    if joined:
        notes.append(f"{source}: {', '.join(joined)} in pieces, of which no frame has two: joined")
    if twice:
        notes.append(f"{source}: several markers are called {', '.join(twice)}: the first of each counts")
    return tuple(labels[m] for m in kept), places[:, kept] if gone else places, tuple(notes)


METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Of the units that marker files name."""
_UNIT_NAMES = {
    "meter": "m", "metre": "m", "centimeter": "cm", "centimetre": "cm", "millimeter": "mm",
    "millimetre": "mm", "inch": "in", "inche": "in", "foot": "ft", "feet": "ft",
}  # fmt: skip
"""Written out, in small letters and without an s at the end."""


_LARGEST_M = 20.0
"""Spread of the points of a file in metres; in any other unit a person's are farther apart."""


def assumed_metres(points: FloatArray, source: object) -> tuple[float, tuple[str, ...]]:
    """Return the length of the unit of a file that tells none, m, and a note where that is not millimetres.

    points: (F, M, 3) in the file's unit.
    """
    seen = points[np.isfinite(points).all(axis=2)]
    if len(seen) and np.ptp(np.percentile(seen, (5, 95), axis=0), axis=0).max() < _LARGEST_M:
        return METRES["m"], (f"{source}: no unit told, and its points are that near: taken as metres",)
    return METRES["mm"], ()


def metres_of(unit: str) -> float | None:
    """Return the length of a unit by its sign or name, in m; None for one that is not known."""
    name = unit.strip().lower()
    return METRES.get(_UNIT_NAMES.get(name.removesuffix("s"), name))
