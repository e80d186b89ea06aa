"""One rule for every method and recording: errors against an optical reference after alignment.

Each segment's estimate is given one constant heading and one constant sensor-to-segment rotation
(the reference's world has its own heading, and markers sit askew on modules), so that only the
varying error counts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from devices.emulators.recordings import Recording, ReferenceTrack
from gateway.agreement.world_alignment import align_world, aligned
from gateway.comparison import orientation_error, rmse_deg
from gateway.frames import FloatArray

LONGEST_GAP_S = 0.05


class Score(NamedTuple):
    """RMSE by segment, degrees."""

    total: FloatArray
    tilt: FloatArray
    covered: FloatArray
    """Percent of the errors that lie within twice the ``sigma`` that came with them; NaN without."""

    def __str__(self) -> str:
        rows = zip(self.total, self.tilt, strict=True)
        cells = "  ".join(f"{total:.6f}/{tilt:.6f}" for total, tilt in rows)
        return f"total/tilt RMSE in degrees by segment: {cells}"


def score(
    times_s: FloatArray,
    q_wb: FloatArray,
    recording: Recording,
    from_s: float = 0.0,
    sigma: FloatArray | None = None,
) -> Score:
    """Errors of orientations (T, S, 4) at times (T,), in the order of the recording's references.

    sigma: (T, S) rad, what the estimator says of itself.
    """
    claimed = np.full(q_wb.shape[:2], np.nan) if sigma is None else sigma
    errors = [
        _segment_errors(times_s, q_wb[:, i], claimed[:, i], reference, from_s)
        for i, reference in enumerate(recording.references)
    ]
    return Score(*(np.array(column) for column in zip(*errors, strict=True)))


def _segment_errors(
    times_s: FloatArray, q_wb: FloatArray, sigma: FloatArray, reference: ReferenceTrack, from_s: float
) -> tuple[float, float, float]:
    q_ref = reference_at(times_s, reference)
    usable = np.isfinite(q_ref).all(axis=1) & np.isfinite(q_wb).all(axis=1) & (times_s >= from_s)
    errors = orientation_error(align(q_wb[usable], q_ref[usable]), q_ref[usable])
    covered = coverage_percent(errors.total, sigma[usable])
    return float(rmse_deg(errors.total)), float(rmse_deg(errors.inclination)), covered


def coverage_percent(errors: FloatArray, sigma: FloatArray) -> float:
    """Percent of errors (rad) within two sigma; NaN where nothing is claimed."""
    if np.isnan(sigma).all():
        return float("nan")
    return float(100.0 * np.mean(errors < 2.0 * sigma))


def reference_at(times_s: FloatArray, reference: ReferenceTrack) -> FloatArray:
    """(T, 4): spherical interpolation of the reference; NaN where its neighbours are too far."""
    known = np.isfinite(reference.q_wb).all(axis=1)
    times, q = reference.times[known], reference.q_wb[known]
    after = np.clip(np.searchsorted(times, times_s), 1, len(times) - 1)
    t0, t1 = times[after - 1], times[after]
    first, second = (Rotation.from_quat(q[i], scalar_first=True) for i in (after - 1, after))
    weight = np.clip((times_s - t0) / (t1 - t0), 0.0, 1.0)
    step = (first.inv() * second).as_rotvec() * weight[:, None]
    result: FloatArray = (first * Rotation.from_rotvec(step)).as_quat(scalar_first=True)
    outside = (times_s < times[0]) | (times_s > times[-1]) | (t1 - t0 > LONGEST_GAP_S)
    result[outside] = np.nan
    return result


def align(q: FloatArray, q_ref: FloatArray) -> FloatArray:
    """``q`` (T, 4) after the constant heading and misalignment that bring it closest to ``q_ref``."""
    found = align_world(q[:, None], q_ref[:, None])
    return aligned(q[:, None], found)[:, 0]
