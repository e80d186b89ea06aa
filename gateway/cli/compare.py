"""``mocap-gateway compare``: two sources of one motion, aligned in time and in the world, by segment."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import orjson
import typer

from gateway.agreement import Agreement, Tracks, agreement, tracks_of
from gateway.cli.diff import print_figures, recorded_arrays
from gateway.cli.options import BrokerChoice, seconds_of, with_broker
from gateway.errors import GatewayError
from gateway.report.angle_page import AnglePage, save_page

HEADS = (
    "segment", "frames", "as defined RMS °", "axes apart °", "RMS °", "inclination °", "heading °", "95 % °",
    "max °", "joint RMS °", "position mm",
)  # fmt: skip
_SMALL_DEG, _HALVED = 2.0, 0.6
"""Segments that differ by more than the first, and by less than so much of it with headings of their own."""
_DOUBTFUL = 0.7
"""A correlation below it: perhaps not the same motion."""


@with_broker
def compare(
    broker: BrokerChoice,
    first: Annotated[str, typer.Argument(help="Recording; with --live the name of a gateway.")],
    second: Annotated[str, typer.Argument(help="Recording of the same motion; with --live a gateway.")],
    pair: Annotated[
        list[str] | None,
        typer.Option(help="Segments of other names, first=second, such as thigh=left_thigh; repeatable."),
    ] = None,
    largest_lag: Annotated[
        float | None, typer.Option(min=0.0, help="Clocks are no further apart than this, s.")
    ] = None,
    span: Annotated[
        str | None,
        typer.Option(metavar="FROM:TO", help="Only these seconds of the first count: without a bad start."),
    ] = None,
    own_headings: Annotated[
        bool,
        typer.Option(
            "--own-headings", help="A heading for every segment: modules in a field that is not homogeneous."
        ),
    ] = False,
    plot: Annotated[
        Path | None, typer.Option(help="Write a picture (.png, .svg, .pdf) or a page with table (.html).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a script.")] = False,
    live: Annotated[
        bool, typer.Option("--live", help="Compare two running gateways, and publish the figures.")
    ] = False,
    window: Annotated[float, typer.Option(min=5.0, max=600.0, help="With --live: seconds compared.")] = 20.0,
    count: Annotated[int | None, typer.Option(min=1, help="With --live: end after so many.")] = None,
) -> None:
    """Compare two sources of one motion, such as optical and inertial: angles and places by segment.

    The clocks are aligned by how fast the segments turn, the worlds by one heading; a constant difference of
    a segment's axes is shown and taken off. With --live the figures go to mocap/FIRST/comparison, too.
    """
    renamed = _renamed(pair or [])
    if live:
        if span is not None or plot is not None:
            raise GatewayError("--span and --plot are for recordings: leave them out with --live")
        from gateway.cli.compare_live import Live, run_live  # noqa: PLC0415 - only here a broker is spoken to

        settings = broker.settings()
        wanted = Live(first, second, renamed, largest_lag, window, count, as_json, own_headings)
        raise typer.Exit(run_live(settings, wanted))
    _compare_files(Path(first), Path(second), renamed, largest_lag, span, own_headings, plot, as_json)


def _compare_files(
    first: Path,
    second: Path,
    renamed: dict[str, str],
    largest_lag: float | None,
    span: str | None,
    own_headings: bool,
    plot: Path | None,
    as_json: bool,
) -> None:
    counted = None if span is None else seconds_of("--span", span)
    tracks = _of_files(first, second, not as_json)
    found = agreement(*tracks, renamed, largest_lag, counted, own_headings=own_headings)
    _show(found, first, second, plot, as_json)
    if not own_headings:
        _hint(found, agreement(*tracks, renamed, largest_lag, counted, own_headings=True))


def _hint(found: Agreement, separate: Agreement) -> None:
    """Say so where one heading for all is what makes the two differ."""
    before, after = (np.nanmean([figures.rms_deg for figures in each.segments]) for each in (found, separate))
    if before > _SMALL_DEG and after < _HALVED * before:
        apart = np.ptp([figures.own_heading_deg for figures in separate.segments])
        typer.echo(
            f"note: headings of the segments differ by up to {apart:.0f}°; with --own-headings the mean RMS "
            f"is {after:.1f}° and not {before:.1f}°",
            err=True,
        )


def _show(found: Agreement, first: Path, second: Path, plot: Path | None, as_json: bool) -> None:
    if plot is not None:
        save_page(_page(found, f"{first.name} against {second.name}"), plot)
    if as_json:
        typer.echo(as_json_text(found))
        return
    for note in notes(found):
        typer.echo(note)
    print_figures(HEADS, rows(found))
    for path, only in ((first, found.only_in_first), (second, found.only_in_second)):
        if only:
            typer.echo(f"only in {path.name}: {', '.join(only)}", err=True)
    if plot is not None:
        typer.echo(f"plot written to {plot}")


def _renamed(pairs: list[str]) -> dict[str, str]:
    """Raises ``GatewayError`` for what is not ``first=second``."""
    split = [pair.split("=") for pair in pairs]
    for pair, names in zip(pairs, split, strict=True):
        if len(names) != 2 or not all(names):
            raise GatewayError(f"--pair {pair}: write first=second, such as --pair thigh=left_thigh")
    return dict(split)


def _of_files(first: Path, second: Path, is_shown: bool) -> tuple[Tracks, Tracks]:
    arrays = [recorded_arrays(path, is_shown) for path in (first, second)]
    origin_ns = int(arrays[0].time_ns[0]) if len(arrays[0].time_ns) else 0
    return tracks_of(arrays[0], origin_ns, str(first)), tracks_of(arrays[1], origin_ns, str(second))


def notes(found: Agreement) -> list[str]:
    """What was aligned, as sentences."""
    drift = f", and runs {found.time.drift_ppm:+.1f} ppm against it" if found.time.drift_ppm else ""
    said = [
        f"The second's clock shows {found.time.lag_s:+.4f} s more than the first's{drift} "
        f"(correlation {found.time.correlation:.3f}); the second's world is turned by "
        f"{found.heading_deg:+.1f}° about the vertical; {len(found.time_s)} instants."
    ]
    if any(figures.own_heading_deg for figures in found.segments):
        own = ", ".join(f"{figures.segment} {figures.own_heading_deg:+.1f}°" for figures in found.segments)
        said.append(f"Headings beside that, taken off too: {own}.")
    if found.time.correlation < _DOUBTFUL:
        said.append("The two correlate poorly: perhaps they are not of the same motion.")
    return said


def rows(found: Agreement) -> list[tuple[str, ...]]:
    """The table, in the columns of ``HEADS``, numbers as text."""
    return [
        (
            figures.segment,
            str(figures.frames),
            *(
                "–" if np.isnan(value) else f"{value:.2f}"
                for value in (
                    figures.as_defined_rms_deg,
                    figures.axes_apart_deg,
                    figures.rms_deg,
                    figures.inclination_rms_deg,
                    figures.heading_rms_deg,
                    figures.p95_deg,
                    figures.max_deg,
                    figures.joint_rms_deg,
                )
            ),
            "–" if np.isnan(figures.position_rms_m) else f"{1e3 * figures.position_rms_m:.1f}",
        )
        for figures in found.segments
    ]


def as_json_text(found: Agreement) -> str:
    """All figures; what is not known is null."""
    return orjson.dumps(
        {
            "time": asdict(found.time),
            "heading_deg": found.heading_deg,
            "instants": len(found.time_s),
            "segments": [asdict(figures) for figures in found.segments],
            "only_in_first": found.only_in_first,
            "only_in_second": found.only_in_second,
        },
        option=orjson.OPT_INDENT_2,
    ).decode()


def _page(found: Agreement, title: str) -> AnglePage:
    return AnglePage(
        title, tuple(notes(found)), found.time_s, found.angle_deg, found.segment_names, HEADS, rows(found)
    )
