"""One calibrated camera, and where it sees a point of the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
