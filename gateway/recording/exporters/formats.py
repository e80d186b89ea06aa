"""The list of formats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gateway.recording.exporters import bvh, c3d, gltf, opensim, tables, trc
from gateway.recording.exporters.take import Axes, Take


@dataclass(frozen=True)
class Format:
    """How a take becomes a file."""

    suffix: str
    meaning: str
    axes: Axes
    """World axes unless others are asked for."""
    units_per_m: float
    """Length unit unless another is asked for: 1 m, 100 cm, 1000 mm."""
    write: Callable[[Take, Path, float], None]
    """Take, file, units per metre."""


FORMATS: dict[str, Format] = {
    "bvh": Format(".bvh", "skeleton with joint rotations, for animation", Axes.Y_UP, 100.0, bvh.write),
    "c3d": Format(".c3d", "joint centres, rotations, joint angles", Axes.Z_UP, 1000.0, c3d.write),
    "sto": Format(".sto", "orientations for OpenSim (OpenSense)", Axes.Y_UP, 1.0, opensim.write_sto),
    "mot": Format(".mot", "joint angles for OpenSim", Axes.Y_UP, 1.0, opensim.write_mot),
    "trc": Format(".trc", "joint centres as markers", Axes.Y_UP, 1000.0, trc.write),
    "csv": Format(".csv", "everything as a table", Axes.Z_UP, 1.0, tables.write_csv),
    "parquet": Format(".parquet", "everything as a table", Axes.Z_UP, 1.0, tables.write_parquet),
    "gltf": Format(".glb", "animated skeleton, for browsers and 3-D programs", Axes.Y_UP, 1.0, gltf.write),
}
"""By name on the command line."""
