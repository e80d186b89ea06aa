"""Axes of functional movements, from angular rates alone.

One segment that turns to and fro: the direction of most of its angular rate, by principal components
(Luinge, Veltink & Baten 2007, J. Biomech. 40(1): 78–85, for the elbow's axes; Favre et al. 2009, J. Biomech.
42(14): 2330–2335). Two segments joined by a hinge: the axes j₁, j₂ in both sensors' coordinates, for which
‖ω₁ × j₁‖ = ‖ω₂ × j₂‖ at all times (Seel, Schauer & Raisch 2012, IEEE CCA: 219–224; Seel, Raisch & Schauer
2014, Sensors 14(4): 6891–6909), by Gauss–Newton from several starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from devices.deferred import least_squares
from gateway.frames import FloatArray

_SLOW = np.radians(10.0)
_HINGE_SAMPLES = 400


@dataclass(frozen=True, eq=False)
class MovementAxis:
    """What a segment turned about."""

    axis: FloatArray
    """(3,) unit, sensor axes; the turn it sets out with is positive about it."""
    range_rad: float
    """From the least to the largest angle about it."""
    spread_rad: float
    """Angle between the axes of the first and the second half of the movement, wherever in the step that
    lies: nobody begins at once."""
    share: float
    """Of the squared angular rate, that about the axis: 1 for a pure rotation."""


def movement_axis(angular_rate: FloatArray, interval_s: float) -> MovementAxis | None:
    """Return the axis of a to-and-fro movement; angular_rate (n, 3) rad/s. None when nothing turned at
    all."""
    moving = np.linalg.norm(angular_rate, axis=1) > _SLOW
    if moving.sum() < 10:
        return None
    axis, share = _principal(angular_rate[moving])
    angle = np.cumsum(angular_rate @ axis) * interval_s
    if angle.mean() < 0.0:
        axis, angle = -axis, -angle
    spread = np.pi / 2
    if moving.sum() >= 20:
        first, second = (_principal(half)[0] for half in np.array_split(angular_rate[moving], 2))
        spread = float(np.arccos(min(abs(float(first @ second)), 1.0)))
    return MovementAxis(axis, float(np.ptp(angle)), spread, share)


def _principal(rates: FloatArray) -> tuple[FloatArray, float]:
    values, vectors = np.linalg.eigh(rates.T @ rates)
    axis: FloatArray = np.ascontiguousarray(vectors[:, -1])
    return axis, float(values[-1] / values.sum())


@dataclass(frozen=True, eq=False)
class HingeAxes:
    """The axis of a hinge joint, seen by the modules on both sides. The two signs go together."""

    first: FloatArray  # (3,) unit, axes of the first sensor
    second: FloatArray  # (3,) unit, axes of the second sensor
    residual: float
    """RMS of ‖ω₁ × j₁‖ − ‖ω₂ × j₂‖, rad/s."""


def hinge_axes(first_rate: FloatArray, second_rate: FloatArray, interval_s: float) -> HingeAxes:
    """Return axes of a hinge between two modules, whatever else both do; rates (n, 3) rad/s.

    Raises ``ValueError`` when they hardly turn against each other or otherwise.
    """
    turning = np.linalg.norm(first_rate, axis=1) + np.linalg.norm(second_rate, axis=1) > 2.0 * _SLOW
    if turning.sum() < 20:
        raise ValueError("the two segments hardly turned: bend and stretch the joint a few times")
    rows = np.flatnonzero(turning)
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _HINGE_SAMPLES)).round().astype(np.int64)]
    w1, w2 = first_rate[rows], second_rate[rows]
    starts = [np.concatenate([a, b]) for a, b in product(_STARTS, _STARTS)]
    best = min((_refined(w1, w2, start) for start in starts), key=lambda found: found.residual)
    return _signs_matched(best, first_rate, second_rate, interval_s)


_STARTS = [np.array(start) for start in ((0.1, 0.1), (1.5, 0.1), (0.1, 1.5))]


def _refined(w1: FloatArray, w2: FloatArray, start: FloatArray) -> HingeAxes:
    def residuals(p: FloatArray) -> FloatArray:
        difference: FloatArray = _across(w1, _direction(p[:2])) - _across(w2, _direction(p[2:]))
        return difference

    solved = least_squares(residuals, start, max_nfev=30, loss="soft_l1", f_scale=0.2)
    rms = float(np.sqrt(np.mean(residuals(solved.x) ** 2)))
    return HingeAxes(_direction(solved.x[:2]), _direction(solved.x[2:]), rms)


def _direction(p: FloatArray) -> FloatArray:
    """Return inclination and azimuth as a unit vector."""
    c = np.cos(p[0])
    return np.array([c * np.cos(p[1]), c * np.sin(p[1]), np.sin(p[0])])


def _across(rates: FloatArray, axis: FloatArray) -> FloatArray:
    lengths: FloatArray = np.linalg.norm(np.cross(rates, axis), axis=1)
    return lengths


def _signs_matched(found: HingeAxes, w1: FloatArray, w2: FloatArray, interval_s: float) -> HingeAxes:
    """Return the axes with the sign of the second that fits.

    Across the axis both segments see the same vector, turned by the joint's angle. With the right sign that
    angle changes as the rates about the axes differ.
    """
    coherence = []
    for sign in (1.0, -1.0):
        second = sign * found.second
        bend = np.cumsum(w1 @ found.first - w2 @ second) * interval_s
        angle = _angle_across(w1, found.first) - _angle_across(w2, second) + bend
        weight = _across(w1, found.first) * _across(w2, second)
        # The phasor adds up where angle and rates agree, and averages out for the wrong sign.
        coherence.append(abs(np.sum(weight * np.exp(1j * angle))))
    return found if coherence[0] >= coherence[1] else HingeAxes(found.first, -found.second, found.residual)


def _angle_across(rates: FloatArray, axis: FloatArray) -> FloatArray:
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x /= np.linalg.norm(x)
    angle: FloatArray = np.arctan2(rates @ np.cross(axis, x), rates @ x)
    return angle
