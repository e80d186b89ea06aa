"""``mocap-gateway export``: recordings as files for other programs."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from gateway.cli.progress import progress_bar
from gateway.errors import GatewayError
from gateway.recording import open_recording
from gateway.recording.exporters import FORMATS, Axes, Take, take_of
from gateway.recording.solving import smoothed_arrays

FormatName = StrEnum("FormatName", {name: name for name in FORMATS})  # type: ignore[misc]  # from the list


class Unit(StrEnum):
    """Length unit of an export."""

    M = "m"
    CM = "cm"
    MM = "mm"


_UNITS_PER_M = {Unit.M: 1.0, Unit.CM: 100.0, Unit.MM: 1000.0}


def units_per_m(unit: Unit) -> float:
    """How many of it make a metre."""
    return _UNITS_PER_M[unit]


def export(
    file: Annotated[Path, typer.Argument(help="Recording.")],
    to: Annotated[list[FormatName], typer.Option("--to", help="Format; several may be asked for.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="File, or folder: a name without ending."),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Solve anew first, forward and backward: more accurate.")
    ] = False,
    axes: Annotated[
        Axes | None, typer.Option(help="World axes; else those that the format usually has.")
    ] = None,
    unit: Annotated[Unit | None, typer.Option(help="Length unit; else the format's usual one.")] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Replace files that are there.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was written as JSON.")] = False,
) -> None:
    """Write the poses of a recording as BVH, C3D, glTF, OpenSim .sto and .mot, TRC, CSV or Parquet.

    Instants that were not recorded, and orientations that were not known, are interpolated; how many is
    told. C3D, Parquet and glTF need the extra `export`.
    """
    files = {name: _target(file, name, output, len(to) > 1, force) for name in to}
    with progress_bar(f"reading {file.name}", is_shown=not as_json) as tell:
        recording = open_recording(file)
        arrays = smoothed_arrays(recording, tell) if smooth else recording.skeleton_arrays(tell)
    takes: dict[Axes, Take] = {}
    written = []
    with progress_bar("writing", is_shown=not as_json) as tell:
        for done, (name, path) in enumerate(files.items()):
            tell(done, len(files))
            kind = FORMATS[name]
            wanted = axes or kind.axes
            if wanted not in takes:
                takes[wanted] = take_of(arrays, file.stem, wanted)
            per_m = kind.units_per_m if unit is None else units_per_m(unit)
            kind.write(takes[wanted], path, per_m)
            written.append(_summary(name, path, takes[wanted], per_m))
    if as_json:
        typer.echo(json.dumps(written, indent=2))
        return
    _print(written)


def _target(file: Path, name: str, output: Path | None, is_folder: bool, force: bool) -> Path:
    """Where a format goes. Raises ``GatewayError`` if that would overwrite something."""
    suffix = FORMATS[name].suffix
    if output is None:
        path = file.with_suffix(suffix)
    elif output.is_dir() or is_folder or not output.suffix:
        output.mkdir(parents=True, exist_ok=True)
        path = output / f"{file.stem}{suffix}"
    else:
        path = output
    if path.exists() and not force:
        raise GatewayError(f"{path} exists: name another file with --output, or replace it with --force")
    return path


def _summary(name: str, path: Path, take: Take, units_per_m: float) -> dict[str, object]:
    filled = {
        segment: int(count)
        for segment, count in zip(take.skeleton.segment_names, take.filled.sum(axis=0), strict=True)
        if count
    }
    return {
        "format": name,
        "file": str(path),
        "bytes": path.stat().st_size,
        "frames": len(take.q_wb),
        "rate_hz": round(take.rate_hz, 6),
        "seconds": round(float(take.time_s[-1]), 3),
        "segments": take.skeleton.n_segments,
        "world_axes": take.axes.value,
        "units_per_m": units_per_m,
        "interpolated": filled,
        "has_path": bool(np.ptp(take.p_w[:, 0], axis=0).any()),
    }


def _print(written: list[dict[str, object]]) -> None:
    table = Table("file", "frames", "Hz", "world axes", "units/m", "MB", "interpolated")
    for row in written:
        filled = row["interpolated"]
        assert isinstance(filled, dict)
        table.add_row(
            Path(str(row["file"])).name, str(row["frames"]), f"{row['rate_hz']:g}", str(row["world_axes"]),
            f"{row['units_per_m']:g}", f"{int(str(row['bytes'])) / 1e6:.2f}", str(sum(filled.values()) or ""),
        )  # fmt: skip
    Console().print(table)
    typer.echo(f"in {Path(str(written[0]['file'])).resolve().parent}")
