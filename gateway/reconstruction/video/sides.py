"""Left and right that a network takes for each other in one camera, put back. Compiled.

From the side or from behind a network may call the left arm the right one for seconds, as sure of itself as
ever. The body as it goes on tells: where the maps of a pair are far likelier the other way round in one
camera, and all cameras together do not find so, the two maps are exchanged. If all together do, it is the
body that is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gateway.frames import CameraHeatMaps, FloatArray, IntArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.video.lattice import Maps, bilinear
from gateway.reconstruction.video.projection import CameraModel, pixel

_LIKELIER = 0.5
"""By which the sum of both maps must be higher the other way round, of 2."""


def pairs_of(names: Sequence[str]) -> IntArray:
    """Return (n_pairs, 2) rows of keypoints that are each other's left and right: left first."""
    mirrored = {name: name.replace("left", "right") for name in names if "left" in name}
    pairs = [(names.index(left), names.index(right)) for left, right in mirrored.items() if right in names]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def sides_put_right(
    models: Sequence[CameraModel],
    maps: Sequence[CameraHeatMaps | None],
    expected: FloatArray,
    pairs: IntArray,
) -> list[CameraHeatMaps | None]:
    """Return the maps with left and right exchanged where a camera has taken them for each other.

    expected: (n_keypoints, 3) m, where the body will have its keypoints; pairs: see ``pairs_of``.
    """
    gains = np.full((len(maps), len(pairs)), np.nan)
    for c, (model, seen) in enumerate(zip(models, maps, strict=True)):
        if seen is not None:
            gains[c] = _gains(model, seen.likelihood, seen.map_from_pixel, expected, pairs)
    crossed = (gains > _LIKELIER) & (np.nansum(gains, axis=0) < _LIKELIER)
    return [
        seen if seen is None or not rows.any() else _exchanged(seen, pairs[rows])
        for seen, rows in zip(maps, crossed, strict=True)
    ]


@compiled
def _gains(
    camera: CameraModel, maps: Maps, affine: FloatArray, expected: FloatArray, pairs: IntArray
) -> FloatArray:
    """Return (n_pairs,) by how much likelier a pair is the other way round."""
    gains = np.zeros(len(pairs))
    for n in range(len(pairs)):
        for side in range(2):
            own, other = pairs[n, side], pairs[n, 1 - side]
            u, v = pixel(camera, *_seen(camera, expected[own]))
            column = affine[0, 0] * u + affine[0, 1] * v + affine[0, 2]
            row = affine[1, 0] * u + affine[1, 1] * v + affine[1, 2]
            if np.isfinite(column + row):
                gains[n] += bilinear(maps[other], column, row) - bilinear(maps[own], column, row)
    return gains


@compiled
def _seen(camera: CameraModel, point: FloatArray) -> tuple[float, float, float]:
    """Return a point of the world (3,) m in camera axes."""
    R, t = camera.rotation, camera.translation
    x = R[0, 0] * point[0] + R[0, 1] * point[1] + R[0, 2] * point[2] + t[0]
    y = R[1, 0] * point[0] + R[1, 1] * point[1] + R[1, 2] * point[2] + t[1]
    z = R[2, 0] * point[0] + R[2, 1] * point[1] + R[2, 2] * point[2] + t[2]
    return x, y, z


def _exchanged(seen: CameraHeatMaps, pairs: IntArray) -> CameraHeatMaps:
    likelihood = seen.likelihood.copy()
    likelihood[pairs[:, 0]], likelihood[pairs[:, 1]] = (
        seen.likelihood[pairs[:, 1]],
        seen.likelihood[pairs[:, 0]],
    )
    return CameraHeatMaps(likelihood, seen.map_from_pixel)
