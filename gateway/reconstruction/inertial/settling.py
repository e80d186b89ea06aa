"""Where a module is that is back after a gap: from all that it has said since, and what was known before.

Its gyrometers carry every sample since into one frame, that of the return; how this frame i stands in the
world does not change any more. Three things tell: the mean specific force there, which is gravity but for the
velocity gained meanwhile; the mean magnetic field, if its inclination is known; and the orientation before
the gap. Each counts by how uncertain it is, and the orientation that all of them together make likeliest is
the eigenvector of a symmetric 4 × 4 matrix (Davenport's q-method: Markley & Mortari, J. Astronaut. Sci. 48,
2000; a prior rotation adds its own outer product).

Unlike a filter that begins anew and corrects heading and inclination one after the other, no sample is ever
judged by what the inclination seemed to be when it came.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, is_finite, norm, vector

SETTLED_S = 3.0
"""So long is what VQF averages the specific force over."""
FIRST_ERROR = 0.75
"""Error of one specific force as a plumb line over the acceleration's root mean square, over gravity."""
PLAIN_S, TAPERED_S = 0.35, 0.6
"""The plain mean's error falls with 1 / (1 + t/PLAIN_S), the tapered one's with 1 / (1 + (t/TAPERED_S)²)."""
TAPER_FROM_S, TAPER_AT_S = 1.0, 1.5
"""From the one mean to the other: by then the taper spans the slowest swings of a walk."""
LEAST_SWING = 0.3
"""m/s²."""
LEAST_TILT = 0.02
"""rad."""
FIELD_ERROR = 0.08
"""rad, of the magnetic field's direction from place to place within a room."""
OTHER_FIELD = 0.1
"""Share by which the field's norm differs where it is another field (as in VQF)."""
_SQUARINGS = 20


class Before(NamedTuple):
    """What is known of a module when it comes back."""

    q_wi: FloatArray  # (4,) as expected
    sigma: float
    """rad about an axis, of that."""
    swing: float
    """m/s²: root mean square of what the specific force's norm was off gravity."""
    field_norm: float
    """µT; 0: not known."""
    dip: float
    """rad, inclination of the field."""
    gravity: float
    """m/s²."""


class Since(NamedTuple):
    """Sums over the samples since, frame i; changed in place."""

    force: FloatArray  # (3, 3) Σ f, Σ t f, Σ t² f
    field: FloatArray  # (3,) Σ m
    squares: FloatArray  # (2,) Σ |f|², Σ |m|
    seconds: FloatArray  # (2,) of specific forces, of fields


def nothing_since() -> Since:
    """At the return."""
    return Since(np.zeros((3, 3)), np.zeros(3), np.zeros(2), np.zeros(2))


@compiled
def settle(
    before: Before, since: Since, q_is: FloatArray, f: FloatArray, x: FloatArray, dt: float
) -> tuple[FloatArray, float]:
    """One more sample; q_wi (4,), and its standard deviation about the axis known worst, rad.

    q_is: (4,) by the gyrometers. f, x: (3,) specific force and field, NaN where there is none. dt: s."""
    if is_finite(f):
        t = since.seconds[0] + 0.5 * dt
        f_i = quaternion.rotate(q_is, f)
        since.force[0] += f_i
        since.force[1] += t * f_i
        since.force[2] += t * t * f_i
        since.squares[0] += dot(f, f)
        since.seconds[0] += dt
    if is_finite(x):
        since.field[:] += quaternion.rotate(q_is, x)
        since.squares[1] += norm(x)
        since.seconds[1] += dt
    return _likeliest(before, since, dt)


@compiled
def _likeliest(before: Before, since: Since, dt: float) -> tuple[FloatArray, float]:
    matrix = np.zeros((4, 4))
    weight = 1.0 / before.sigma**2
    for i in range(4):
        for j in range(4):
            matrix[i, j] = 2.0 * weight * before.q_wi[i] * before.q_wi[j]
    total, up = 2.0 * weight, vector(0.0, 0.0, 0.0)
    tilt_weight, field_weight = 0.0, 0.0
    if since.seconds[0] > 0.0:
        up, sigma = _up(before, since, dt)
        tilt_weight = 1.0 / sigma**2
        _add_pair(matrix, tilt_weight, up, vector(0.0, 0.0, 1.0))
    strength = since.squares[1] * dt / since.seconds[1] if since.seconds[1] > 0.0 else 0.0
    knows_dip = abs(strength - before.field_norm) < OTHER_FIELD * before.field_norm
    if norm(since.field) > 0.0 and (knows_dip or tilt_weight > 0.0):
        field = since.field / norm(since.field)
        sine = -dot(up, field)
        # one that is not known tells the heading only
        dip = before.dip if knows_dip else math.asin(max(-1.0, min(1.0, sine)))
        field_weight = 1.0 / FIELD_ERROR**2
        _add_pair(matrix, field_weight, field, vector(0.0, math.cos(dip), -math.sin(dip)))
        apart = max(0.0, 1.0 - sine**2)
        weight += apart * min(tilt_weight, field_weight)
    total += tilt_weight + field_weight
    return _dominant(matrix, total), 1.0 / math.sqrt(weight)


@compiled
def _up(before: Before, since: Since, dt: float) -> tuple[FloatArray, float]:
    """Mean specific force in frame i, unit (3,), and how far it is from the vertical, rad.

    Velocities are bounded, so a plain mean errs by (v₁ − v₀) / t; one that fades in and out (6 s (1 − s), s
    from 0 to 1) leaves less of what swings, once it spans a swing."""
    t = since.seconds[0]
    n = t / dt
    mean = since.force[0] / n
    scatter = max(0.0, since.squares[0] / n - dot(mean, mean))
    acceleration = math.sqrt(max(scatter, 3.0 * max(before.swing, LEAST_SWING) ** 2))
    error = 1.0 / (1.0 + t / PLAIN_S)
    share = min(1.0, max(0.0, (t - TAPER_FROM_S) / (TAPER_AT_S - TAPER_FROM_S)))
    if share > 0.0:
        tapered = 6.0 * (since.force[1] / t - since.force[2] / t**2) / n
        mean = (1.0 - share) * mean + share * tapered
        error = (1.0 - share) * error + share / (1.0 + (t / TAPERED_S) ** 2)
    sigma = math.sqrt((FIRST_ERROR * acceleration / before.gravity * error) ** 2 + LEAST_TILT**2)
    length = norm(mean)
    return mean / length if length > 0.0 else mean, sigma


@compiled
def _add_pair(matrix: FloatArray, weight: float, b: FloatArray, r: FloatArray) -> None:
    """Add what makes qᵀ K q the weighted cosine between r and b turned by q; b, r: (3,) unit."""
    trace = weight * dot(b, r)
    matrix[0, 0] += trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        across = weight * (b[j] * r[k] - b[k] * r[j])
        matrix[0, 1 + i] += across
        matrix[1 + i, 0] += across
        matrix[1 + i, 1 + i] += 2.0 * weight * b[i] * r[i] - trace
        both = weight * (b[i] * r[j] + b[j] * r[i])
        matrix[1 + i, 1 + j] += both
        matrix[1 + j, 1 + i] += both


@compiled
def _dominant(matrix: FloatArray, bound: float) -> FloatArray:
    """Unit eigenvector of the largest eigenvalue of a symmetric (4, 4) matrix, none of which is below -bound.

    By squaring it again and again, made positive: what is largest outgrows the rest."""
    power = matrix + bound * np.eye(4)
    squared = np.empty((4, 4))
    for _ in range(_SQUARINGS):
        scale = power[0, 0] + power[1, 1] + power[2, 2] + power[3, 3]
        for i in range(4):
            for j in range(4):
                entry = 0.0
                for k in range(4):
                    entry += power[i, k] * power[k, j]
                squared[i, j] = entry / scale**2
        power[:] = squared
    best = 0
    for i in range(1, 4):
        if power[i, i] > power[best, best]:
            best = i
    return quaternion.normalise(power[best].copy())
