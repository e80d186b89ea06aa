"""``modules list``, ``modules watch`` and ``modules identify``: who is there, and which is which."""

from __future__ import annotations

import json
import sys
from typing import Annotated

import typer
from rich.live import Live

from gateway.cli.modules_suit import Operations, SuitChoice, run_with_suit, with_suit
from gateway.cli.modules_table import WIDEST, modules_screen, wide_console

Wide = Annotated[
    bool, typer.Option("--wide", help="Firmware, gaps, resets and clocks too; takes 150 columns.")
]


@with_suit
def list_modules(
    suit: SuitChoice,
    listen: Annotated[
        float, typer.Option(min=0.5, max=30, help="Seconds to measure rates; clocks (ppm) need some 10.")
    ] = 3.0,
    wide: Wide = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a script.")] = False,
) -> None:
    """List the modules that can be heard. Ends with 1 when two of them share an id."""

    async def work(operations: Operations) -> int:
        listed = await operations.perform("list", {"listen_s": listen})
        if as_json:
            typer.echo(json.dumps(listed))
        else:
            wide_console(WIDEST if wide else 0).print(modules_screen(listed, wide))
        return 1 if listed["conflicts"] else 0

    run_with_suit(suit, work)


@with_suit
def watch_modules(
    suit: SuitChoice,
    count: Annotated[int | None, typer.Option(min=1, help="End after so many tables.")] = None,
    wide: Wide = False,
) -> None:
    """Show the list live, until Ctrl-C."""

    async def work(operations: Operations) -> int:
        console, shown = wide_console(), 0
        with Live(console=console, auto_refresh=False) as live:
            while count is None or shown < count:
                screen = modules_screen(await operations.perform("list", {"listen_s": 1.0}), wide)
                live.update(screen, refresh=True)
                shown += 1
        return 0

    run_with_suit(suit, work)


@with_suit
def identify(
    suit: SuitChoice,
    device: Annotated[str, typer.Argument(help="Module id, 'relay', or the beginning of a unique id.")],
    seconds: Annotated[int, typer.Option(min=0, max=255, help="How long it blinks; 0 stops it.")] = 5,
) -> None:
    """Make a module blink, to see which one it is."""

    async def work(operations: Operations) -> int:
        found = await operations.perform("identify", {"device": device, "seconds": seconds})
        what = f"blinks for {seconds} s" if seconds else "has stopped blinking"
        sys.stdout.write(f"module {found['module']} (unique id {found['unique_id']}) {what}\n")
        return 0

    run_with_suit(suit, work)
