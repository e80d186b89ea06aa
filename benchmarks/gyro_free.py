"""Orientation without gyroscopes: every trial of BROAD with its position as local device."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from benchmarks.accuracy import DATA
from benchmarks.figures import Figure, Report, table
from devices.emulators.data_sets import read_broad
from devices.recorded_tracks import RecordedTracks
from gateway.body.rig import load_rig
from gateway.body.skeleton import WornSuit
from gateway.emulation.recordings import imu_frames, orientations, reference_at
from gateway.frames import FloatArray, ImuFrame
from gateway.geometry import quaternion, rotation_matrix
from gateway.geometry.comparison import orientation_error, rmse_deg
from gateway.reconstruction import create_reconstructor

UNAIDED = "per sample, unaided"
FIGURES = (
    ("gyro_free", "broad_gyrofree_causal_deg", ""),
    ("gyro_free, 100 ms", "broad_gyrofree_100ms_deg", "<=5"),
    ("gyro_free, 200 ms", "broad_gyrofree_200ms_deg", "<=5"),
    ("gyro_free, 500 ms", "broad_gyrofree_deg", "<=5"),
    (UNAIDED, "broad_gyrofree_unaided_deg", ""),
)
"""Method and delay, figure, target."""
METHODS = tuple(method for method, _, _ in FIGURES)


def run() -> Report:
    """The table of every trial and the figures; nothing where the data are absent."""
    report = Report("gyro_free")
    _add_broad(report, DATA / "broad")
    return report


def _add_broad(report: Report, folder: Path) -> None:
    suit = load_rig("single_placed")
    rows: list[list[str]] = []
    errors: dict[str, list[float]] = {method: [] for method in METHODS}
    for path in sorted(folder.glob("*.mat")):
        recording, is_moving = read_broad(path), loadmat(path, squeeze_me=True)["movement"].astype(bool)
        frames = [_without_gyroscopes(frame) for frame in imu_frames(recording, suit)]
        for method in METHODS:
            times, q_wb = _solve(method, suit, recording, frames)
            total, tilt = _errors(times, q_wb, recording, is_moving)
            errors[method].append(total)
            rows.append([recording.name, method, f"{total:.2f}", f"{tilt:.2f}"])
    if not rows:
        print(f"skipped broad_gyrofree: no trials in {folder}")
        return
    report.tables.append(
        "## BROAD: RMSE, degrees\n\nPosition as local device, gyroscopes hidden, movement phases only, "
        "nothing aligned. `gyro_free` is causal, or late by `reconstructor_delay_ms`; "
        "`per sample, unaided`: accelerometer and magnetometer alone "
        "(TRIAD).\n\n" + table(["trial", "method", "total", "tilt"], rows)
    )
    for method, name, target in FIGURES:
        note = f"{method}, BROAD with position ML, no gyroscopes, mean of {len(errors[method])} trials"
        report.figures.append(Figure(name, float(np.mean(errors[method])), "°", target, note))


def _without_gyroscopes(frame: ImuFrame) -> ImuFrame:
    return replace(frame, angular_rate=np.full_like(frame.angular_rate, np.nan))


def _solve(
    method: str, suit: WornSuit, recording: RecordedTracks, frames: list[ImuFrame]
) -> tuple[FloatArray, FloatArray]:
    """Times (T,) on the recording's clock and orientations (T, 1, 4)."""
    first_s = float(recording.modules[0].times[0])
    if method == UNAIDED:
        q_wb = np.array([[_triad(suit, frame)] for frame in frames])
        return first_s + np.array([f.time_ns - frames[0].time_ns for f in frames]) * 1e-9, q_wb
    name, _, delay = method.partition(", ")
    delay_s = float(delay.removesuffix(" ms")) * 1e-3 if delay else 0.0
    reconstructor = create_reconstructor(name, suit, 1.0 / recording.sampling_rate_hz, delay_s=delay_s)
    given = [reconstructor.update(frame) for frame in frames]
    late_s = (given[0].time_ns - frames[0].time_ns) * 1e-9
    return orientations(given, first_s + late_s)


def _triad(suit: WornSuit, frame: ImuFrame) -> FloatArray:
    f, m = frame.specific_force[0], frame.magnetic_field[0]
    return quaternion.from_matrix(rotation_matrix.from_two_vectors(f, m, -suit.gravity, suit.magnetic_field))


def _errors(
    times: FloatArray, q_wb: FloatArray, recording: RecordedTracks, is_moving: FloatArray
) -> tuple[float, float]:
    """RMSE over the movement rows, total and tilt, degrees."""
    q_ref = reference_at(times, recording.references[0])
    row = np.clip(np.round(times * recording.sampling_rate_hz).astype(int), 0, len(is_moving) - 1)
    errors = orientation_error(q_wb[is_moving[row], 0], q_ref[is_moving[row]])
    return float(rmse_deg(errors.total)), float(rmse_deg(errors.inclination))
