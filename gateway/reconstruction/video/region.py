"""The part of a picture that a pose network looks at: a square about one person, turned so that the trunk
stands upright in it. Where it will be in the next picture is step 7 of JP2020-042476A."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from devices.cameras.orders import Square
from gateway.body.camera import Camera, project
from gateway.frames import CameraHeatMaps, FloatArray

ROLL_STEP = np.radians(30.0)
"""Pictures are turned in steps, so that the network sees steady pictures while a person sways."""
ROOM = 1.25
"""Side of a region over the diameter of the circle about the hips that holds the person."""
_HEAD_ROOM = 1.1
"""Keypoints end at the eyes, the wrists and the toes: the person does a little later."""
_LEAST_LIKELIHOOD = 0.3
_FEWEST = 6
"""Keypoints that must be likely for a region to follow from them."""
_LEAST_PIXELS = 16.0
_LEAST_SHARE = 0.4
"""Of the keypoints, that must be in the picture for the camera to count as seeing the person."""


@dataclass(frozen=True, slots=True)
class PersonRegion:
    """A square of a picture, turned with the person's trunk."""

    centre: FloatArray  # (2,) pixels of the distorted picture
    size: float  # pixels, side
    roll: float
    """rad, a multiple of 30°: how far the trunk is turned clockwise, as the picture is seen, from upright."""

    def affine(self, pixels: int) -> FloatArray:
        """Return (2, 3): pixel (x, y, 1) of the picture to pixel of a crop of ``pixels`` × ``pixels``; pixel
        (0, 0) is the middle of the upper left one."""
        scale = pixels / self.size
        c, s = scale * np.cos(self.roll), scale * np.sin(self.roll)
        A = np.array([[c, s, 0.0], [-s, c, 0.0]], dtype=np.float64)
        A[:, 2] = (pixels - 1) / 2 - A[:, :2] @ self.centre
        return A


def upright_region(hips: FloatArray, shoulders: FloatArray, radius: float) -> PersonRegion:
    """Return the region of a person: hips and shoulders (2,) are the middles of either, pixels; radius: of
    the circle about the hips that holds the whole person, pixels."""
    trunk = shoulders - hips
    roll = float(np.round(np.arctan2(trunk[0], -trunk[1]) / ROLL_STEP) * ROLL_STEP)
    return PersonRegion(hips, max(2.0 * ROOM * radius, _LEAST_PIXELS), roll)


def region_of_points(
    points: FloatArray, likelihood: FloatArray, keypoints: Sequence[str]
) -> PersonRegion | None:
    """Return the region of a person whose keypoints are at ``points`` (n, 2), pixels; NaN or a low likelihood
    (n,) counts as not seen. None when too little of the trunk, or of the person, is seen."""
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


def region_of_maps(maps: CameraHeatMaps, keypoints: Sequence[str]) -> PersonRegion | None:
    """Return the region of the person for the next picture, by the peaks of this one's heat maps."""
    points, likelihood = peaks(maps)
    return region_of_points(points, likelihood, keypoints)


def peaks(maps: CameraHeatMaps) -> tuple[FloatArray, FloatArray]:
    """Return where every keypoint is likeliest, (n, 2) pixels of the picture, and how likely, (n,)."""
    n, _, columns = maps.likelihood.shape
    flat = maps.likelihood.reshape(n, -1)
    best = flat.argmax(axis=1)
    places: FloatArray = np.stack([best % columns, best // columns], axis=1).astype(np.float64)
    linear, shift = maps.map_from_pixel[:, :2], maps.map_from_pixel[:, 2]
    points = np.asarray(np.linalg.solve(linear, (places - shift).T).T, dtype=np.float64)
    return points, flat[np.arange(n), best].astype(np.float64)


def square_of(region: PersonRegion | None) -> Square | None:
    """Return a region as cameras are told of it."""
    if region is None:
        return None
    x, y = region.centre.tolist()
    return x, y, region.size, region.roll


def person_region(
    camera: Camera, keypoints: FloatArray, names: Sequence[str], *, must_see: bool = True
) -> PersonRegion | None:
    """Return the region of a person with keypoints (n_keypoints, 3) m of those names; None: the camera does
    not see the person, and is left out.

    must_see: None too where most of the person is beyond the picture's border.
    """
    pixels = project(camera, keypoints)
    with np.errstate(invalid="ignore"):
        inside = ((pixels > 0) & (pixels < (camera.width - 1, camera.height - 1))).all(axis=1)
    if must_see and inside.mean() < _LEAST_SHARE:
        return None
    return region_of_points(pixels, np.ones(len(pixels)), names)


def _middle(
    points: FloatArray,
    seen: np.ndarray[tuple[int], np.dtype[np.bool_]],
    keypoints: Sequence[str],
    part: str,
) -> FloatArray | None:
    sides = [keypoints.index(f"{side}_{part}") for side in ("left", "right")]
    sides = [index for index in sides if seen[index]]
    return np.asarray(points[sides].mean(axis=0), dtype=np.float64) if sides else None
