"""Somebody in the pictures of two cameras side by side."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")

from gateway.body.camera import project
from gateway.cameras.stitching import joined_heat_maps
from gateway.frames import CameraHeatMaps
from gateway.reconstruction.video.leading import joining
from gateway.reconstruction.video.region import PersonRegion
from tests.ring_of_cameras import CAMERAS

WHOLE = CAMERAS[0]
POINTS = np.random.default_rng(3).normal(size=(30, 3)) * [0.2, 0.2, 0.5] + [0.0, 0.0, 0.9]
SEAM = 640
OVERLAP = 20


def halves():
    matrix = WHOLE.matrix.copy()
    matrix[0, 2] -= SEAM - OVERLAP
    left = replace(WHOLE, name="left", width=SEAM + OVERLAP)
    return left, replace(WHOLE, name="right", width=WHOLE.width - SEAM + OVERLAP, matrix=matrix)


class Brightness:
    """A network whose one map is the picture itself, at a quarter of the size."""

    keypoints = ("all",)

    def heat_maps(self, picture, region):
        side = round(region.size / 4)
        affine = region.affine(side)
        rows, columns = np.indices((side, side)).reshape(2, -1)
        pixels = np.rint(np.linalg.solve(affine[:, :2], np.stack([columns, rows]) - affine[:, 2:])).astype(
            int
        )
        values = np.zeros(side * side, dtype=np.float32)
        inside = (pixels >= 0).all(axis=0) & (pixels[0] < picture.shape[1]) & (pixels[1] < picture.shape[0])
        values[inside] = picture[pixels[1, inside], pixels[0, inside], 0]
        return CameraHeatMaps(values.reshape(1, side, side), affine)


def test_about_a_person_pixels_of_one_camera_are_those_of_the_other():
    left, right = halves()
    affine = joining(left, right, POINTS)
    assert affine == pytest.approx(np.array([[1, 0, SEAM - OVERLAP], [0, 1, 0]]), abs=1e-6)


def test_one_picture_is_enough_for_somebody_who_is_wholly_in_it():
    left, right = halves()
    assert joining(WHOLE, right, POINTS) is None
    aside = POINTS + 5.0 * WHOLE.rotation[0]  # beyond both pictures
    assert joining(left, right, aside) is None


def test_every_camera_gets_the_cells_of_its_own_picture():
    left, right = halves()
    shade = np.add.outer(np.arange(WHOLE.height) // 8, np.arange(WHOLE.width) // 16).astype(np.uint8)
    picture = np.repeat(shade[:, :, None], 3, axis=2)
    middle = project(WHOLE, POINTS).mean(axis=0)
    region = PersonRegion(middle, 320.0, np.radians(30.0))
    affine = joining(left, right, POINTS)
    first, second = joined_heat_maps(
        Brightness(), picture[:, : left.width], picture[:, -right.width :], region, affine
    )
    assert not ((first.likelihood > 0) & (second.likelihood > 0)).any()
    for camera, maps, shown in (
        (left, first, picture[:, : left.width]),
        (right, second, picture[:, -right.width :]),
    ):
        rows, columns = np.nonzero(maps.likelihood[0])
        assert len(rows) > 500
        A = maps.map_from_pixel
        pixels = np.linalg.solve(A[:, :2], np.stack([columns, rows]) - A[:, 2:]).T
        assert ((pixels > -1) & (pixels < [camera.width, camera.height])).all()
        x, y = np.clip(np.rint(pixels).astype(int), 0, [camera.width - 1, camera.height - 1]).T
        off = maps.likelihood[0, rows, columns] - shown[y, x, 0]
        assert np.abs(off).max() <= 1.0
