"""Where a person is in a picture, for the crop of the next frame.

Step 7 of JP2020-042476A: from the pose, the picture is turned in steps of 30° until the trunk stands upright,
cropped to the person and shrunk; a camera that does not see the person is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gateway.frames import FloatArray
from gateway.reconstruction.video.camera import Camera, project

ROLL_STEP = np.radians(30.0)
MARGIN = 1.3
"""Side of the crop over the larger extent of the keypoints."""
_LEAST_SHARE = 0.4
"""Of the keypoints, that must be in the picture for the camera to count as seeing the person."""
_LEAST_PIXELS = 16.0


@dataclass(frozen=True, slots=True)
class PersonRegion:
    """A square of a picture, turned with the person's trunk."""

    centre: FloatArray  # (2,) pixels of the distorted picture
    size: float  # pixels, side
    roll: float
    """rad, a multiple of 30°: how far the trunk is turned clockwise from upright, as the picture is seen."""

    def affine(self, pixels: int) -> FloatArray:
        """(2, 3): pixel (x, y, 1) of the picture to that of an upright crop of ``pixels`` × ``pixels``.

        Pixel (0, 0) is the middle of the upper left one.
        """
        scale = pixels / self.size
        c, s = scale * np.cos(self.roll), scale * np.sin(self.roll)
        A = np.array([[c, s, 0.0], [-s, c, 0.0]])
        A[:, 2] = (pixels - 1) / 2 - A[:, :2] @ self.centre
        return A


def person_region(camera: Camera, keypoints: FloatArray, up: FloatArray) -> PersonRegion | None:
    """The region of keypoints (n_keypoints, 3) m; None: the camera does not see the person.

    up: (2, 3) m, from the middle of the hips to that of the shoulders.
    """
    pixels = project(camera, keypoints)
    with np.errstate(invalid="ignore"):
        inside = ((pixels > 0) & (pixels < (camera.width - 1, camera.height - 1))).all(axis=1)
    if inside.mean() < _LEAST_SHARE:
        return None
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    hips, shoulders = project(camera, up)
    trunk = shoulders - hips
    angle = np.arctan2(trunk[0], -trunk[1]) if np.isfinite(trunk).all() else 0.0
    roll = float(np.round(angle / ROLL_STEP) * ROLL_STEP)
    c, s = np.cos(roll), np.sin(roll)
    turned = seen @ np.array([[c, -s], [s, c]])
    low, high = turned.min(axis=0), turned.max(axis=0)
    centre = np.array([[c, -s], [s, c]]) @ (0.5 * (low + high))
    size = max(MARGIN * float((high - low).max()), _LEAST_PIXELS)
    return PersonRegion(centre, size, roll)
