"""A camera whose pictures are not of the size that it was calibrated with."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum

import numpy as np

from gateway.body.camera import Camera
from gateway.errors import SettingsError


class SizeChange(StrEnum):
    """What was done to the pictures after the camera had taken them."""

    NONE = "none"
    SCALED = "scaled"
    """Shrunk or enlarged as a whole; what is left free by other proportions is an even border."""
    CROPPED = "cropped"
    """Cut off evenly on both sides, without scaling."""


def fitted(camera: Camera, width: int, height: int, change: SizeChange = SizeChange.NONE) -> Camera:
    """Return the camera for pictures of width × height pixels. Raises ``SettingsError`` for another size than
    the calibrated one with ``SizeChange.NONE``: what was done cannot be known from the sizes."""
    if (width, height) == (camera.width, camera.height):
        return camera
    if change is SizeChange.NONE:
        raise SettingsError(
            f"camera '{camera.name}' was calibrated with pictures of {camera.width}×{camera.height} pixels, "
            f"these are {width}×{height}: say how they were changed, --sizes scaled or --sizes cropped"
        )
    scale = 1.0 if change is SizeChange.CROPPED else min(width / camera.width, height / camera.height)
    # about the middle of the picture, which pixel centres put at (width - 1) / 2
    shift = 0.5 * np.array([width - 1, height - 1]) - scale * 0.5 * np.array(
        [camera.width - 1, camera.height - 1]
    )
    change_pixels = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]], [0.0, 0.0, 1.0]])
    return replace(camera, width=width, height=height, matrix=change_pixels @ camera.matrix)
