"""Crops of pictures by an affine, without aliasing, and the maps that belong to them."""

from __future__ import annotations

import numpy as np

from devices.cameras.opencv import cv2
from gateway.frames import FloatArray
from gateway.reconstruction.video.networks.network import Picture


def cropped(picture: Picture, map_from_pixel: FloatArray, size: int) -> Picture:
    """Return the square of ``size`` pixels that ``map_from_pixel`` (2, 3) takes the picture to; black
    outside.

    What is shrunk to less than a half is averaged first: single pixels would stand for many.
    """
    scale = float(np.sqrt(abs(np.linalg.det(map_from_pixel[:, :2]))))
    factor = int(1.0 / scale)
    if factor >= 2:
        picture, map_from_pixel = _averaged(picture, map_from_pixel, size, factor)
    crop: Picture = cv2.warpAffine(picture, map_from_pixel, (size, size), flags=cv2.INTER_LINEAR).astype(
        np.uint8, copy=False
    )
    return crop


def _averaged(
    picture: Picture, map_from_pixel: FloatArray, size: int, factor: int
) -> tuple[Picture, FloatArray]:
    """Return the part of the picture that is needed, shrunk by a whole factor, and the map from its
    pixels."""
    inverse = cv2.invertAffineTransform(map_from_pixel)
    corners = np.array([[0, 0, 1], [size, 0, 1], [0, size, 1], [size, size, 1]]) @ inverse.T
    height, width = picture.shape[:2]
    left, top = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, [width - factor, height - factor])
    right, bottom = np.ceil(corners.max(axis=0)).astype(int) + 1
    columns = max((min(right, width) - left) // factor, 1)
    rows = max((min(bottom, height) - top) // factor, 1)
    part = picture[top : top + rows * factor, left : left + columns * factor]
    small = cv2.resize(part, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.uint8, copy=False)
    # a small pixel's middle is that of its block: picture = factor * small + (factor - 1) / 2 + corner
    middle = 0.5 * (factor - 1)
    to_picture = np.array([[factor, 0.0, left + middle], [0.0, factor, top + middle], [0.0, 0.0, 1.0]])
    return small, map_from_pixel @ to_picture


def shrunk_map(map_to_crop: FloatArray, factor: float, of_edge: bool) -> FloatArray:
    """Return the map to cells of ``factor`` crop pixels each.

    of_edge: cell c stands for the upper left edge of its pixels (as in networks that were trained with
    targets at coordinate / factor), else for their middle.
    """
    shrunk = map_to_crop / factor
    shrunk[:, 2] += 0.5 / factor - (0.0 if of_edge else 0.5)
    return shrunk
