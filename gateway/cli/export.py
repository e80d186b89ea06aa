"""``mocap-gateway export``, ``report`` and ``batch``: what is made of recordings, one or many."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from enum import StrEnum
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Column, Table

from gateway.batch import KINDS, REPORT
from gateway.cli.options import AsJson, refuse_existing
from gateway.cli.solving_options import SolvedOtherwise, with_solving
from gateway.cli.terminal import progress_bar
from gateway.errors import GatewayError
from gateway.recording.exporters.formats import FORMATS, Axes
from gateway.settings import check_method
from gateway.support.extras import require_package

if TYPE_CHECKING:
    from gateway.batch.job import Job, JobResult
    from gateway.batch.manifest import Manifest
    from gateway.recording.exporters.take import Take


FormatName = StrEnum("FormatName", {name: name for name in FORMATS})  # type: ignore[misc]  # from the list


class Unit(StrEnum):
    """Length unit of an export."""

    M = "m"
    CM = "cm"
    MM = "mm"


_UNITS_PER_M = {Unit.M: 1.0, Unit.CM: 100.0, Unit.MM: 1000.0}


def units_per_m(unit: Unit) -> float:
    """Return how many of a unit make a metre."""
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
    mass: Annotated[
        float | None, typer.Option(min=2, max=400, help="Of the person, kg, for osim; else 75.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Replace files that are there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write a recording as BVH, C3D, glTF, TRC, CSV, Parquet, for OpenSim, ROS 2 or Foxglove.

    Instants that were not recorded, and orientations that were not known, are interpolated; how many is
    told. Parquet and glTF need the extra `export`, Foxglove needs `foxglove`. ros2 and foxglove keep the
    recorded instants, and interpolate nothing.
    """
    from gateway.recording import open_recording
    from gateway.recording.exporters.take import take_of
    from gateway.recording.solving import smoothed_arrays

    # Before anything is read or written: what cannot be written would be noticed after the others are.
    for name in to:
        FORMATS[name].check(*_form(name, axes, unit))
    files = {name: _target(file, name, output, len(to) > 1, force) for name in to}
    reporting = _compiling_reported() if smooth else contextlib.nullcontext()
    with reporting, progress_bar(f"reading {file.name}", is_shown=not as_json) as progress:
        recording = open_recording(file)
        arrays = smoothed_arrays(recording, progress) if smooth else recording.skeleton_arrays(progress)

    @cache  # resampling takes longer than writing: formats with the same axes share one take
    def taken(wanted: Axes, as_recorded: bool) -> Take:
        take = take_of(arrays, file.stem, wanted, recording, as_recorded=as_recorded)
        return replace(take, mass_kg=mass)

    written, notes = [], []
    with progress_bar("writing", is_shown=not as_json) as progress:
        for done, (name, path) in enumerate(files.items()):
            progress(done, len(files))
            wanted, per_m = _form(name, axes, unit)
            take = taken(wanted, FORMATS[name].as_recorded)
            notes.append(FORMATS[name].write(take, path, per_m))
            written.append(_summary_of(name, path, take, per_m))

    if mass is None and any(name == "osim" for name in to):
        notes.append("masses of the .osim are those of 75 kg: tell the person's with --mass")
    for note in filter(None, notes):
        typer.echo(f"note: {note}", err=True)
    if as_json:
        typer.echo(json.dumps(written, indent=2))
        return
    _print_written(written)


def _compiling_reported() -> contextlib.AbstractContextManager[None]:
    """Return what tells, on standard error, of minutes that go into compiling the recording's method."""
    from gateway.cli.preparing import report_compiling

    return report_compiling(partial(typer.echo, err=True))


def _form(name: str, axes: Axes | None, unit: Unit | None) -> tuple[Axes, float]:
    """Return the axes and the units per metre of a format: those asked for, else its own."""
    kind = FORMATS[name]
    return axes or kind.axes, kind.units_per_m if unit is None else units_per_m(unit)


def _target(file: Path, name: str, output: Path | None, is_folder: bool, force: bool) -> Path:
    """Return where a format goes. Raises ``GatewayError`` if that would overwrite something."""
    suffix = FORMATS[name].suffix
    if output is None:
        path = file.with_suffix(suffix)
    # A name without a suffix means a folder, which need not be there yet.
    elif output.is_dir() or is_folder or not output.suffix:
        output.mkdir(parents=True, exist_ok=True)
        path = output / f"{file.stem}{suffix}"
    else:
        path = output
    refuse_existing(path, force, source=file)
    if path.suffix.lower() != Path(f"x{suffix}").suffix:
        raise GatewayError(f"{path}: name it {path.name.partition('.')[0]}{suffix}, the ending of {name}")
    return path


def _summary_of(name: str, path: Path, take: Take, units_per_m: float) -> dict[str, object]:
    filled = {
        segment: int(count)
        for segment, count in zip(take.skeleton.segment_names, take.filled.sum(axis=0), strict=True)
        if count and not FORMATS[name].as_recorded
    }
    recorded_ns = take.recorded.time_ns
    return {
        "format": name,
        "file": str(path),
        "bytes": path.stat().st_size,
        "frames": len(take.q_wb),
        "rate_hz": round(take.rate_hz, 6),
        "seconds": round(float(recorded_ns[-1] - recorded_ns[0]) * 1e-9, 3),
        "segments": take.skeleton.n_segments,
        "world_axes": take.axes.value,
        "units_per_m": units_per_m,
        "interpolated": filled,
        "has_path": bool(np.ptp(take.p_w[:, 0], axis=0).any()),
    }


def _print_written(written: list[dict[str, object]]) -> None:
    table = Table(
        Column("file", overflow="fold"), "frames", "Hz", "world axes", "units/m", "MB", "interpolated"
    )
    for row in written:
        filled = row["interpolated"]
        assert isinstance(filled, dict)
        table.add_row(
            Path(str(row["file"])).name, str(row["frames"]), f"{row['rate_hz']:g}", str(row["world_axes"]),
            f"{row['units_per_m']:g}", f"{int(str(row['bytes'])) / 1e6:.2f}", str(sum(filled.values()) or ""),
        )  # fmt: skip
    Console().print(table)
    typer.echo(f"in {Path(str(written[0]['file'])).resolve().parent}")


def report(
    file: Annotated[Path, typer.Argument(help="Recording, whole or cut off.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="The page; else NAME.html beside the recording.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", "-f", help="Replace a file that is there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write one HTML page: loss and clocks by module, status, orientations, joint angles, events, settings.

    The page loads nothing from elsewhere and prints well. Needs the extra `plot`.
    """
    from gateway.recording import open_recording
    from gateway.report import gather, write_report

    require_package("matplotlib")
    target = output or file.with_suffix(".html")
    refuse_existing(target, force, source=file)
    if target.suffix.lower() not in (".html", ".htm"):
        raise GatewayError(
            f"{target}: a report is a page: name it {target.stem}.html; a browser prints that to a PDF"
        )
    recording = open_recording(file)

    with _compiling_reported(), progress_bar(f"reading {file.name}", is_shown=not as_json) as progress:
        found = gather(recording, progress)
    write_report(found, target)
    if as_json:
        typer.echo(json.dumps({"file": str(target), "poses": found.n_poses, "defect": found.summary.defect}))
    else:
        typer.echo(f"{target}: {found.summary.duration_s:.1f} s, {found.n_poses} poses")
        if found.summary.defect:
            typer.echo(f"note: {found.summary.defect}", err=True)


Kind = StrEnum("Kind", {name: name for name in KINDS})  # type: ignore[misc]  # from the list

SOME_FAILED, INTERRUPTED = 3, 130
"""Exit codes."""


@with_solving
def batch(
    wanted: SolvedOtherwise,
    folder: Annotated[Path, typer.Argument(help="Folder with recordings, also in folders below it.")],
    to: Annotated[list[Kind], typer.Option("--to", help="What to make of each; several may be asked for.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Where it goes; else FOLDER_batch beside the folder."),
    ] = None,
    axes: Annotated[Axes | None, typer.Option(help="World axes of exports; else each format's own.")] = None,
    unit: Annotated[Unit | None, typer.Option(help="Length unit of exports; else each format's own.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; else one for every core.")] = None,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Work on this Dask cluster, tcp://host:8786.")
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Also what is done already.")] = False,
    as_json: AsJson = False,
) -> None:
    """Export, report or re-solve every recording of a folder, on all cores or on a Dask cluster.

    Started again it goes on where it was: manifest.jsonl beside the results tells what is done. A recording
    that fails stops no other: failures are listed, and the exit code is then 3. Workers of a cluster need
    this program and the same paths. `--to report` needs the extra `plot`, `--dask` the extra `dask`.
    """
    from gateway.batch.job import Task
    from gateway.batch.manifest import Manifest
    from gateway.batch.running import jobs_in
    from gateway.body.rig import load_rig
    from gateway.recording.snapshot import encode_suit

    if wanted.reconstructor is not None:
        check_method(wanted.reconstructor)
    if REPORT in to:
        require_package("matplotlib")
    for kind in to:
        if kind in FORMATS:
            FORMATS[kind].check(*_form(kind, axes, unit))
    task = Task(
        to=tuple(dict.fromkeys(str(kind) for kind in to)),
        axes=None if axes is None else axes.value,
        units_per_m=None if unit is None else units_per_m(unit),
        suit=None if wanted.with_rig is None else encode_suit(load_rig(wanted.with_rig)),
        reconstructor=wanted.reconstructor,
        delay_ms=wanted.delay_ms,
        smooth=wanted.smooth,
    )

    results = output or folder.resolve().with_name(f"{folder.resolve().name}_batch")
    jobs = jobs_in(folder, results, task)
    manifest = Manifest(results)
    due = [job for job in jobs if again or not manifest.is_done(job)]
    outcomes = _run_due(due, manifest, workers, dask, is_shown=not as_json)
    if len(outcomes) < len(due):
        left = len(due) - len(outcomes)
        typer.echo(
            f"interrupted: {len(outcomes)} done, {left} left; the same command goes on from there", err=True
        )
        raise typer.Exit(INTERRUPTED)
    _print_outcomes(outcomes, len(jobs) - len(due), results, as_json)


def _run_due(
    due: list[Job], manifest: Manifest, workers: int | None, dask: str | None, *, is_shown: bool
) -> list[JobResult]:
    """Run jobs with a progress bar, and close the manifest; return the outcomes, fewer after Ctrl-C."""
    from gateway.batch.running import run_jobs

    outcomes: list[JobResult] = []
    bar = progress_bar(f"{len(due)} recordings", is_shown=is_shown)
    with contextlib.suppress(KeyboardInterrupt), bar as progress:
        progress(0, len(due))

        def done(job: Job, outcome: JobResult) -> None:
            # Into the manifest at once: what is finished stays finished, however the batch ends.
            manifest.add(job, outcome)
            outcomes.append(outcome)
            progress(len(outcomes), len(due))

        run_jobs(due, done, workers, dask)
    manifest.close()
    return outcomes


def _print_outcomes(outcomes: list[JobResult], skipped: int, results: Path, as_json: bool) -> None:
    outcomes.sort(key=lambda outcome: outcome.name)
    failed = {outcome.name: outcome.error for outcome in outcomes if outcome.error}
    notes = {outcome.name: outcome.note for outcome in outcomes if outcome.note}
    made = len(outcomes) - len(failed)
    if as_json:
        counts = {"done": made, "skipped": skipped, "failed": failed, "notes": notes, "folder": str(results)}
        typer.echo(json.dumps(counts, indent=2, ensure_ascii=False))
    else:
        typer.echo(f"{made} done, {skipped} were done before, {len(failed)} failed; in {results}")
        for name, note in notes.items():
            typer.echo(f"note: {name}: {note}", err=True)
        for name, error in failed.items():
            typer.echo(f"failed: {name}: {error}", err=True)
    if failed:
        raise typer.Exit(SOME_FAILED)
