"""One person in the pictures of two neighbouring cameras, seen by the network as a whole: step 7 of
JP2020-042476A.

About the person the pixels of the second picture go to those of the first by an affine map, which the
person's expected keypoints tell. The network sees the first picture, and the second where the first has
ended. Of the heat maps each camera gets the cells that lie in its own picture, with the map from its own
pixels: a ray belongs to the camera that took the pixel, so that neither the seam nor the distance of the two
cameras moves a keypoint.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from devices.cameras.opencv import cv2
from gateway.frames import CameraHeatMaps, FloatArray
from gateway.reconstruction.video.networks.network import Picture, PoseNetwork
from gateway.reconstruction.video.region import PersonRegion


def joined_heat_maps(
    network: PoseNetwork, first: Picture, second: Picture, region: PersonRegion, joined: FloatArray
) -> tuple[CameraHeatMaps, CameraHeatMaps]:
    """Return the maps of a person for the first and for the second camera.

    region: in the first picture's pixels, beyond its border too. joined: (2, 3) of ``joining``.
    """
    corner = np.floor(region.centre - 0.75 * region.size)
    side = int(np.ceil(1.5 * region.size))
    canvas = _canvas(first, second, joined, corner, side)
    maps = network.heat_maps(canvas, PersonRegion(region.centre - corner, region.size, region.roll))
    to_map = _after(maps.map_from_pixel, np.column_stack([np.eye(2), -corner]))
    own = _cells_of(first, to_map, maps.likelihood.shape[1:])
    return (
        CameraHeatMaps(maps.likelihood * own, to_map),
        CameraHeatMaps(maps.likelihood * ~own, _after(to_map, joined)),
    )


def _canvas(first: Picture, second: Picture, joined: FloatArray, corner: FloatArray, side: int) -> Picture:
    """Return a square of the first picture's pixels from ``corner`` on: the first over the second over
    black."""
    moved = joined.copy()
    moved[:, 2] -= corner
    canvas = np.asarray(cv2.warpAffine(second, moved, (side, side), flags=cv2.INTER_LINEAR), dtype=np.uint8)
    left, top = (int(value) for value in corner)
    height, width = first.shape[:2]
    x0, x1 = max(0, left), min(width, left + side)
    y0, y1 = max(0, top), min(height, top + side)
    if x0 < x1 and y0 < y1:
        canvas[y0 - top : y1 - top, x0 - left : x1 - left] = first[y0:y1, x0:x1]
    return canvas


def _cells_of(picture: Picture, to_map: FloatArray, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return (rows, columns) cells of a map that lie in a picture."""
    rows, columns = np.indices(shape).reshape(2, -1)
    pixels = np.linalg.solve(to_map[:, :2], np.stack([columns, rows]) - to_map[:, 2:]).T
    height, width = picture.shape[:2]
    inside = (pixels >= -0.5) & (pixels <= (width - 0.5, height - 0.5))
    return np.asarray(inside.all(axis=1), dtype=np.bool_).reshape(shape)


def _after(second: FloatArray, first: FloatArray) -> FloatArray:
    """Return (2, 3): the affine map ``first``, then ``second``."""
    return np.column_stack([second[:, :2] @ first[:, :2], second[:, :2] @ first[:, 2] + second[:, 2]])
