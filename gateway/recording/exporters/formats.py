"""The list of formats. What writes a format is imported when something is written."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from devices.deferred import Deferred
from gateway.errors import GatewayError
from gateway.support.extras import require_package
from gateway.support.whole_files import replacing_by_name, writing

if TYPE_CHECKING:
    from gateway.recording.exporters.take import Take


class Axes(StrEnum):
    """World axes of an export. Segment axes never change: x anterior, y superior, z to the right."""

    Z_UP = "z-up"
    """East, north, up: as published."""
    Y_UP = "y-up"
    """x east, y up, z south: BVH, glTF, OpenSim."""


@dataclass(frozen=True)
class ExportFormat:
    """How a take becomes a file."""

    suffix: str
    meaning: str
    axes: Axes
    """World axes unless others are asked for."""
    units_per_m: float
    """Length unit unless another is asked for: 1 m, 100 cm, 1000 mm."""
    writer: Callable[[Take, Path, float], str | None]
    """Take, file, units per metre; returns what of the take the file lacks, if anything."""
    package: str = ""
    """What it needs that is not always installed; empty: nothing."""
    follows: str = ""
    """The convention that leaves no choice of axes and unit; empty: there is one."""
    as_recorded: bool = False
    """Its frames are those that were recorded, at their own instants: a pause costs nothing."""

    def check(self, axes: Axes, units_per_m: float) -> None:
        """Raise ``GatewayError`` without the package that it needs, and for axes or a unit that such files
        never have."""
        if self.package:
            require_package(self.package)
        if self.follows and (axes is not self.axes or units_per_m != self.units_per_m):
            raise GatewayError(
                f"a {self.suffix} file has metres and z up ({self.follows}), not {units_per_m:g} units a "
                f"metre and {axes.value}: leave --axes and --unit out"
            )

    def write(self, take: Take, path: Path, units_per_m: float) -> str | None:
        """Write a file, whole or not at all; return what of the take it cannot hold, or None.

        Raises as ``check`` does, and ``GatewayError`` for a take that the format cannot hold and for a file
        that cannot be written.
        """
        self.check(take.axes, units_per_m)
        with writing(path), replacing_by_name(path) as made:
            return self.writer(take, made, units_per_m)


def _writer(name: str) -> Deferred:
    module, function = name.split(".")
    return Deferred(f"{__package__}.{module}", function)


FORMATS: dict[str, ExportFormat] = {
    "bvh": ExportFormat(
        ".bvh", "skeleton with joint rotations, for animation", Axes.Y_UP, 100.0, _writer("bvh.write")
    ),
    "c3d": ExportFormat(
        ".c3d", "joint centres, rotations, joint angles", Axes.Z_UP, 1000.0, _writer("c3d.write")
    ),
    "sto": ExportFormat(
        ".sto", "orientations for OpenSim (OpenSense)", Axes.Y_UP, 1.0, _writer("opensim.write_sto")
    ),
    "mot": ExportFormat(".mot", "joint angles for OpenSim", Axes.Y_UP, 1.0, _writer("opensim.write_mot")),
    "osim": ExportFormat(
        ".osim", "the body as a model of OpenSim", Axes.Y_UP, 1.0, _writer("opensim_model.write_osim")
    ),
    "trc": ExportFormat(".trc", "joint centres as markers", Axes.Y_UP, 1000.0, _writer("trc.write")),
    "csv": ExportFormat(".csv", "everything as a table", Axes.Z_UP, 1.0, _writer("tables.write_csv")),
    "parquet": ExportFormat(
        ".parquet", "everything as a table", Axes.Z_UP, 1.0, _writer("tables.write_parquet"), "pyarrow"
    ),
    "gltf": ExportFormat(
        ".glb",
        "animated skeleton, for browsers and 3-D programs",
        Axes.Y_UP,
        1.0,
        _writer("gltf.write"),
        "pygltflib",
    ),
    "ros2": ExportFormat(
        ".ros2.mcap",
        "bag of ROS 2: transforms, joints, modules",
        Axes.Z_UP,
        1.0,
        _writer("ros2.write"),
        follows="REP 103",
        as_recorded=True,
    ),
    "foxglove": ExportFormat(
        ".foxglove.mcap",
        "body and joint angles for Foxglove",
        Axes.Z_UP,
        1.0,
        _writer("foxglove.write"),
        "foxglove",
        "REP 103",
        as_recorded=True,
    ),
}
"""By name on the command line."""


def check_formats(names: Iterable[str]) -> None:
    """Raise ``GatewayError`` for the first format that is unknown, or that lacks its package."""
    for name in names:
        if name not in FORMATS:
            raise GatewayError(f"--to {name}: one of {', '.join(FORMATS)} is wanted")
        FORMATS[name].check(FORMATS[name].axes, FORMATS[name].units_per_m)
