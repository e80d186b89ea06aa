"""``modules card``: what a relay has recorded while no gateway was there."""

from __future__ import annotations

import base64
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TimeRemainingColumn, TransferSpeedColumn
from rich.table import Table

from devices.commands.card import CardFile, convert_card_file, download
from devices.link import gateway_time_ns
from devices.recording_writer import refuse_other_name
from gateway.cli.modules_suit import Operations, SuitChoice, run_with_suit, with_suit
from gateway.cli.options import AsJson
from gateway.cli.terminal import wide_console
from gateway.errors import GatewayError
from gateway.support.whole_files import writing

_READ_AT_ONCE = 12 * 192

Device = Annotated[str, typer.Option(help="Whose card: 'relay', a module id or a unique id.")]

card_app = typer.Typer(
    help="Files on the memory card of a relay.",
    epilog="Examples: mocap-gateway modules card list -c my.yaml; mocap-gateway modules card download --help",
    no_args_is_help=True,
)


@with_suit
def list_files(
    suit: SuitChoice,
    device: Device = "relay",
    as_json: AsJson = False,
) -> None:
    """List the files on the card."""

    async def work(operations: Operations) -> int:
        listed = await operations.perform("card_list", {"device": device})
        if as_json:
            typer.echo(json.dumps(listed))
            return 0
        table = Table()
        for column in ("file", "bytes", "relay's clock at its start, s", "checksum"):
            table.add_column(column, justify="right")
        for file in listed["files"]:
            start_s = f"{file['start_time_us'] * 1e-6:.1f}"
            table.add_row(str(file["file"]), f"{file['size']:,}", start_s, f"{file['crc32']:08x}")
        wide_console().print(table)
        return 0

    run_with_suit(suit, work)


@with_suit
def start_recording(suit: SuitChoice, device: Device = "relay") -> None:
    """Begin to record on the card, in a new file."""
    _order(suit, "card_start", {"device": device}, "the card records")


@with_suit
def stop_recording(suit: SuitChoice, device: Device = "relay") -> None:
    """End the recording on the card."""
    _order(suit, "card_stop", {"device": device}, "the card has stopped recording")


@with_suit
def download_file(
    suit: SuitChoice,
    file: Annotated[int, typer.Argument(min=0, max=0xFFFE, help="Number of the file.")],
    target: Annotated[Path, typer.Argument(help="Recording to write; what has come so far is beside it.")],
    device: Device = "relay",
    raw: Annotated[bool, typer.Option("--raw", help="Keep the bytes of the card as they are.")] = False,
    started: Annotated[
        datetime | None,
        typer.Option(help="When the file was begun (UTC); default: so that it ends now."),
    ] = None,
) -> None:
    """Fetch a file and turn it into a recording that replays like a live suit.

    A download that was cut goes on where it stopped when it is started again. The checksum is verified.
    """
    if not raw:  # said before a download of minutes
        refuse_other_name(target)
    # Beside the target, so that an interrupted download finds what it has already.
    fetched = target if raw else target.with_name(target.name + ".card")

    async def work(operations: Operations) -> int:
        listed = await operations.perform("card_list", {"device": device})
        entry = _entry(listed["files"], file)
        await _fetch(operations, device, entry, fetched)
        if raw:
            typer.echo(f"{target}: {entry.size} bytes, checksum {entry.crc32:08x} verified")
            return 0
        start_ns = None if started is None else round(started.replace(tzinfo=UTC).timestamp() * 1e9)
        with writing(target):
            made = convert_card_file(fetched, target, start_ns=start_ns, end_ns=gateway_time_ns())
        # Only now: until the recording is whole, the fetched file is all there is.
        fetched.unlink()
        damaged = f", {made.dropped} damaged wire frames left out" if made.dropped else ""
        typer.echo(
            f"{target}: {made.duration_s:.1f} s, {made.chunks} chunks, checksum verified{damaged}\n"
            f"play it as a link with the url recording://{target.resolve()}?speed=max"
        )
        return 0

    run_with_suit(suit, work)


@with_suit
def erase(
    suit: SuitChoice,
    file: Annotated[int | None, typer.Argument(min=0, max=0xFFFE, help="Number of the file.")] = None,
    every: Annotated[bool, typer.Option("--all", help="All files.")] = False,
    device: Device = "relay",
) -> None:
    """Erase a file of the card, or all. Needs --allow-writes."""
    if (file is None) != every:
        raise GatewayError("which file? give its number, or --all")
    outcome = "all files are erased" if every else f"file {file} is erased"
    _order(suit, "card_erase", {"device": device, "file": file}, outcome)


def _order(suit: SuitChoice, operation: str, wanted: dict[str, object], outcome: str) -> None:
    """Have the relay do something with its card, and print what came of it."""

    async def work(operations: Operations) -> int:
        await operations.perform(operation, wanted)
        typer.echo(outcome)
        return 0

    run_with_suit(suit, work)


async def _fetch(operations: Operations, device: str, entry: CardFile, target: Path) -> None:
    async def read(file: int, offset: int, length: int) -> bytes:
        wanted = {"device": device, "file": file, "offset": offset, "length": length}
        return base64.b64decode((await operations.perform("card_read", wanted))["data"])

    columns = (BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=wide_console(), transient=True) as progress:
        task = progress.add_task("", total=entry.size)
        with writing(target):
            await download(
                read, entry, target, lambda done: progress.update(task, completed=done), step=_READ_AT_ONCE
            )


def _entry(files: list[dict[str, Any]], wanted: int) -> CardFile:
    entries = {file["file"]: CardFile(**file) for file in files}
    if wanted not in entries:
        raise GatewayError(
            f"the card has no file {wanted}; it has: {', '.join(map(str, entries)) or 'none at all'}"
        )
    return entries[wanted]


_EXAMPLE = "Example: mocap-gateway modules card"
card_app.command("list", epilog=f"{_EXAMPLE} list -c my.yaml")(list_files)
card_app.command("start", epilog=f"{_EXAMPLE} start -c my.yaml")(start_recording)
card_app.command("stop", epilog=f"{_EXAMPLE} stop -c my.yaml")(stop_recording)
card_app.command("download", epilog=f"{_EXAMPLE} download 3 walk.chunks -c my.yaml")(download_file)
card_app.command("erase", epilog=f"{_EXAMPLE} erase 3 -c my.yaml --allow-writes")(erase)
