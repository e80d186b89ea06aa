"""Where keypoints are when nothing is known yet: from rays, or out of the whole volume. Compiled.

Step 3 of JP2020-042476A: of all pairs of cameras, the one whose rays through the centroids of a keypoint's
maps pass each other most closely, nearer than 20 mm; the keypoint is in the middle of their common
perpendicular. What rays leave open of the trunk is, by step 4, the cell of the volume with the largest summed
PCM.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gateway.frames import CameraHeatMaps, FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import cross, dot
from gateway.reconstruction.video.lattice import Lattices, Maps, View, add_likelihood, best_points
from gateway.reconstruction.video.projection import CameraModel, ray

NEAR_RAYS = 0.020
"""Largest distance of two rays that may meet in a keypoint, m."""
LEAST_LIKELIHOOD = 0.3
"""Of a map's highest value, under which its centroid says nothing."""
_NEIGHBOURHOOD = 2
"""Pixels about the highest value of which the centroid is taken."""
_PARALLEL = 0.1
"""Sine of the angle between two rays under which they do not tell depth."""
PERSON_RADIUS = 1.3
"""No keypoint of a person is farther than this from the median of all, m."""


@compiled
def centroids(maps: Maps) -> tuple[FloatArray, FloatArray]:
    """Return centroids (n_keypoints, 2), column and row, about the highest value; and that value
    (n_keypoints,)."""
    n, rows, columns = maps.shape
    places, peaks = np.full((n, 2), np.nan), np.zeros(n)
    for m in range(n):
        at = np.argmax(maps[m])
        top, left = at // columns, at % columns
        peaks[m] = maps[m, top, left]
        total, x, y = 0.0, 0.0, 0.0
        for i in range(max(0, top - _NEIGHBOURHOOD), min(rows, top + _NEIGHBOURHOOD + 1)):
            for j in range(max(0, left - _NEIGHBOURHOOD), min(columns, left + _NEIGHBOURHOOD + 1)):
                total += maps[m, i, j]
                x += maps[m, i, j] * j
                y += maps[m, i, j] * i
        if total > 0.0:
            places[m, 0], places[m, 1] = x / total, y / total
    return places, peaks


def rays_through(model: CameraModel, maps: CameraHeatMaps) -> tuple[FloatArray, FloatArray]:
    """Return unit directions (n_keypoints, 3), world axes, through the centroids of one camera's maps, and
    how high the maps are there (n_keypoints,)."""
    places, peaks = centroids(maps.likelihood)
    A = maps.map_from_pixel
    pixels = np.linalg.solve(A[:, :2], (places - A[:, 2]).T).T
    return np.stack([ray(model, u, v) for u, v in pixels]), peaks


@compiled
def closest_pair(
    positions: FloatArray, directions: FloatArray, peaks: FloatArray, farthest: float
) -> tuple[FloatArray, float]:
    """Return the midpoint (3,) of the shortest common perpendicular among all pairs of rays, and its length,
    m.

    positions, directions: (n_cameras, 3); peaks: (n_cameras,). NaN where no pair is nearer than ``farthest``.
    """
    best, point = farthest, np.full(3, np.nan)
    for a in range(len(positions)):
        for b in range(a + 1, len(positions)):
            if peaks[a] < LEAST_LIKELIHOOD or peaks[b] < LEAST_LIKELIHOOD:
                continue
            across = cross(directions[a], directions[b])
            square = dot(across, across)
            if square < _PARALLEL * _PARALLEL:
                continue
            between = positions[b] - positions[a]
            apart = abs(dot(between, across)) / np.sqrt(square)
            along_a = dot(cross(between, directions[b]), across) / square
            along_b = dot(cross(between, directions[a]), across) / square
            if apart < best and along_a > 0.0 and along_b > 0.0:
                best = apart
                point = 0.5 * (
                    positions[a] + along_a * directions[a] + positions[b] + along_b * directions[b]
                )
    return point, best


@compiled
def nearest_to_rays(positions: FloatArray, directions: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the point (3,) m with the least weighted sum of squared distances from rays (n_cameras, 3).

    NaN with fewer than
    two rays or parallel ones.
    """
    A, b, n = np.zeros((3, 3)), np.zeros(3), 0
    for c in range(len(positions)):
        if not weights[c] > 0.0:
            continue
        n += 1
        d = directions[c]
        along = dot(d, positions[c])
        for i in range(3):
            b[i] += weights[c] * (positions[c, i] - along * d[i])
            for j in range(3):
                A[i, j] += weights[c] * ((1.0 if i == j else 0.0) - d[i] * d[j])
    if n < 2 or np.linalg.det(A) < 1e-9:
        return np.full(3, np.nan)
    point: FloatArray = np.linalg.solve(A, b).astype(np.float64)
    return point


def from_rays(
    models: Sequence[CameraModel], maps: Sequence[CameraHeatMaps | None]
) -> tuple[FloatArray, FloatArray]:
    """Return keypoints (n_keypoints, 3) m and their summed peaks (n_keypoints,); NaN where rays do not
    meet."""
    chosen = [(model, seen) for model, seen in zip(models, maps, strict=True) if seen is not None]
    n = chosen[0][1].likelihood.shape[0] if chosen else 0
    points, likelihood = np.full((n, 3), np.nan), np.zeros(n)
    if len(chosen) < 2:
        return points, likelihood
    positions = np.stack([model.position for model, _ in chosen])
    found = [rays_through(model, seen) for model, seen in chosen]
    directions = np.stack([rays for rays, _ in found], axis=1)
    peaks = np.stack([peak for _, peak in found], axis=1)
    for m in range(n):
        points[m], _ = closest_pair(positions, directions[m], peaks[m], NEAR_RAYS)
        likelihood[m] = peaks[m].sum()
    return points, likelihood


def middle_of_views(models: Sequence[CameraModel], maps: Sequence[CameraHeatMaps | None]) -> FloatArray:
    """Return the point (3,) m nearest to the rays through the middles of the cameras' maps, where they look
    at somebody; NaN where rays are too few or parallel."""
    chosen = [(model, seen) for model, seen in zip(models, maps, strict=True) if seen is not None]
    directions = []
    for model, seen in chosen:
        _, rows, columns = seen.likelihood.shape
        A, middle = seen.map_from_pixel, np.array([(columns - 1) / 2, (rows - 1) / 2])
        directions.append(ray(model, *np.linalg.solve(A[:, :2], middle - A[:, 2])))
    positions = np.stack([model.position for model, _ in chosen])
    return nearest_to_rays(positions, np.stack(directions), np.ones(len(chosen)))


def from_volume(
    models: Sequence[CameraModel],
    maps: Sequence[CameraHeatMaps | None],
    centre: FloatArray,
    half_width: float,
    cell: float,
    is_wanted: NDArray[np.bool_],
) -> tuple[FloatArray, FloatArray]:
    """Return keypoints (n_keypoints, 3) m, and their summed PCM: the best cell of a cube of the volume.

    centre: (3,) m; half_width: of the cube, m; cell: its grid, m; is_wanted: (n_keypoints,); the others are
    NaN.
    """
    n = next(seen.likelihood.shape[0] for seen in maps if seen is not None)
    k = int(np.ceil(half_width / cell)) + 1  # the faces do not count
    centres, spacing = np.where(is_wanted[:, None], centre, np.nan), np.full(n, cell)
    total = np.zeros((n, (2 * k + 1) ** 3))
    for model, seen in zip(models, maps, strict=True):
        if seen is not None:
            view = View(model, seen.likelihood, seen.map_from_pixel)
            add_likelihood(total, view, Lattices(centres, spacing, k), False)
    return best_points(total, centres, spacing, k)


def within_person(points: FloatArray, sure: NDArray[np.bool_] | None = None) -> FloatArray:
    """Return keypoints (n_keypoints, 3) with those that cannot be of the same person as most taken out (NaN).

    The gate: within ``PERSON_RADIUS`` of the median, of those that are ``sure`` (n_keypoints,) where any are.
    A bystander that one camera pair agrees on is beyond.
    """
    known = points if sure is None else points[sure]
    if not np.isfinite(known).any():
        return points
    middle = np.nanmedian(known, axis=0)
    apart = np.linalg.norm(points - middle, axis=1)
    return np.where((apart < PERSON_RADIUS)[:, None], points, np.nan)
