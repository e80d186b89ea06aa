"""``mocap-gateway diff``: two results of one session, in degrees by segment."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from gateway.cli.modules_table import wide_console
from gateway.cli.progress import progress_bar
from gateway.recording import SkeletonArrays, open_recording
from gateway.recording.difference import difference
from gateway.recording.difference_plot import HEADS, rows, save_plot


def diff(
    first: Annotated[Path, typer.Argument(help="Recording.")],
    second: Annotated[Path, typer.Argument(help="Recording of the same session, solved otherwise.")],
    plot: Annotated[
        Path | None, typer.Option(help="Write a picture (.png, .svg, .pdf) or a page with table (.html).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a script.")] = False,
) -> None:
    """Compare the poses of two recordings: angle between the orientations, by segment.

    Poses belong together by their time. Plots need the extra `plot` (matplotlib).
    """
    found = difference(_arrays(first, not as_json), _arrays(second, not as_json))
    if plot is not None:
        save_plot(found, plot, f"{first.name} against {second.name}")
    if as_json:
        figures = [asdict(segment) for segment in found.segments]
        typer.echo(json.dumps({"frames": len(found.time_s), "segments": figures}, indent=2))
        return
    table = Table(*HEADS)
    for column in table.columns[1:]:
        column.justify = "right"
    for row in rows(found):
        table.add_row(*row)
    wide_console().print(table)
    for name, only in ((first, found.only_in_first), (second, found.only_in_second)):
        if only:
            typer.echo(f"only in {name}: {', '.join(only)}", err=True)
    if plot is not None:
        typer.echo(f"plot written to {plot}")


def _arrays(path: Path, is_shown: bool) -> SkeletonArrays:
    with progress_bar(f"reading {path.name}", is_shown=is_shown) as tell:
        return open_recording(path).skeleton_arrays(tell)
