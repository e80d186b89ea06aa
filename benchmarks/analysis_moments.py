"""Joint moments beside those that Plug-in-Gait wrote into the same file."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from benchmarks.analysis_trials import AnalysedTrial, on_plates, rms
from gateway.analysis.analysing import Analysis
from gateway.frames import FloatArray, IntArray

MOMENTS = {
    ("ankle", "dorsiflexion"): ("Ankle", 0), ("knee", "flexion"): ("Knee", 0), ("hip", "flexion"): ("Hip", 0),
    ("knee", "adduction"): ("Knee", 1), ("hip", "adduction"): ("Hip", 1),
}  # fmt: skip
"""Ours by joint and movement, to the file's by joint and component; the file's have the opposite sign."""
_SEGMENTS = {"ankle": "foot", "knee": "shank", "hip": "thigh"}
_ACROSS, _FORWARD = 2, 0
"""Axes of a distal segment that Plug-in-Gait's first and second component are about."""


class MomentRow(NamedTuple):
    """One movement of one joint while its foot is on a plate that the file knows; N m."""

    side: str
    joint: str
    movement: str
    recorded: FloatArray  # (n,)
    ours: FloatArray
    """Along the axis of our angle."""
    distal: FloatArray
    """Along the distal segment's axis, as Plug-in-Gait writes them."""
    frames: IntArray


def moment_rows(trial: AnalysedTrial) -> list[MomentRow]:
    """All of both legs."""
    rows = []
    for side in ("left", "right"):
        frames = _given_frames(trial, side)
        for (joint, movement), (label, column) in MOMENTS.items():
            moments = trial.trial.columns((f"{side[0].upper()}{label}Moment",))[frames, 0, column]
            recorded = (
                -moments / trial.trial.metres_per_unit * 1e-3 * trial.files.body_kg
            )  # N mm/kg, outer load
            known = np.isfinite(recorded)
            ours = torque(trial.measured, f"{side}_{joint}", movement)[frames][known]
            distal = _about_distal(trial.measured, f"{side}_{_SEGMENTS[joint]}", column)[frames][known]
            distal = distal * np.sign(distal @ ours)
            rows.append(MomentRow(side, joint, movement, recorded[known], ours, distal, frames[known]))
    return rows


def given_table(rows: list[MomentRow]) -> tuple[list[str], list[list[str]]]:
    """Peaks, errors and correlations about either axis."""
    heads = ["joint", "movement", "file's peak", "peak", "RMSE", "r", "distal axes: peak", "RMSE", "r"]
    cells = [
        [f"{row.side} {row.joint}", row.movement, f"{np.abs(row.recorded).max():.1f}",
         *agreement(row.ours, row.recorded), *agreement(row.distal, row.recorded)]
        for row in rows
    ]  # fmt: skip
    return heads, cells


def agreement(ours: FloatArray, recorded: FloatArray) -> tuple[str, str, str]:
    """Peak, RMSE, correlation."""
    r = float(np.corrcoef(ours, recorded)[0, 1])
    return f"{np.abs(ours).max():.1f}", f"{rms(ours - recorded):.1f}", f"{r:.3f}"


def torque(found: Analysis, joint: str, movement: str) -> FloatArray:
    """(F,) N m."""
    j = [each.name for each in found.skeleton.joints].index(joint)
    k = [angle.name for angle in found.skeleton.joints[j].angles].index(movement)
    return found.torques[:, j, k]


def _given_frames(trial: AnalysedTrial, side: str) -> IntArray:
    """Those of a foot on a plate that the file took into account: of some steps it did not."""
    frames = on_plates(trial.measured, side)
    taken = trial.trial.columns((f"{side[0].upper()}GroundReactionForce",))[frames, 0]
    recorded: IntArray = frames[np.isfinite(taken).all(axis=1)]
    return recorded


def _about_distal(found: Analysis, segment: str, column: int) -> FloatArray:
    """(F,) N m about an axis of the segment whose proximal joint it is."""
    s = found.skeleton.index(segment)
    axis = _ACROSS if column == 0 else _FORWARD
    about: FloatArray = np.einsum(
        "fi,fi->f", found.dynamics.rotation_wb[:, s, :, axis], found.dynamics.moment[:, s]
    )
    return about
