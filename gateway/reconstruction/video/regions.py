"""Where a person will be in every camera's next picture, from the pose: step 7 of JP2020-042476A."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from devices.cameras.orders import Square
from gateway.body.camera import Camera, project
from gateway.frames import FloatArray
from gateway.reconstruction.video.region import PersonRegion, region_of_points

_LEAST_SHARE = 0.4
"""Of the keypoints, that must be in the picture for the camera to count as seeing the person."""


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
