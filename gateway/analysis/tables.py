"""An analysis as tables: CSV or Parquet, a row an instant, units in the names of the columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.analysis.analysing import Analysis
from gateway.analysis.cycles import PERCENT, Stride
from gateway.analysis.floor import ForceSource
from gateway.analysis.gait import GaitEvent, gait_events
from gateway.analysis.gait_curves import gait_curves
from gateway.analysis.muscles import MuscleResult
from gateway.recording.exporters.tables import write_csv_columns, write_parquet_columns

Columns = dict[str, NDArray[Any]]
_SOURCES = np.array([source.name.lower() for source in ForceSource])
WRITERS = {"csv": write_csv_columns, "parquet": write_parquet_columns}
"""By the ending of the files."""


def write_tables(found: Analysis, muscles: MuscleResult | None, folder: Path, kind: str) -> list[Path]:
    """Write all tables into a folder that exists, and return the files. kind: of ``WRITERS``.

    Raises ``OSError``, and ``GatewayError`` for Parquet without its extra.
    """
    written = []
    made = tables(found, muscles)
    events = gait_events(found.skeleton, found.floor, found.time_s)
    if events:
        made["gait_events"] = {
            name: np.array(values)
            for name, values in zip(GaitEvent._fields, zip(*events, strict=True), strict=True)
        }
    made |= _gait(found)
    for name, columns in made.items():
        path = folder / f"{name}.{kind}"
        WRITERS[kind](columns, path)
        written.append(path)
    return written


def tables(found: Analysis, muscles: MuscleResult | None = None) -> dict[str, Columns]:
    """Return the tables by name of the file: columns (F,) by name."""
    made = {
        "joints": _joints(found),
        "segments": _segments(found),
        "floor": _floor(found),
        "centre_of_mass" if found.is_whole else "centre_of_mass_of_part": _centre_of_mass(found),
    }
    if muscles is not None:
        made["muscles"] = _muscles(found, muscles)
    return {name: {"time_s": found.time_s} | columns for name, columns in made.items()}


def _gait(found: Analysis) -> dict[str, Columns]:
    """Return strides, a row each, and curves by percent of them; nothing where nobody walks."""
    own = found.strides
    if not own:
        return {}
    made: Columns = {name: np.array([stride[i] for stride in own]) for i, name in enumerate(Stride._fields)}
    made["duration_s"] = np.array([stride.duration_s for stride in own])
    made["stance_percent"] = np.array([stride.stance_percent for stride in own])
    made["speed_m_per_s"] = np.array([stride.speed_m_per_s for stride in own])
    curves: Columns = {"percent": PERCENT}
    for shown in gait_curves(found):
        curves[f"{shown.name}_mean"] = shown.cycles.mean
        curves[f"{shown.name}_sd"] = shown.cycles.deviation
        if shown.band is not None:
            percent, mean, deviation = shown.band.T
            curves[f"{shown.name}_published_mean"] = np.interp(PERCENT, percent, mean)
            curves[f"{shown.name}_published_sd"] = np.interp(PERCENT, percent, deviation)
    return {"strides": made, "gait_cycles": curves}


def _joints(found: Analysis) -> Columns:
    columns: Columns = {}
    torques, power = found.known_torques, found.known_power
    for j, joint in enumerate(found.skeleton.joints):
        for k, angle in enumerate(joint.angles):
            name = f"{joint.name}_{angle.name}"
            columns[f"{name}_deg"] = np.degrees(found.angles[:, j, k])
            columns[f"{name}_rate_deg_per_s"] = np.degrees(found.angle_rates[:, j, k])
            columns[f"{name}_acceleration_deg_per_s2"] = np.degrees(found.angle_accelerations[:, j, k])
            columns[f"{name}_torque_n_m"] = torques[:, j, k]
        columns[f"{joint.name}_power_w"] = power[:, j]
    return columns


def _segments(found: Analysis) -> Columns:
    columns: Columns = {}
    for s, name in enumerate(found.skeleton.segment_names):
        columns |= _vector(f"{name}_joint_position", "m", found.dynamics.p_w[:, s])
        if found.skeleton.parents[s] >= 0:
            columns |= _vector(f"{name}_joint_moment", "n_m", found.dynamics.moment[:, s])
    columns |= _vector("residual_force", "n", found.dynamics.residual_force)
    return columns | _vector("residual_moment", "n_m", found.dynamics.residual_moment)


def _floor(found: Analysis) -> Columns:
    columns = _vector("total_force", "n", found.floor.total())
    pressure = found.floor.centre_of_pressure()
    for c, segment in enumerate(found.floor.segments.tolist()):
        name = found.skeleton.segment_names[segment]
        columns |= _vector(f"{name}_force", "n", found.floor.force[:, c])
        columns |= _vector(f"{name}_centre_of_pressure", "m", pressure[:, c])
        columns[f"{name}_source"] = _SOURCES[found.floor.source[:, c]]
    return columns


def _centre_of_mass(found: Analysis) -> Columns:
    columns = _vector("centre_of_mass", "m", found.dynamics.centre_of_mass)
    return columns | _vector("velocity", "m_per_s", found.dynamics.centre_of_mass_velocity)


def _muscles(found: Analysis, muscles: MuscleResult) -> Columns:
    columns: Columns = {}
    is_known = found.is_known.all(axis=1)
    for i, name in enumerate(muscles.names):
        columns[f"{name}_activity"] = np.where(is_known, muscles.activity[:, i], np.nan)
        columns[f"{name}_tension_n"] = np.where(is_known, muscles.tension[:, i], np.nan)
    for r, (j, k) in enumerate(muscles.torques):
        joint = found.skeleton.joints[j]
        columns[f"{joint.name}_{joint.angles[k].name}_left_n_m"] = muscles.left[:, r]
    return columns


def _vector(name: str, unit: str, values: NDArray[np.float64]) -> Columns:
    """Return three columns of (F, 3), east, north, up."""
    return {f"{name}_{axis}_{unit}": values[:, i] for i, axis in enumerate("xyz")}
