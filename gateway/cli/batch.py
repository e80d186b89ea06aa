"""``mocap-gateway batch``: many recordings at once."""

from __future__ import annotations

import contextlib
import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gateway.batch import Job, Manifest, Outcome, Task, jobs_in, run_jobs
from gateway.batch.job import KINDS, REPORT
from gateway.body.rig import load_rig
from gateway.cli.export import Unit, units_per_m
from gateway.cli.progress import progress_bar
from gateway.recording.exporters import Axes
from gateway.recording.suit_snapshot import encode_suit
from gateway.report.drawing import require_matplotlib
from gateway.settings import MAX_DELAY_MS, check_method

Kind = StrEnum("Kind", {name: name for name in KINDS})  # type: ignore[misc]  # from the list

SOME_FAILED, INTERRUPTED = 3, 130
"""Exit codes."""


def batch(
    folder: Annotated[Path, typer.Argument(help="Folder with recordings, also in folders below it.")],
    to: Annotated[list[Kind], typer.Option("--to", help="What to make of each; several may be asked for.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Where it goes; else FOLDER_batch beside the folder."),
    ] = None,
    with_rig: Annotated[
        str | None, typer.Option("--with", metavar="RIG", help="Solve anew with this rig (file or name).")
    ] = None,
    reconstructor: Annotated[str | None, typer.Option(help="Solve anew by this method.")] = None,
    delay_ms: Annotated[
        float | None, typer.Option(min=0, max=MAX_DELAY_MS, help="For gyro_free: with poses so much later.")
    ] = None,
    smooth: Annotated[bool | None, typer.Option(help="Solve anew, forward and backward.")] = None,
    axes: Annotated[Axes | None, typer.Option(help="World axes of exports; else each format's own.")] = None,
    unit: Annotated[Unit | None, typer.Option(help="Length unit of exports; else each format's own.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; else one for every core.")] = None,
    dask: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Work on this Dask cluster, tcp://host:8786.")
    ] = None,
    again: Annotated[bool, typer.Option("--again", help="Also what is done already.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")] = False,
) -> None:
    """Export, report or re-solve every recording of a folder, on all cores or on a Dask cluster.

    Started again it goes on where it was: manifest.jsonl beside the results tells what is done. A recording
    that fails stops no other: failures are listed, and the exit code is then 3. Workers of a cluster need
    this program and the same paths. `--to report` needs the extra `plot`, `--dask` the extra `dask`.
    """
    if reconstructor is not None:
        check_method(reconstructor)
    if REPORT in to:
        require_matplotlib()
    task = Task(
        to=tuple(dict.fromkeys(str(kind) for kind in to)),
        axes=None if axes is None else axes.value,
        units_per_m=None if unit is None else units_per_m(unit),
        suit=None if with_rig is None else encode_suit(load_rig(with_rig)),
        reconstructor=reconstructor,
        delay_ms=delay_ms,
        smooth=smooth,
    )
    results = output or folder.resolve().with_name(f"{folder.resolve().name}_batch")
    jobs = jobs_in(folder, results, task)
    manifest = Manifest(results)
    due = [job for job in jobs if again or not manifest.is_done(job)]
    outcomes: list[Outcome] = []
    bar = progress_bar(f"{len(due)} recordings", is_shown=not as_json)
    with contextlib.suppress(KeyboardInterrupt), bar as tell:
        tell(0, len(due))

        def done(job: Job, outcome: Outcome) -> None:
            manifest.add(job, outcome)
            outcomes.append(outcome)
            tell(len(outcomes), len(due))

        run_jobs(due, done, workers, dask)
    manifest.close()
    if len(outcomes) < len(due):
        left = len(due) - len(outcomes)
        typer.echo(
            f"interrupted: {len(outcomes)} done, {left} left; the same command goes on from there", err=True
        )
        raise typer.Exit(INTERRUPTED)
    _tell(outcomes, len(jobs) - len(due), results, as_json)


def _tell(outcomes: list[Outcome], skipped: int, results: Path, as_json: bool) -> None:
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
