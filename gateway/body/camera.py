"""One calibrated camera: where it sees a point of the world, and its entry in files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from gateway.errors import SettingsError
from gateway.frames import FloatArray


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole with radial and tangential distortion, in OpenCV's convention.

    Camera axes: x right, y down, z into the picture. Pixel (0, 0) is the middle of the upper left pixel.
    """

    name: str
    width: int  # pixels
    height: int  # pixels
    matrix: FloatArray  # (3, 3) focal lengths and principal point, pixels
    distortion: FloatArray  # (5,) k1, k2, p1, p2, k3
    rotation: FloatArray  # (3, 3) world axes to camera axes
    translation: FloatArray  # (3,) m, the world's origin in camera axes

    @property
    def position(self) -> FloatArray:
        """(3,) m, the optical centre in the world."""
        return -self.rotation.T @ self.translation


def project(camera: Camera, points: FloatArray) -> FloatArray:
    """Return pixels (..., 2) in the distorted picture, of world points (..., 3) in m.

    NaN for a point that is not in front of the camera.
    """
    seen = points @ camera.rotation.T + camera.translation
    depth = np.where(seen[..., 2] > 0.0, seen[..., 2], np.nan)
    x, y = seen[..., 0] / depth, seen[..., 1] / depth
    # OpenCV's model and order: radial k, tangential p.
    k1, k2, p1, p2, k3 = camera.distortion
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    distorted_y = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
    flat = np.stack([distorted_x, distorted_y, np.ones_like(x)], axis=-1)
    pixels: FloatArray = (flat @ camera.matrix.T)[..., :2]
    return pixels


Row = tuple[float, float, float]
_NOT_ORTHOGONAL = 1e-3
_LARGEST = 32768
"""Pixels."""


class CameraEntry(BaseModel):
    """One camera."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    name: str = Field(min_length=1)
    size: tuple[int, int] = Field(description="width and height, pixels")
    matrix: tuple[Row, Row, Row] = Field(description="focal lengths and principal point, pixels")
    distortion: tuple[float, float, float, float, float] = Field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0), description="k1, k2, p1, p2, k3 of OpenCV"
    )
    rotation: tuple[Row, Row, Row] = Field(description="world axes to camera axes")
    translation: Row = Field(description="the world's origin in camera axes, m")
    reprojection_px: float | None = Field(default=None, ge=0, description="RMS of the calibration")

    def camera(self, where: str) -> Camera:
        """Return the camera; where: the file, for errors. Raises ``SettingsError`` when there can be none
        such."""
        arrays = (np.array(each) for each in (self.matrix, self.distortion, self.rotation, self.translation))
        return checked(Camera(self.name, *self.size, *arrays), where)


def entry_of(camera: Camera) -> dict[str, Any]:
    """Return a camera as the content of an entry, every number in full."""
    return {
        "name": camera.name,
        "size": [camera.width, camera.height],
        "matrix": camera.matrix.tolist(),
        "distortion": camera.distortion.tolist(),
        "rotation": camera.rotation.tolist(),
        "translation": camera.translation.tolist(),
    }


def checked(camera: Camera, where: str) -> Camera:
    """Return the camera, if it can be one. Raises ``SettingsError`` naming what cannot be."""
    numbers = [camera.matrix, camera.distortion, camera.rotation, camera.translation]
    if not all(np.isfinite(values).all() for values in numbers):
        raise SettingsError(f"{where}: camera '{camera.name}' has numbers that are not finite")
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    if not (fx > 0 and fy > 0):
        raise SettingsError(f"{where}: camera '{camera.name}' has focal lengths {fx:g} and {fy:g} pixels")
    if not (0 < camera.width <= _LARGEST and 0 < camera.height <= _LARGEST):
        raise SettingsError(
            f"{where}: camera '{camera.name}' has pictures of size {camera.width} × {camera.height} pixels"
        )
    off = np.abs(camera.rotation @ camera.rotation.T - np.eye(3)).max()
    # A determinant below zero is a reflection.
    if off > _NOT_ORTHOGONAL or np.linalg.det(camera.rotation) < 0:
        raise SettingsError(f"{where}: the rotation of camera '{camera.name}' is none (off by {off:.2g})")
    return camera
