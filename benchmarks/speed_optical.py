"""Markers to skeleton, timed beside OpenSim's inverse kinematics on the same body and the same frames."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from benchmarks import opensim_peer
from benchmarks.figures import Figure, table
from benchmarks.optical import DATA
from devices.marker_files import read_markers
from gateway.emulation.optical_truth import TRIALS
from gateway.frames import FloatArray, MarkerFrame
from gateway.reconstruction.optical.fitted_body import Fit
from gateway.reconstruction.optical.fitting import fit_body
from gateway.reconstruction.optical.landmarks import to_world
from gateway.reconstruction.optical.marker_set import load_marker_set
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor

REPEATS = 3
TRIAL = "opensim"


def measured() -> tuple[list[Figure], str]:
    """Figures, and a table or why there is none."""
    set_name, static, motion = TRIALS[TRIAL]
    if not (DATA / motion).is_file():
        return [], f"Markers to skeleton: skipped, {motion} is not among the recordings."
    trials = [read_markers(DATA / static), read_markers(DATA / motion)]
    half = trials[1].n_frames // 2
    training = [trials[0], replace(trials[1], positions=trials[1].positions[:half])]
    body = fit_body(load_marker_set(set_name), training)
    columns = trials[1].columns(body.markers.labels)[half:]
    observed, rate_hz = to_world(columns, body.markers.vertical), trials[1].rate_hz
    ms, rmse = _ours(body, observed, rate_hz)
    title = f"Markers to skeleton, {len(observed)} held-out frames of `{motion}`, one core:\n\n"
    heads, rows = ["method", "ms a frame", "markers, RMSE mm"], [["ours", f"{ms:.2f}", f"{1e3 * rmse:.1f}"]]
    figures = [Figure("markers_ms", ms, "ms", "", f"41 markers to skeleton, processor time, `{motion}`")]
    try:
        theirs = opensim_peer.solve(body.skeleton, body.markers, observed, rate_hz)
    except opensim_peer.OpenSimMissingError as missing:
        return figures, title + table(heads, rows) + f"\n\nOpenSim IK: skipped, {missing}."
    rows.append(["OpenSim IK", f"{theirs.ms:.2f}", f"{1e3 * theirs.rmse:.1f}"])
    note = f"OpenSim {theirs.version.split('-')[0]}, the same body and frames, knees as hinges"
    figures.append(Figure("opensim_ik_ms", theirs.ms, "ms", "", note))
    return figures, title + table(heads, rows)


def _ours(body: Fit, observed: FloatArray, rate_hz: float) -> tuple[float, float]:
    """Least processor time of a frame, ms, and the RMSE of all markers seen, m."""
    frames = [MarkerFrame(f, round(f * 1e9 / rate_hz), seen) for f, seen in enumerate(observed)]
    reconstructor = OpticalReconstructor(body.skeleton, body.markers)
    times = []
    for _ in range(1 + REPEATS):  # the first compiles
        reconstructor.reset()
        residuals, begun = [], time.process_time()
        for frame in frames:
            reconstructor.update(frame)
            residuals += [reconstructor.last.residuals] if reconstructor.last else []
        times.append(1e3 * (time.process_time() - begun) / len(frames))
    return min(times[1:]), float(np.sqrt(np.nanmean(np.square(residuals))))
