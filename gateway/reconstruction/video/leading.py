"""Cameras led by poses: each is told where the people will be in its pictures to come.

Step 7 of JP2020-042476A. A camera that follows by itself leaves a person for whoever passes in front; one
that is told where the pose goes does not. Of two cameras side by side one looks at both pictures put together
where somebody is partly in either.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from devices.cameras.orders import Joined, Square, encode_orders
from gateway.body.camera import Camera, project
from gateway.frames import FloatArray
from gateway.reconstruction.video.region import person_region, square_of

WHOLE = 0.97
"""Share of the keypoints in a picture, from which nothing is missing in it."""
_LEAST_GAIN = 0.06
"""Share of the keypoints that the second camera must add."""
_FEWEST = 6
"""Keypoints from which an affine map follows."""

Pairs = Sequence[tuple[int, int]]
"""Cameras side by side, by their place in the order."""


class Leading:
    """Makes the orders for the cameras of a capture."""

    def __init__(self, cameras: Sequence[Camera], names: Sequence[str], pairs: Pairs = ()) -> None:
        """Lead cameras. names: of the keypoints. pairs: cameras whose pictures may be put together."""
        self._cameras, self._names = cameras, names
        self._partner = dict(pairs) | {b: a for a, b in pairs}

    def orders(self, sequence: int, people: Mapping[int, FloatArray]) -> bytes:
        """Return a line for all cameras. sequence: of the picture that it is for; people: by number the
        keypoints (n_keypoints, 3) m that they will have then."""
        squares: dict[str, dict[int, Square | None]] = {camera.name: {} for camera in self._cameras}
        joined: dict[str, dict[int, Joined]] = {}
        for number, points in people.items():
            for camera in self._cameras:
                region = person_region(camera, points, self._names)
                squares[camera.name][number] = square_of(region)
            for row, neighbour, square, affine in self._put_together(points):
                first, second = self._cameras[row].name, self._cameras[neighbour].name
                squares[first][number], squares[second][number] = square, None
                joined.setdefault(first, {})[number] = Joined(second, tuple(affine.ravel().tolist()))
        return encode_orders(sequence, squares, joined)

    def _put_together(self, points: FloatArray) -> list[tuple[int, int, Square, FloatArray]]:
        """Return of each pair that sees the person in both pictures who looks, its neighbour, where it
        looks, and the neighbour's pixels to its own, (2, 3)."""
        found: list[tuple[int, int, Square, FloatArray]] = []
        done: set[int] = set()
        for row, neighbour in self._partner.items():
            if row in done:
                continue
            affine = joining(self._cameras[row], self._cameras[neighbour], points)
            square = square_of(person_region(self._cameras[row], points, self._names, must_see=False))
            if affine is not None and square is not None:
                found.append((row, neighbour, square, affine))
                done |= {row, neighbour}
        return found


def in_picture(camera: Camera, pixels: FloatArray) -> NDArray[np.bool_]:
    """Return (n,) whether pixels (n, 2) lie in the camera's picture; NaN does not."""
    with np.errstate(invalid="ignore"):
        inside = (pixels >= 0) & (pixels <= (camera.width - 1, camera.height - 1))
    return np.asarray(inside.all(axis=1), dtype=np.bool_)


def joining(first: Camera, second: Camera, keypoints: FloatArray) -> FloatArray | None:
    """Return (2, 3) pixel of the second camera to pixel of the first, about a person with keypoints (n, 3) m.

    None where the first sees all of the person, or the second adds too little.
    """
    here, there = project(first, keypoints), project(second, keypoints)
    inside, beside = in_picture(first, here), in_picture(second, there)
    if inside.mean() >= WHOLE or (beside & ~inside).mean() < _LEAST_GAIN:
        return None
    known = np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1)
    if known.sum() < _FEWEST:
        return None
    given = np.column_stack([there[known], np.ones(known.sum())])
    solution, _, rank, _ = np.linalg.lstsq(given, here[known], rcond=None)
    return np.ascontiguousarray(solution.T) if rank == 3 else None
