"""Cameras as kernels take them: a point to its pixel, a pixel to its ray. Compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.body.camera import Camera
from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled

_STEPS = 20
"""Of the fixed-point iteration that takes distortion out; a hundredth of a pixel needs five to ten."""


class CameraModel(NamedTuple):
    """A calibrated camera, see ``camera.Camera``."""

    matrix: FloatArray  # (3, 3) pixels
    distortion: FloatArray  # (5,) k1, k2, p1, p2, k3
    rotation: FloatArray  # (3, 3) world axes to camera axes
    translation: FloatArray  # (3,) m
    position: FloatArray  # (3,) m, the optical centre in the world


def camera_model(camera: Camera) -> CameraModel:
    """Return the arrays of a camera, contiguous."""
    arrays = (camera.matrix, camera.distortion, camera.rotation, camera.translation, camera.position)
    return CameraModel(*(np.ascontiguousarray(array, dtype=np.float64) for array in arrays))


@compiled
def pixel(camera: CameraModel, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the pixel of a point in camera axes, as it stands in the distorted picture; NaN behind the
    camera."""
    if not z > 0.0:
        return math.nan, math.nan
    k, d = camera.matrix, camera.distortion
    x, y = x / z, y / z
    square = x * x + y * y
    radial = 1.0 + square * (d[0] + square * (d[1] + square * d[4]))
    u = x * radial + 2.0 * d[2] * x * y + d[3] * (square + 2.0 * x * x)
    v = y * radial + d[2] * (square + 2.0 * y * y) + 2.0 * d[3] * x * y
    return k[0, 0] * u + k[0, 1] * v + k[0, 2], k[1, 1] * v + k[1, 2]


@compiled
def undistorted(camera: CameraModel, u: float, v: float) -> tuple[float, float]:
    """Return (x, y) at depth 1 in camera axes of a pixel of the distorted picture, by fixed-point
    iteration."""
    k, d = camera.matrix, camera.distortion
    y0 = (v - k[1, 2]) / k[1, 1]
    x0 = (u - k[0, 2] - k[0, 1] * y0) / k[0, 0]
    x, y = x0, y0
    for _ in range(_STEPS):
        square = x * x + y * y
        radial = 1.0 + square * (d[0] + square * (d[1] + square * d[4]))
        across = 2.0 * d[2] * x * y + d[3] * (square + 2.0 * x * x)
        down = d[2] * (square + 2.0 * y * y) + 2.0 * d[3] * x * y
        x, y = (x0 - across) / radial, (y0 - down) / radial
    return x, y


@compiled
def ray(camera: CameraModel, u: float, v: float) -> FloatArray:
    """Return the unit direction (3,), world axes, of the ray through a pixel of the distorted picture."""
    x, y = undistorted(camera, u, v)
    direction = np.empty(3)
    for i in range(3):
        direction[i] = camera.rotation[0, i] * x + camera.rotation[1, i] * y + camera.rotation[2, i]
    return direction / math.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
