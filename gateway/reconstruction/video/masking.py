"""Other people taken out of one person's heat maps: step 7 of JP2020-042476A. Compiled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gateway.body.camera import Camera, project
from gateway.frames import CameraHeatMaps, FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.video.lattice import Maps


def without_others(
    camera: Camera, maps: CameraHeatMaps, own: FloatArray, others: Sequence[FloatArray]
) -> CameraHeatMaps:
    """Return the maps with zero wherever another person's same keypoint is expected nearer by than the own
    one.

    own, others: (n_keypoints, 3) m, expected in this frame.
    """
    A = maps.map_from_pixel
    here = project(camera, own) @ A[:, :2].T + A[:, 2]
    likelihood = maps.likelihood.copy()
    for other in others:
        there = project(camera, other) @ A[:, :2].T + A[:, 2]
        _clear(likelihood, here, there)
    return CameraHeatMaps(likelihood, A)


@compiled
def _clear(likelihood: Maps, here: FloatArray, there: FloatArray) -> None:
    """Zero what is nearer to ``there`` than to ``here``, (n_keypoints, 2) columns and rows."""
    n, rows, columns = likelihood.shape
    for m in range(n):
        x, y = there[m, 0] - here[m, 0], there[m, 1] - here[m, 1]
        if not np.isfinite(x * y):
            continue
        half = 0.5 * (x * (there[m, 0] + here[m, 0]) + y * (there[m, 1] + here[m, 1]))
        for i in range(rows):
            for j in range(columns):
                if x * j + y * i > half:
                    likelihood[m, i, j] = 0.0
