"""What became of the markers of a pose, as a message; like poses, round the model, for speed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gateway.frames import FloatArray, MarkerFit, SkeletonFrame

_DECIMALS = 6  # a micrometre: less than any optical system resolves


def markers_message(labels: tuple[str, ...], frame: SkeletonFrame) -> dict[str, Any] | None:
    """The fields of a ``MarkersMessage``; None for a pose that was made of something else, or of no marker.

    labels: of the fitted body, in the order of the fit. Raises ``ValueError`` for another number of them.
    """
    fit = frame.markers
    if fit is None or not np.isfinite(fit.virtual).all():
        return None
    rows = zip(
        labels, _places(fit.positions), _places(fit.virtual), _residuals(fit), fit.used.tolist(), strict=True
    )
    markers = {
        label: {"position": seen, "expected": expected, "residual": residual, "used": used}
        for label, seen, expected, residual, used in rows
    }
    for marker, whose in fit.renamed:
        markers[labels[marker]]["taken_from"] = "" if whose < 0 else labels[whose]
    return {
        "t_ns": frame.time_ns,
        "seq": frame.sequence,
        "frame": "ENU",
        "markers": markers,
        "unlabelled": [place for place in _places(fit.unlabelled) if place is not None],
    }


def _places(places: FloatArray) -> list[list[float] | None]:
    """Rows as JSON values; None for one that is not known."""
    rounded = np.round(places, _DECIMALS) + 0.0
    rows: list[list[float]] = rounded.tolist()
    known: list[bool] = np.logical_and.reduce(np.isfinite(rounded), axis=1).tolist()
    return [row if is_known else None for row, is_known in zip(rows, known, strict=True)]


def _residuals(fit: MarkerFit) -> list[float | None]:
    rounded: list[float] = np.round(fit.residuals, _DECIMALS).tolist()
    return [residual if math.isfinite(residual) else None for residual in rounded]
