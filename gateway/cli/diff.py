"""``mocap-gateway diff``: two results of one session, in degrees by segment."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import orjson
import typer
from rich.table import Table

from gateway.cli.terminal import progress_bar, wide_console
from gateway.recording import SkeletonArrays, open_recording
from gateway.recording.difference import Difference, difference
from gateway.report.angle_page import AnglePage, save_page

HEADS = ("segment", "frames", "mean °", "RMS °", "95 % °", "max °", "inclination RMS °", "heading RMS °")


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
    found = difference(recorded_arrays(first, not as_json), recorded_arrays(second, not as_json))
    if plot is not None:
        save_page(page(found, f"{first.name} against {second.name}"), plot)
    if as_json:
        figures = {"frames": len(found.time_s), "segments": [asdict(segment) for segment in found.segments]}
        typer.echo(orjson.dumps(figures, option=orjson.OPT_INDENT_2).decode())
        return
    print_figures(HEADS, _rows(found))
    for name, only in ((first, found.only_in_first), (second, found.only_in_second)):
        if only:
            typer.echo(f"only in {name}: {', '.join(only)}", err=True)
    if plot is not None:
        typer.echo(f"plot written to {plot}")


def print_figures(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """A table of numbers, a row a segment."""
    table = Table(*heads)
    for column in table.columns[1:]:
        column.justify = "right"
    for row in rows:
        table.add_row(*row)
    wide_console().print(table)


def recorded_arrays(path: Path, is_shown: bool) -> SkeletonArrays:
    """The poses of a recording, with a progress bar if wanted. Raises ``GatewayError``."""
    with progress_bar(f"reading {path.name}", is_shown=is_shown) as tell:
        return open_recording(path).skeleton_arrays(tell)


def page(found: Difference, title: str) -> AnglePage:
    """The difference as a page to be saved."""
    return AnglePage(title, (), found.time_s, found.angle_deg, found.segment_names, HEADS, _rows(found))


def _rows(found: Difference) -> list[tuple[str, ...]]:
    """The table, in the columns of ``HEADS``, numbers as text."""
    return [
        (
            figures.segment,
            str(figures.frames),
            *(
                f"{value:.3f}"
                for value in (
                    figures.mean_deg,
                    figures.rms_deg,
                    figures.p95_deg,
                    figures.max_deg,
                    figures.inclination_rms_deg,
                    figures.heading_rms_deg,
                )
            ),
        )
        for figures in found.segments
    ]
