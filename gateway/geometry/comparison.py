"""How far estimated orientations are from a reference: total, inclination and heading errors.

Inclination is the error of the direction of gravity, heading the rest of it: a rotation about the
vertical (Laidig et al. 2021, "BROAD", sec. 4).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray


class OrientationError(NamedTuple):
    """Errors of orientations, rad, each of the shape of the batch."""

    total: FloatArray
    inclination: FloatArray
    heading: FloatArray


def orientation_error(q_wb: FloatArray, q_wb_reference: FloatArray) -> OrientationError:
    """Return errors of ``q_wb`` (..., 4) against a reference (..., 4), both wxyz. NaN stays NaN."""
    w, x, y, z = np.moveaxis(_times_conjugate(q_wb, q_wb_reference), -1, 0)
    return OrientationError(
        total=2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w)),
        inclination=2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z)),
        heading=2.0 * np.arctan2(np.abs(z), np.abs(w)),
    )


def rmse_deg(errors: FloatArray) -> FloatArray:
    """Return the root mean square (…) of errors (n, …), rad, over the first axis, degrees, NaN left out."""
    mean_square: FloatArray = np.asarray(np.nanmean(np.square(errors), axis=0))
    return np.degrees(np.sqrt(mean_square))


def coverage_percent(errors: FloatArray, sigma: FloatArray) -> float:
    """Return percent of errors (…), rad, within two sigma (…), rad; NaN where nothing is claimed."""
    if np.isnan(sigma).all():
        return float("nan")
    return float(100.0 * np.mean(errors < 2.0 * sigma))


def _times_conjugate(q: FloatArray, p: FloatArray) -> FloatArray:
    """Return q ⊗ p*, (..., 4): it takes reference world axes to estimated world axes."""
    qw, qx, qy, qz = np.moveaxis(np.asarray(q, dtype=np.float64), -1, 0)
    pw, px, py, pz = np.moveaxis(np.asarray(p, dtype=np.float64) * [1.0, -1.0, -1.0, -1.0], -1, 0)
    return np.stack(
        [
            qw * pw - qx * px - qy * py - qz * pz,
            qw * px + qx * pw + qy * pz - qz * py,
            qw * py - qx * pz + qy * pw + qz * px,
            qw * pz + qx * py - qy * px + qz * pw,
        ],
        axis=-1,
    )
