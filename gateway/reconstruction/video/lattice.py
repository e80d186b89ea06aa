"""Candidates for keypoints: lattices of points, and how likely all cameras together find each. Compiled.

Step 4 of JP2020-042476A: around where keypoint n is expected stand (2 k + 1)³ points with spacing s. Every
point is projected into all cameras, the values of the part confidence maps (PCM) there are added, and the
middle of the 7-point cluster (a point and its six neighbours) with the largest sum is the candidate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.video.projection import CameraModel

Maps = NDArray[np.float32]
_NEARER = 0.01
"""Summed PCM by which the middle of a face may be likelier than that of the lattice, without being taken."""


class View(NamedTuple):
    """What one camera sees."""

    camera: CameraModel
    maps: Maps  # (n_keypoints, rows, columns)
    affine: FloatArray  # (2, 3) pixel of the distorted picture to column and row


class Lattices(NamedTuple):
    """A lattice of points for each keypoint."""

    centres: FloatArray  # (n_keypoints, 3) m; NaN: none
    spacing: FloatArray  # (n_keypoints,) m
    k: int
    """Points to either side of the middle."""


@compiled
def bilinear(values: Maps, column: float, row: float) -> float:
    """Return a map (rows, columns) between its values; 0 outside it."""
    rows, columns = values.shape
    if not (0.0 <= column <= columns - 1.0 and 0.0 <= row <= rows - 1.0):
        return 0.0
    i, j = min(int(row), rows - 2), min(int(column), columns - 2)
    a, b = column - j, row - i
    upper = (1.0 - a) * values[i, j] + a * values[i, j + 1]
    lower = (1.0 - a) * values[i + 1, j] + a * values[i + 1, j + 1]
    value: float = (1.0 - b) * upper + b * lower
    return value


@compiled
def smooth(values: Maps, column: float, row: float) -> float:
    """Return a map (rows, columns) under a quadratic B-spline, nine values wide; 0 outside it.

    Bilinear values have their maxima at the middles of cells, which are centimetres apart: the fine lattice
    would follow the cells.
    """
    rows, columns = values.shape
    if not (1.0 <= column <= columns - 2.0 and 1.0 <= row <= rows - 2.0):
        return bilinear(values, column, row)
    i, j = int(row + 0.5), int(column + 0.5)
    a, b = column - j, row - i
    left, middle, right = 0.5 * (0.5 - a) ** 2, 0.75 - a * a, 0.5 * (0.5 + a) ** 2
    above = left * values[i - 1, j - 1] + middle * values[i - 1, j] + right * values[i - 1, j + 1]
    here = left * values[i, j - 1] + middle * values[i, j] + right * values[i, j + 1]
    below = left * values[i + 1, j - 1] + middle * values[i + 1, j] + right * values[i + 1, j + 1]
    value: float = 0.5 * (0.5 - b) ** 2 * above + (0.75 - b * b) * here + 0.5 * (0.5 + b) ** 2 * below
    return value


@compiled
def add_likelihood(total: FloatArray, view: View, lattices: Lattices, is_fine: bool) -> None:
    """Add what one camera says to the likelihoods of all lattices.

    total: (n_keypoints, (2 k + 1)³), x slowest, changed. is_fine: by ``smooth`` values, else ``bilinear``
    ones.
    """
    maps, R = view.maps, view.camera.rotation
    centres, spacing, k = lattices.centres, lattices.spacing, lattices.k
    n = 2 * k + 1
    columns, rows = np.empty(n), np.empty(n)
    for m in range(len(centres)):
        if not np.isfinite(centres[m, 0]):
            continue
        s, values = spacing[m], maps[m]
        start = view.camera.translation.copy()
        for i in range(3):
            for j in range(3):
                start[i] += R[i, j] * (centres[m, j] - k * s)
        at = 0
        for a in range(n):
            for b in range(n):
                x = start[0] + s * (a * R[0, 0] + b * R[0, 1])
                y = start[1] + s * (a * R[1, 0] + b * R[1, 1])
                z = start[2] + s * (a * R[2, 0] + b * R[2, 1])
                _cells_of_line(columns, rows, view, (x, y, z), s)
                for c in range(n):
                    if is_fine:
                        total[m, at] += smooth(values, columns[c], rows[c])
                    else:
                        total[m, at] += bilinear(values, columns[c], rows[c])
                    at += 1


@compiled
def _cells_of_line(
    columns: FloatArray, rows: FloatArray, view: View, first: tuple[float, float, float], spacing: float
) -> None:
    """Find the columns and rows (n,), changed, of n points in a line along the world's z axis.

    first: in camera axes, m. The steps are those of ``projection.pixel`` and of the affine, without a branch
    and with every constant at hand, so that the points of a line are computed together.
    """
    k, d, A, R = view.camera.matrix, view.camera.distortion, view.affine, view.camera.rotation
    k00, k01, k02, k11, k12 = k[0, 0], k[0, 1], k[0, 2], k[1, 1], k[1, 2]
    d0, d1, d2, d3, d4 = d[0], d[1], d[2], d[3], d[4]
    a00, a01, a02, a10, a11, a12 = A[0, 0], A[0, 1], A[0, 2], A[1, 0], A[1, 1], A[1, 2]
    r02, r12, r22 = R[0, 2], R[1, 2], R[2, 2]
    x0, y0, z0 = first
    for c in range(len(columns)):
        depth = z0 + spacing * c * r22
        x, y = (x0 + spacing * c * r02) / depth, (y0 + spacing * c * r12) / depth
        square = x * x + y * y
        radial = 1.0 + square * (d0 + square * (d1 + square * d4))
        u = x * radial + 2.0 * d2 * x * y + d3 * (square + 2.0 * x * x)
        v = y * radial + d2 * (square + 2.0 * y * y) + 2.0 * d3 * x * y
        u, v = k00 * u + k01 * v + k02, k11 * v + k12
        columns[c] = a00 * u + a01 * v + a02 if depth > 0.0 else np.nan
        rows[c] = a10 * u + a11 * v + a12


@compiled
def best_points(
    total: FloatArray, centres: FloatArray, spacing: FloatArray, k: int
) -> tuple[FloatArray, FloatArray]:
    """Return the candidates (n_keypoints, 3) m of lattices, and their summed PCM (n_keypoints,).

    The sum over a point and its six neighbours counts, so that only inner points do. Between the points of
    the lattice the maximum is that of a parabola along each axis. Of points as likely as each
    other, such as those along one camera's ray, the one nearest the middle is taken (``_NEARER``).
    """
    n = 2 * k + 1
    found = np.full((len(centres), 3), np.nan)
    likelihood = np.zeros(len(centres))
    for m in range(len(centres)):
        if not np.isfinite(centres[m, 0]):
            continue
        score = _clustered(_nearer_preferred(total[m].reshape((n, n, n)), k))
        at = int(np.argmax(score))
        place = (at // (n * n), at // n % n, at % n)
        likelihood[m] = total[m, at]
        for i in range(3):
            beyond = _vertex(score, place, i, n)
            found[m, i] = centres[m, i] + (place[i] - k + beyond) * spacing[m]
    return found, likelihood


@compiled
def _nearer_preferred(total: FloatArray, k: int) -> FloatArray:
    """Return sums (n, n, n) less what being away from the middle costs."""
    score = total.copy()
    for a in range(len(score)):
        for b in range(len(score)):
            for c in range(len(score)):
                score[a, b, c] -= _NEARER * ((a - k) ** 2 + (b - k) ** 2 + (c - k) ** 2) / (k * k)
    return score


@compiled
def _clustered(score: FloatArray) -> FloatArray:
    """Return sums over a point and its six neighbours; minus infinity on the faces of the lattice."""
    n = len(score)
    sums = np.full((n, n, n), -np.inf)
    for a in range(1, n - 1):
        for b in range(1, n - 1):
            for c in range(1, n - 1):
                sums[a, b, c] = (
                    score[a, b, c]
                    + score[a - 1, b, c] + score[a + 1, b, c]
                    + score[a, b - 1, c] + score[a, b + 1, c]
                    + score[a, b, c - 1] + score[a, b, c + 1]
                )  # fmt: skip
    return sums


@compiled
def _vertex(score: FloatArray, place: tuple[int, int, int], axis: int, n: int) -> float:
    """Return where the parabola through a maximum and its neighbours along one axis is highest, -0.5 to
    0.5."""
    if not 0 < place[axis] < n - 1:
        return 0.0
    a, b, c = place
    here = score[a, b, c]
    before = score[a - (axis == 0), b - (axis == 1), c - (axis == 2)]
    after = score[a + (axis == 0), b + (axis == 1), c + (axis == 2)]
    bend = before - 2.0 * here + after
    if not (np.isfinite(bend) and bend < 0.0):
        return 0.0
    vertex: float = 0.5 * (before - after) / bend
    return vertex
