"""The part of a picture that a pose network looks at: a square about one person, turned so that the trunk
stands upright in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gateway.frames import FloatArray
from gateway.reconstruction.video.heat_maps import CameraHeatMaps

TURN_STEP_DEG = 30.0
"""Pictures are turned in steps, so that the network sees steady pictures while a person sways."""
ROOM = 1.25
"""Side of a region over the diameter of the circle about the hips that holds the person."""
_HEAD_ROOM = 1.1
"""Keypoints end at the eyes, the wrists and the toes: the person does a little later."""
_LEAST_LIKELIHOOD = 0.3
_FEWEST = 6
"""Keypoints that must be likely for a region to follow from them."""


@dataclass(frozen=True, slots=True)
class Region:
    """A square of a picture."""

    x: float  # pixels, its middle
    y: float
    side: float  # pixels
    turn_deg: float
    """By which the person leans to the right in the picture: from the picture's up to the trunk's up,
    clockwise as seen. A multiple of ``TURN_STEP_DEG``."""

    def map_from_pixel(self, size: int) -> FloatArray:
        """(2, 3): pixels of the picture to pixels of the upright square of ``size`` pixels a side, both
        counted from the middle of the upper left one."""
        scale = size / self.side
        turn = np.radians(self.turn_deg)
        linear = scale * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        middle = 0.5 * (size - 1)
        shift = middle - linear @ np.array([self.x, self.y])
        return np.concatenate([linear, shift[:, None]], axis=1)


def upright_region(hips: FloatArray, shoulders: FloatArray, radius: float) -> Region:
    """The region of a person: hips and shoulders (2,) are the middles of either, pixels; radius: of the
    circle about the hips that holds the whole person, pixels."""
    lean = np.degrees(np.arctan2(shoulders[0] - hips[0], hips[1] - shoulders[1]))
    turn = TURN_STEP_DEG * np.round(lean / TURN_STEP_DEG)
    return Region(float(hips[0]), float(hips[1]), float(max(2.0 * ROOM * radius, 16.0)), float(turn))


def region_of_points(points: FloatArray, likelihood: FloatArray, keypoints: tuple[str, ...]) -> Region | None:
    """The region of a person whose keypoints are at ``points`` (n, 2), pixels; NaN or a low likelihood (n,)
    counts as not seen. None when too little of the trunk, or of the person, is seen."""
    seen = np.isfinite(points).all(axis=1) & (likelihood >= _LEAST_LIKELIHOOD)
    if seen.sum() < _FEWEST:
        return None
    hips = _middle(points, seen, keypoints, "hip")
    shoulders = _middle(points, seen, keypoints, "shoulder")
    if hips is None or shoulders is None:
        return None
    radius = float(np.linalg.norm(points[seen] - hips, axis=1).max())
    trunk = float(np.linalg.norm(shoulders - hips))
    return upright_region(hips, shoulders, max(_HEAD_ROOM * radius, 1.5 * trunk))


def region_of_maps(maps: CameraHeatMaps, keypoints: tuple[str, ...]) -> Region | None:
    """The region of the person for the next picture, by the peaks of this one's heat maps."""
    points, likelihood = peaks(maps)
    return region_of_points(points, likelihood, keypoints)


def peaks(maps: CameraHeatMaps) -> tuple[FloatArray, FloatArray]:
    """Where every keypoint is likeliest, (n, 2) pixels of the picture, and how likely, (n,)."""
    n, _, columns = maps.likelihood.shape
    flat = maps.likelihood.reshape(n, -1)
    best = flat.argmax(axis=1)
    places = np.stack([best % columns, best // columns], axis=1).astype(np.float64)
    linear, shift = maps.map_from_pixel[:, :2], maps.map_from_pixel[:, 2]
    points: FloatArray = np.linalg.solve(linear, (places - shift).T).T
    return points, flat[np.arange(n), best].astype(np.float64)


def _middle(
    points: FloatArray,
    seen: np.ndarray[tuple[int], np.dtype[np.bool_]],
    keypoints: tuple[str, ...],
    part: str,
) -> FloatArray | None:
    sides = [keypoints.index(f"{side}_{part}") for side in ("left", "right")]
    sides = [index for index in sides if seen[index]]
    middle: FloatArray | None = points[sides].mean(axis=0) if sides else None
    return middle
