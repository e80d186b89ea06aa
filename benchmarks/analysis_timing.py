"""Whether plates and motion go in step: the shift of the plates' forces that brings them nearest to the force
that the body's mass takes, axis by axis, for our centre of mass and for the one in the file."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline

from benchmarks.analysis_trials import CUTOFF_HZ, AnalysedTrial
from gateway.analysis.smooth_motion import low_pass
from gateway.frames import FloatArray

SHIFTS_MS = np.arange(-60, 61, 2)
_IN_FILE = "CentreOfMass"


def timing_rows(trial: AnalysedTrial, begin_s: float, end_s: float) -> list[list[str]]:
    """Name, then by axis the shift, ms, and the standard deviations of the difference there and unshifted, N.

    begin_s, end_s: from the first frame; between them all feet that stand are on plates.
    """
    rows = [
        [f"{trial.files.name}, ours", *_axes(trial, trial.measured.dynamics.centre_of_mass, begin_s, end_s)]
    ]
    if _IN_FILE in trial.trial.labels:
        in_file = trial.trial.columns((_IN_FILE,))[:, 0]
        rows.append([f"{trial.files.name}, the file's", *_axes(trial, in_file, begin_s, end_s)])
    return rows


def _axes(trial: AnalysedTrial, centre_of_mass: FloatArray, begin_s: float, end_s: float) -> list[str]:
    known = np.flatnonzero(np.isfinite(centre_of_mass).all(axis=1))  # a file's may begin late and end early
    frames = slice(int(known[0]), int(known[-1]) + 1)
    time_s = (trial.measured.time_s - trial.measured.time_s[0])[frames]
    among = (time_s > begin_s) & (time_s < end_s)
    smooth = low_pass(centre_of_mass[frames], trial.trial.rate_hz, CUTOFF_HZ)
    taken = trial.files.body_kg * make_interp_spline(time_s, smooth, k=5)(time_s, 2)[among]
    total = np.sum([plate.force for plate in trial.plates.plates], axis=0)
    force = low_pass(total, trial.plates.rate_hz, CUTOFF_HZ)
    at = np.arange(len(force)) / trial.plates.rate_hz
    cells = []
    for axis in range(3):
        left = [
            np.std(np.interp(time_s[among] + 1e-3 * shift, at, force[:, axis]) - taken[:, axis])
            for shift in SHIFTS_MS
        ]
        best = int(np.argmin(left))
        unshifted = left[int(np.flatnonzero(SHIFTS_MS == 0)[0])]
        cells.append(f"{SHIFTS_MS[best]} ({left[best]:.0f}, {unshifted:.0f})")
    return cells
