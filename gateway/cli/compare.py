"""``mocap-gateway compare``: two sources of one motion aligned, two results of one session as they stand."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import orjson
import typer
from rich.console import Console, Group
from rich.live import Live as LiveTable
from rich.table import Table
from rich.text import Text

from gateway.cli.options import AsJson, BrokerChoice, seconds_of, with_broker
from gateway.cli.terminal import progress_bar, wide_console
from gateway.contract.topics import Topics
from gateway.errors import GatewayError
from gateway.outputs.settings import MqttSettings

if TYPE_CHECKING:
    from gateway.agreement import Agreement, Tracks
    from gateway.agreement.live import PoseWindow
    from gateway.contract.messages import ComparisonMessage
    from gateway.outputs.subscriber import PoseSubscriber
    from gateway.recording import SkeletonArrays
    from gateway.recording.difference import Difference
    from gateway.report.angle_page import AnglePage


_HEADS = (
    "segment", "frames", "as defined RMS °", "axes apart °", "RMS °", "inclination °", "heading °", "95 % °",
    "max °", "joint RMS °", "position mm",
)  # fmt: skip
_SESSION_HEADS = (
    "segment", "frames", "mean °", "RMS °", "95 % °", "max °", "inclination RMS °", "heading RMS °",
)  # fmt: skip
_SMALL_DEG, _HALVED = 2.0, 0.6
"""Segments that differ by more than the first, and by less than so much of it with headings of their own."""
_DOUBTFUL = 0.7
"""A correlation below it: perhaps not the same motion."""
_EVERY_S = 1.0

Files = tuple[Path, Path]
"""Two recordings."""


@dataclass(frozen=True)
class Alignment:
    """How two sources of one motion are brought together."""

    renamed: Mapping[str, str] = field(default_factory=dict)
    """The first's segments that the second calls otherwise."""
    largest_lag_s: float | None = None
    span_s: tuple[float, float] | None = None
    own_headings: bool = False

    def compare(self, first: Tracks, second: Tracks) -> Agreement:
        """Return how far two sources agree. Raises ``GatewayError`` as ``agreement`` does."""
        from gateway.agreement import agreement

        return agreement(
            first, second, self.renamed, self.largest_lag_s, self.span_s, own_headings=self.own_headings
        )


@with_broker
def compare(
    broker: BrokerChoice,
    first: Annotated[str, typer.Argument(help="Recording; with --live the name of a gateway.")],
    second: Annotated[str, typer.Argument(help="Recording of the same motion; with --live a gateway.")],
    same_session: Annotated[
        bool,
        typer.Option("--same-session", help="Two results of one session: poses by their time, unaligned."),
    ] = False,
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
    as_json: AsJson = False,
    live: Annotated[
        bool, typer.Option("--live", help="Compare two running gateways, and publish the figures.")
    ] = False,
    window: Annotated[float, typer.Option(min=5.0, max=600.0, help="With --live: seconds compared.")] = 20.0,
    count: Annotated[int | None, typer.Option(min=1, help="With --live: end after so many.")] = None,
) -> None:
    """Compare two sources of one motion, or two results of one session: angles and places by segment.

    Of two sources, such as optical and inertial, the clocks are aligned by how fast the segments turn, the
    worlds by one heading; a constant difference of a segment's axes is shown and taken off. With --live the
    figures go to mocap/FIRST/comparison, too.

    With --same-session nothing is aligned: for a recording and what `replay` made of it with another rig or
    method. Poses belong together by their time. Plots need the extra `plot` (matplotlib).
    """
    aligning = {"--pair": pair, "--largest-lag": largest_lag, "--span": span, "--own-headings": own_headings}
    if same_session:
        _refuse("--same-session", {**aligning, "--live": live})
        _compare_results((Path(first), Path(second)), plot, as_json)
        return
    alignment = Alignment(
        _renamed(pair or []), largest_lag, None if span is None else seconds_of("--span", span), own_headings
    )
    if live:
        _refuse("--live", {"--span": span, "--plot": plot})
        wanted = Live(first, second, alignment, window, count, as_json)
        raise typer.Exit(run_live(broker.settings(), wanted))
    _compare_sources((Path(first), Path(second)), alignment, plot, as_json)


def _refuse(option: str, given: Mapping[str, object]) -> None:
    """Raise ``GatewayError`` for an option that says nothing beside ``option``."""
    for other, value in given.items():
        if value is not None and value is not False:
            raise GatewayError(f"{other} says nothing with {option}: leave one of them out")


def _recorded(path: Path, is_shown: bool) -> SkeletonArrays:
    """Return the poses of a recording, with a progress bar if wanted. Raises ``GatewayError``."""
    from gateway.recording import open_recording

    with progress_bar(f"reading {path.name}", is_shown=is_shown) as progress:
        return open_recording(path).skeleton_arrays(progress)


def _compare_results(files: Files, plot: Path | None, as_json: bool) -> None:
    """Compare two results of one session without aligning them."""
    from gateway.recording.difference import difference

    first, second = (_recorded(path, not as_json) for path in files)
    found = difference(first, second)
    plain = {
        "frames": len(found.time_s),
        "segments": [asdict(segment) for segment in found.segments],
        "only_in_first": found.only_in_first,
        "only_in_second": found.only_in_second,
    }
    _show(difference_page(found, _title(files)), plain, files, plot, as_json)


def _compare_sources(files: Files, alignment: Alignment, plot: Path | None, as_json: bool) -> None:
    """Compare two sources of one motion, aligned; note if headings of their own would make them agree."""
    tracks = _tracks_of_files(files, not as_json)
    found = alignment.compare(*tracks)
    _show(_agreement_page(found, _title(files)), _plain(found), files, plot, as_json)
    if not alignment.own_headings:
        _hint(found, replace(alignment, own_headings=True).compare(*tracks))


def _title(files: Files) -> str:
    return f"{files[0].name} against {files[1].name}"


def _show(page: AnglePage, plain: Mapping[str, Any], files: Files, plot: Path | None, as_json: bool) -> None:
    """Save the page, and print it as a table or all figures as JSON; what is not known is null."""
    from gateway.report.angle_page import save_page

    if plot is not None:
        save_page(page, plot)
    if as_json:
        typer.echo(orjson.dumps(plain, option=orjson.OPT_INDENT_2).decode())
        return
    for note in page.notes:
        typer.echo(note)
    wide_console().print(_table(page.heads, page.rows))
    for path, only in zip(files, (plain["only_in_first"], plain["only_in_second"]), strict=True):
        if only:
            typer.echo(f"only in {path.name}: {', '.join(only)}", err=True)
    if plot is not None:
        typer.echo(f"plot written to {plot}")


def _table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> Table:
    """Return a table of numbers, a row a segment."""
    table = Table(*heads)
    for column in table.columns[1:]:
        column.justify = "right"
    for row in rows:
        table.add_row(*row)
    return table


def _renamed(pairs: list[str]) -> dict[str, str]:
    """Return names by name from ``first=second``. Raises ``GatewayError`` for other texts."""
    split = [pair.split("=") for pair in pairs]
    for pair, names in zip(pairs, split, strict=True):
        if len(names) != 2 or not all(names):
            raise GatewayError(f"--pair {pair}: write first=second, such as --pair thigh=left_thigh")
    return dict(split)


def _tracks_of_files(files: Files, is_shown: bool) -> tuple[Tracks, Tracks]:
    from gateway.agreement import tracks_of

    first, second = (_recorded(path, is_shown) for path in files)
    origin_ns = int(first.time_ns[0]) if len(first.time_ns) else 0
    return tracks_of(first, origin_ns, str(files[0])), tracks_of(second, origin_ns, str(files[1]))


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


def _notes(found: Agreement) -> list[str]:
    """Return what was aligned, as sentences."""
    drift = f", and runs {found.time.drift_ppm:+.1f} ppm against it" if found.time.drift_ppm else ""
    lines = [
        f"The second's clock shows {found.time.lag_s:+.4f} s more than the first's{drift} "
        f"(correlation {found.time.correlation:.3f}); the second's world is turned by "
        f"{found.heading_deg:+.1f}° about the vertical; {len(found.time_s)} instants."
    ]
    if any(figures.own_heading_deg for figures in found.segments):
        own = ", ".join(f"{figures.segment} {figures.own_heading_deg:+.1f}°" for figures in found.segments)
        lines.append(f"Headings beside that, taken off too: {own}.")
    if found.time.correlation < _DOUBTFUL:
        lines.append("The two correlate poorly: perhaps they are not of the same motion.")
    return lines


def _number(value: float, decimals: int) -> str:
    """Return a number as text; a dash for one that is not known."""
    return "–" if np.isnan(value) else f"{value:.{decimals}f}"


def _rows(found: Agreement) -> list[tuple[str, ...]]:
    """Return the table, in the columns of ``_HEADS``, numbers as text."""
    return [
        (
            figures.segment,
            str(figures.frames),
            *(
                _number(value, 2)
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
            _number(1e3 * figures.position_rms_m, 1),
        )
        for figures in found.segments
    ]


def _plain(found: Agreement) -> dict[str, Any]:
    """Return all figures, for JSON."""
    return {
        "time": asdict(found.time),
        "heading_deg": found.heading_deg,
        "instants": len(found.time_s),
        "segments": [asdict(figures) for figures in found.segments],
        "only_in_first": found.only_in_first,
        "only_in_second": found.only_in_second,
    }


def _agreement_page(found: Agreement, title: str) -> AnglePage:
    from gateway.report.angle_page import AnglePage

    return AnglePage(
        title, tuple(_notes(found)), found.time_s, found.angle_deg, found.segment_names, _HEADS, _rows(found)
    )


def difference_page(found: Difference, title: str) -> AnglePage:
    """Return the difference of two results of one session as a page."""
    from gateway.report.angle_page import AnglePage

    rows = [
        (
            figures.segment,
            str(figures.frames),
            *(
                _number(value, 3)
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
    return AnglePage(title, (), found.time_s, found.angle_deg, found.segment_names, _SESSION_HEADS, rows)


@dataclass(frozen=True)
class Live:
    """Which two running gateways to compare every second over the last ones, and until when."""

    first: str
    second: str
    alignment: Alignment
    window_s: float
    count: int | None
    as_json: bool


def run_live(settings: MqttSettings, wanted: Live) -> int:
    """Return the exit code: 0 on Ctrl-C or when done, 1 after one line if the broker cannot be used."""
    from gateway.outputs.failover import BrokerUnreachableError

    try:
        topics = [Topics(settings.base_topic, name) for name in (wanted.first, wanted.second)]
        asyncio.run(_compare_live(settings, wanted, topics[0]))
    except KeyboardInterrupt:
        return 0
    except (BrokerUnreachableError, ValueError) as error:
        typer.echo(str(error), err=True)
        return 1
    return 0


async def _compare_live(settings: MqttSettings, wanted: Live, topics: Topics) -> None:
    from gateway.agreement.live import PoseWindow
    from gateway.outputs.subscriber import PoseSubscriber

    windows = {name: PoseWindow(wanted.window_s) for name in (wanted.first, wanted.second)}
    async with PoseSubscriber(settings) as poses:
        collecting = asyncio.create_task(_collect(poses, windows))
        try:
            await _print_comparisons(settings, wanted, topics, poses, windows)
        finally:
            collecting.cancel()


async def _collect(poses: PoseSubscriber, windows: Mapping[str, PoseWindow]) -> None:
    async for received in poses:
        if received.gateway in windows:
            windows[received.gateway].add(received.pose)


async def _print_comparisons(
    settings: MqttSettings,
    wanted: Live,
    topics: Topics,
    poses: PoseSubscriber,
    windows: Mapping[str, PoseWindow],
) -> None:
    from gateway.agreement.live import comparison_message

    printed, console = 0, Console()
    with LiveTable(console=console, auto_refresh=False, screen=False) as table:
        while wanted.count is None or printed < wanted.count:
            await asyncio.sleep(_EVERY_S)
            found = await _found(wanted, poses, windows)
            if isinstance(found, str):
                _show_live(table, wanted, Text(found, "yellow"))
                continue
            printed += 1
            message = comparison_message(
                found, windows[wanted.first].newest_ns, wanted.second, wanted.window_s
            )
            problem = await _publish(settings, topics, message)
            if wanted.as_json:
                typer.echo(message.payload().decode())
            else:
                _show_live(
                    table,
                    wanted,
                    _agreement_screen(found, problem),
                )


async def _found(wanted: Live, poses: PoseSubscriber, windows: Mapping[str, PoseWindow]) -> Agreement | str:
    """Return the agreement over the window, or why there is none."""
    from gateway.agreement.time_alignment import SHORTEST_OVERLAP_S

    for name, window in windows.items():
        if name not in poses.bodies or window.duration_s < SHORTEST_OVERLAP_S:
            return f"waiting for poses of gateway '{name}' ({poses.states.get(name, 'not heard of')})"
    origin_ns = windows[wanted.first].newest_ns
    first, second = (windows[name].tracks(poses.bodies[name], origin_ns) for name in windows)
    try:
        # In a thread, as poses arrive while it computes.
        return await asyncio.to_thread(wanted.alignment.compare, first, second)
    except GatewayError as error:
        return str(error)


async def _publish(settings: MqttSettings, topics: Topics, message: ComparisonMessage) -> list[str]:
    """Return what went wrong, if anything: a broker that refuses does not end the comparison."""
    import aiomqtt

    from gateway.outputs.failover import BrokerUnreachableError, any_connection

    try:
        async with any_connection(settings, "compare") as (client, _):
            await client.publish(topics.comparison, message.payload())
    except (BrokerUnreachableError, aiomqtt.MqttError) as error:
        return [f"not published: {error}"]
    return []


def _agreement_screen(found: Agreement, problem: list[str]) -> Group:
    return Group(Text("\n".join([*_notes(found), *problem])), _table(_HEADS, _rows(found)))


def _show_live(table: LiveTable, wanted: Live, content: Text | Group) -> None:
    if not wanted.as_json:
        table.update(content, refresh=True)
    elif isinstance(content, Text):
        typer.echo(content.plain, err=True)
