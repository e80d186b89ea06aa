"""Points of the body from markers: joint centres by published rules. Arrays (F, 3), m; NaN carries on.

A rule is a function of points and lengths. Marker-set files name them (``marker_set``), so that another
set of markers, an animal or a robot needs another file and no other program.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gateway.frames import FloatArray


def unit(vectors: FloatArray) -> FloatArray:
    """Return vectors of length one; NaN where the length is zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        scaled: FloatArray = np.where(length > 0, vectors / length, np.nan)
    return scaled


def _mean_length(vectors: FloatArray) -> float:
    """Return the mean length of the vectors (n, 3) that are known; NaN where none is."""
    lengths = np.linalg.norm(vectors, axis=-1)
    known = np.isfinite(lengths)
    return float(lengths[known].mean()) if known.any() else np.nan


def midpoint(points: Sequence[FloatArray]) -> FloatArray:
    """Return the mean of points: of two, the middle between them."""
    mean: FloatArray = np.mean(np.stack(points), axis=0)
    return mean


def between(start: FloatArray, end: FloatArray, fraction: float) -> FloatArray:
    """Return the point at a fraction of the way."""
    return start + fraction * (end - start)


def shifted(point: FloatArray, start: FloatArray, end: FloatArray, by: float) -> FloatArray:
    """Return the point moved by ``by`` m in the direction from start to end."""
    return point + by * unit(end - start)


def perpendicular(
    point: FloatArray, first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray], by: float
) -> FloatArray:
    """Return the point moved by ``by`` m across two lines, each from its first point to its second
    (right-handed)."""
    across = unit(np.cross(unit(first[1] - first[0]), unit(second[1] - second[0])))
    moved: FloatArray = point + by * across
    return moved


def chord(
    proximal: FloatArray, marker: FloatArray, plane: FloatArray, distance: float, wand_angle: float = 0.0
) -> FloatArray:
    """Return the joint centre ``distance`` m from a marker on its side, by the chord function of
    Plug-in-Gait.

    Proximal joint centre, marker and sought centre c make a right angle at c, in the plane through the third
    point, on the other side than that: Davis et al. 1991 (Hum. Mov. Sci. 10: 575–587), Kadaba et al. 1990
    (J. Orthop. Res. 8: 383–392). NaN where the marker is nearer than ``distance`` to the proximal joint.

    wand_angle: rad, by which the third point is turned from that plane, about the line from the centre to the
    proximal joint (right-handed, from the marker to the third point); NaN where none of the centres does it.
    """
    along = proximal - marker
    length = np.linalg.norm(along, axis=-1, keepdims=True)
    direction = unit(along)
    side = plane - marker
    across = unit(side - np.sum(side * direction, axis=-1, keepdims=True) * direction)
    with np.errstate(invalid="ignore"):
        cosine = distance / length
        sine = np.sqrt(1.0 - cosine**2)
        to_centre = np.arcsin(cosine)
    if wand_angle:
        turn = _chord_turn(proximal, marker, plane, to_centre, wand_angle)
        across = np.cos(turn) * across + np.sin(turn) * np.cross(across, direction)
    centre: FloatArray = marker + distance * (cosine * direction - sine * across)
    return centre


def _chord_turn(
    proximal: FloatArray, marker: FloatArray, plane: FloatArray, to_centre: FloatArray, wand_angle: float
) -> FloatArray:
    """Return by how much the centre goes round the line from marker to proximal joint, (F, 1) rad, for a wand
    out of the plane.

    Seen from the proximal joint, centre, marker and wand are the corners of a spherical triangle: two sides
    and the angle at the centre are known. Law of sines, then Napier's analogy; of two triangles the one that
    goes over into the plane.

    to_centre: (F, 1) rad, the side from the marker to the centre.
    """
    to_marker, to_wand = unit(marker - proximal), unit(plane - proximal)
    apart = np.arctan2(
        np.linalg.norm(np.cross(to_marker, to_wand), axis=-1, keepdims=True),
        np.sum(to_marker * to_wand, axis=-1, keepdims=True),
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        at_wand = np.arcsin(np.sin(wand_angle) * np.sin(to_centre) / np.sin(apart))
    turn: FloatArray = 2.0 * np.arctan2(
        np.tan(0.5 * (wand_angle + at_wand)) * np.cos(0.5 * (apart + to_centre)),
        np.cos(0.5 * (apart - to_centre)),
    )
    return turn


def davis_hip(
    asis: tuple[FloatArray, FloatArray],
    sacrum: FloatArray,
    legs: tuple[float, float],
    marker_radius: float,
    side: str,
    measured: tuple[float, float] | None = None,
) -> FloatArray:
    """Return the hip's centre from pelvis width and leg length: Davis et al. 1991, with the distance of
    trochanter and ASIS by leg length as Plug-in-Gait has it (0.1288 L − 48.56 mm).

    asis: left, right. legs: lengths of this side's leg and the other's, m. measured: distance of both ASIS,
    and of this side's ASIS and trochanter, m; None: the first is the markers' mean over the trial, the second
    follows from the leg.
    """
    left, right = asis
    if measured is None:
        width = _mean_length(left - right)
        measured = width, 0.1288 * legs[0] - 0.04856
    theta, beta = 0.5, 0.314  # rad, of 25 hip studies
    c = 0.115 * 0.5 * (legs[0] + legs[1]) - 0.0153
    depth = measured[1] + marker_radius
    ahead = c * np.cos(theta) * np.sin(beta) - depth * np.cos(beta)
    aside = 0.5 * measured[0] - c * np.sin(theta)
    up = -c * np.cos(theta) * np.cos(beta) - depth * np.sin(beta)
    return _in_pelvis(asis, sacrum, side, ahead, aside, up)


def harrington_hip(asis: tuple[FloatArray, FloatArray], sacrum: FloatArray, side: str) -> FloatArray:
    """Return the hip's centre from width and depth of the pelvis: Harrington et al. 2007 (J. Biomech. 40:
    595–602), the equations of one predictor each (mm): −0.24 PD − 9.9; −0.30 PW − 10.9; 0.33 PW + 7.3.
    """
    left, right = asis
    depth = _mean_length(midpoint(asis) - sacrum)
    width = _mean_length(right - left)
    ahead, aside, up = -0.24 * depth - 0.0099, 0.33 * width + 0.0073, -0.30 * width - 0.0109
    return _in_pelvis(asis, sacrum, side, ahead, aside, up)


def hara_hip(asis: tuple[FloatArray, FloatArray], sacrum: FloatArray, leg: float, side: str) -> FloatArray:
    """Return the hip's centre from the leg's length L alone: Hara et al. 2016 (Sci. Rep. 6: 37707), 180
    persons of 5 to 40 years (mm): 11 − 0.063 L ahead, 8 + 0.086 L aside, −9 − 0.078 L up.
    """
    ahead, aside, up = 0.011 - 0.063 * leg, 0.008 + 0.086 * leg, -0.009 - 0.078 * leg
    return _in_pelvis(asis, sacrum, side, ahead, aside, up)


def _in_pelvis(
    asis: tuple[FloatArray, FloatArray], sacrum: FloatArray, side: str, ahead: float, aside: float, up: float
) -> FloatArray:
    """Return the point so far, m, ahead of the middle of both ASIS, to the side, and up, in the
    pelvis' axes."""
    middle = midpoint(asis)
    to_right = unit(asis[1] - asis[0])
    forward = middle - sacrum
    forward = unit(forward - np.sum(forward * to_right, axis=-1, keepdims=True) * to_right)
    sign = 1.0 if side == "right" else -1.0
    point: FloatArray = middle + ahead * forward + sign * aside * to_right + up * np.cross(to_right, forward)
    return point


def scaled_offset(
    origin: FloatArray, axes: FloatArray, fractions: Sequence[float], ends: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Return a point at fractions of a length, along a segment's axes (F, 3, 3): regressions on a body's
    width."""
    length = _mean_length(ends[1] - ends[0])
    point: FloatArray = origin + length * (axes @ np.asarray(fractions, dtype=np.float64))
    return point


def below_line(point: FloatArray, line: tuple[FloatArray, FloatArray], fraction: float) -> FloatArray:
    """Return the point moved down, across a line, by a fraction of the line's length.

    The shoulder of CN1766831A: a tenth of the shoulder width below the marker. Down is against world z.
    """
    along = line[1] - line[0]
    direction = unit(along)
    down = np.array([0.0, 0.0, -1.0])
    across = unit(down - np.sum(down * direction, axis=-1, keepdims=True) * direction)
    moved: FloatArray = point + fraction * np.linalg.norm(along, axis=-1, keepdims=True) * across
    return moved


def right_triangle(
    proximal: FloatArray, marker: FloatArray, distal: FloatArray, half_width: float, side: str
) -> FloatArray:
    """Return the centre beside a marker, half the joint's width away, at a right angle to the line to the
    proximal joint.

    The elbow, knee and ankle of CN1766831A: marker, centre and proximal joint make a right-angled triangle in
    the plane across the two bones that meet there. As ``chord``, with that plane's normal in place of a wand.

    side: left or right, of a joint that bends forward; the other one for a knee. The marker is lateral.
    """
    # Both sides bend forward about an axis to the right, which is outwards on the right side alone.
    to_right = np.cross(unit(marker - proximal), unit(distal - marker))
    return chord(proximal, marker, marker + (to_right if side == "right" else -to_right), half_width)


def frame_axes(
    primary: tuple[str, FloatArray, FloatArray], secondary: tuple[str, FloatArray, FloatArray]
) -> FloatArray:
    """Return axes (F, 3, 3) of a segment, columns x y z: one along a line, one as near another line as it can
    be.

    Each is the axis' name (x, y or z) and the two points it runs between.
    """
    first, second = "xyz".index(primary[0]), "xyz".index(secondary[0])
    third = 3 - first - second
    a = unit(primary[2] - primary[1])
    b = secondary[2] - secondary[1]
    b = unit(b - np.sum(b * a, axis=-1, keepdims=True) * a)
    c = np.cross(a, b)
    if (second - first) % 3 == 2:
        c = -c
    axes = np.empty((*a.shape, 3))
    axes[..., first], axes[..., second], axes[..., third] = a, b, c
    return axes
