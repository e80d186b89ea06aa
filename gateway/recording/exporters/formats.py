"""The list of formats. What writes a format is imported when something is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from devices.deferred import Deferred
from gateway.recording.exporters.axes import Axes

if TYPE_CHECKING:
    from gateway.recording.exporters.take import Take


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


def _writer(name: str) -> Deferred:
    module, function = name.split(".")
    return Deferred(f"{__package__}.{module}", function)


FORMATS: dict[str, Format] = {
    "bvh": Format(
        ".bvh", "skeleton with joint rotations, for animation", Axes.Y_UP, 100.0, _writer("bvh.write")
    ),
    "c3d": Format(".c3d", "joint centres, rotations, joint angles", Axes.Z_UP, 1000.0, _writer("c3d.write")),
    "sto": Format(
        ".sto", "orientations for OpenSim (OpenSense)", Axes.Y_UP, 1.0, _writer("opensim.write_sto")
    ),
    "mot": Format(".mot", "joint angles for OpenSim", Axes.Y_UP, 1.0, _writer("opensim.write_mot")),
    "osim": Format(
        ".osim", "the body as a model of OpenSim", Axes.Y_UP, 1.0, _writer("opensim_model.write_osim")
    ),
    "trc": Format(".trc", "joint centres as markers", Axes.Y_UP, 1000.0, _writer("trc.write")),
    "csv": Format(".csv", "everything as a table", Axes.Z_UP, 1.0, _writer("tables.write_csv")),
    "parquet": Format(".parquet", "everything as a table", Axes.Z_UP, 1.0, _writer("tables.write_parquet")),
    "gltf": Format(
        ".glb", "animated skeleton, for browsers and 3-D programs", Axes.Y_UP, 1.0, _writer("gltf.write")
    ),
    "ros2": Format(
        ".ros2.mcap", "bag of ROS 2: transforms, joints, modules", Axes.Z_UP, 1.0, _writer("ros2.write")
    ),
    "foxglove": Format(
        ".foxglove.mcap", "body and joint angles for Foxglove", Axes.Z_UP, 1.0, _writer("foxglove.write")
    ),
}
"""By name on the command line."""
