"""``mocap-gateway recordings``, ``info`` and ``recover``: what there is, what is in it, and repair."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from devices.recording_file import RecordingError
from gateway.cli.options import AsJson
from gateway.cli.terminal import progress_bar, wide_console
from gateway.errors import GatewayError
from gateway.support.names import printable
from gateway.support.whole_files import writing

if TYPE_CHECKING:
    from gateway.recording import RecordingMeta
    from gateway.recording.summary import RecordingSummary


def recordings(
    folder: Annotated[Path, typer.Argument(help="Folder to look in.")] = Path("recordings"),
    as_json: AsJson = False,
) -> None:
    """List the recordings of a folder: when, how long, how large, modules, loss."""
    from gateway.recording.summary import recordings_in, summarise

    # A file that cannot be read stops no other: it is named below the table.
    found = list(recordings_in(folder))
    summaries = [summarise(each) for each in found if not isinstance(each, RecordingError)]
    problems = [str(each) for each in found if isinstance(each, RecordingError)]
    if as_json:
        typer.echo(json.dumps([_plain(summary) for summary in summaries], indent=2))
    elif not summaries:
        typer.echo(f"no recordings in {folder}")
    else:
        table = Table("file", "begun (UTC)", "duration", "MB", "modules", "loss", "")
        for column in (2, 3, 4, 5):
            table.columns[column].justify = "right"
        for summary in summaries:
            table.add_row(*map(_text, _row(summary)))
        wide_console().print(table)
    for problem in problems:
        typer.echo(f"left out: {printable(problem)}", err=True)


def info(
    file: Annotated[Path, typer.Argument(help="Recording.")],
    extract: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Write rig, body, configuration and the rest as files there."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what is in a recording: settings, suit, software, channels, losses, events."""
    from gateway.recording import open_recording
    from gateway.recording.summary import summarise

    recording = open_recording(file)
    summary = summarise(recording)
    if extract is not None:
        _extract(recording.meta.attachments, extract)
    events = list(recording.events())
    summary.defect = summary.defect or recording.defect  # an index may be good and what it points to not
    if as_json:
        more = {"software": recording.meta.software, "host": recording.meta.host}
        happened = [event._asdict() for event in events]
        typer.echo(json.dumps(_plain(summary) | more | {"events": happened}, indent=2))
        return
    console = wide_console()
    console.print(_overview(recording.meta, summary))
    _print_modules(summary, console)
    for event in events:
        elapsed_s = (event.time_ns - recording.meta.begun_ns) * 1e-9
        console.print(f"{elapsed_s:9.3f} s  {printable(f'{event.name}  {event.data}')}", markup=False)
    if summary.defect is not None:
        console.print(_text(summary.defect), style="yellow", soft_wrap=True)


def recover(
    file: Annotated[Path, typer.Argument(help="Recording that was cut off or damaged.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Default: NAME.recovered.mcap beside it.")
    ] = None,
    in_place: Annotated[bool, typer.Option("--in-place", help="Replace the file.")] = False,
) -> None:
    """Make a whole file of all that can be read of one: after a kill, a power cut or a full disk.

    `replay`, `info` and the rest read such files as they are; other MCAP tools want the index that this
    writes.
    """
    from gateway.recording.recovery import recover as recover_file
    from gateway.recording.recovery import recover_in_place

    if in_place and output is not None:
        raise GatewayError("--in-place or --output: not both")
    with progress_bar("recovering") as progress:
        if in_place:
            done = recover_in_place(file, progress)
        else:
            done = recover_file(
                file, output or file.with_name(f"{file.stem}.recovered{file.suffix}"), progress
            )
    typer.echo(f"{done.path}: {done.messages} messages; {done.defect or 'nothing was wrong with it'}")


def _row(summary: RecordingSummary) -> tuple[str, ...]:
    loss = summary.loss_percent
    notes = [f"{summary.parts} files"] if summary.parts > 1 else []
    notes += ["not closed: see `recover`"] if summary.defect is not None else []
    minutes, seconds = divmod(round(summary.duration_s), 60)
    return (
        Path(summary.path).name,
        _when(summary.begun_utc_ns),
        f"{minutes}:{seconds:02d}",
        f"{summary.bytes / 1e6:.1f}",
        str(summary.n_modules) if summary.modules else "?",
        "?" if loss is None else f"{loss:.2f} %",
        ", ".join(notes),
    )


def _overview(meta: RecordingMeta, summary: RecordingSummary) -> Table:
    rows: dict[str, str] = {}
    rows["file"] = summary.path + (f" and {summary.parts - 1} more" if summary.parts > 1 else "")
    rows["begun"] = f"{_when(summary.begun_utc_ns)} UTC"
    rows["duration"] = f"{summary.duration_s:.1f} s, {summary.bytes / 1e6:.1f} MB"
    if meta.has_suit:
        rows["suit"] = f"{len(meta.suit.module_ids)} modules on body '{meta.skeleton.name}'"
        delay_ms = meta.settings.reconstructor_delay_ms
        rows["reconstructor"] = meta.settings.reconstructor + (f", {delay_ms:g} ms late" if delay_ms else "")
    rows["links"] = ", ".join(f"{name} ({content})" for name, content in meta.links.items())
    rows["software"] = f"{meta.software}, Python {meta.host.get('python', '?')}"
    whole = "from the gateway's start: bit-identical" if meta.from_start else "began while the gateway ran"
    rows["replay"] = whole
    for topic, count in sorted(summary.messages.items()):
        rows[topic] = str(count)
    rows["attachments"] = ", ".join(meta.attachments)

    grid = Table.grid(padding=(0, 2))
    for name, value in rows.items():
        grid.add_row(_text(name), _text(value))
    return grid


def _text(text: str) -> Text:
    """Return plain text, neither obeyed by the terminal nor taken for markup: the file may be anybody's."""
    return Text(printable(text))


def _print_modules(summary: RecordingSummary, console: Console) -> None:
    if not summary.modules:
        return
    table = Table("module", "received", "lost", "loss")
    for module, counts in summary.modules.items():
        sent = counts["received"] + counts["lost"]
        share = f"{100 * counts['lost'] / sent:.2f} %" if sent else "?"
        table.add_row(module, str(counts["received"]), str(counts["lost"]), share)
    console.print(table)


def _extract(attachments: Mapping[str, bytes], folder: Path) -> None:
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in attachments.items():
            (folder / Path(name).name).write_bytes(data)


def _plain(summary: RecordingSummary) -> dict[str, object]:
    return asdict(summary) | {"loss_percent": summary.loss_percent}


def _when(utc_ns: int) -> str:
    try:
        return datetime.fromtimestamp(utc_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S") if utc_ns else "?"
    except (ValueError, OverflowError, OSError):  # a damaged one
        return "?"
