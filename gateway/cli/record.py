"""``mocap-gateway record``: the service, recording."""

from __future__ import annotations

import asyncio
import logging
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.live import Live
from rich.table import Table

from gateway.body.rig import load_rig
from gateway.cli.compiling import told_when_compiling
from gateway.cli.preparing import make_ready
from gateway.cli.run import until_signal
from gateway.service.service import Service
from gateway.settings import GatewaySettings, fitting_suit, load_gateway_settings
from gateway.support.log_format import set_up_logging

REFRESH_S = 0.5


def record(
    config: Annotated[Path, typer.Option("--config", "-c", help="Configuration file.")] = Path(
        "config/gateway.yaml"
    ),
    name: Annotated[str | None, typer.Option(help="Added to the file's name.")] = None,
    folder: Annotated[Path | None, typer.Option(help="Where files go; else recording.folder.")] = None,
    seconds: Annotated[float | None, typer.Option(min=0.1, help="End after so long; else Ctrl-C.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No live counters.")] = False,
) -> None:
    """Run the gateway and record everything: raw bytes, what was sent, poses, events.

    Reads the suit and publishes as `run` does. Ends with a whole file on Ctrl-C or SIGTERM; with 1 when the
    recording had to end before that.
    """
    settings = load_gateway_settings(config)
    changes = {"name": name, "folder": None if folder is None else str(folder)}
    wanted = {key: value for key, value in changes.items() if value is not None}
    recording = settings.recording.model_copy(update={"at_start": True, **wanted})
    settings = settings.model_copy(update={"recording": recording})
    suit = load_rig(settings.rig, config)
    set_up_logging(settings.log.level, settings.log.format)
    make_ready(fitting_suit(settings, suit).reconstructor)
    with told_when_compiling(partial(typer.echo, err=True)):
        service = Service(settings, suit)
    asyncio.run(_record(service, settings, seconds, None if quiet else Console(stderr=True)))
    status = service.recording.status()
    typer.echo(
        f"{status['file']}: {status['seconds']:.1f} s, {status['bytes'] / 1e6:.1f} MB, "
        f"{status['written'].get('chunks', 0)} chunks, {status['written'].get('skeleton', 0)} poses"
        + (f", {status['part']} files" if status["part"] > 1 else "")
    )
    if status.get("ended") != "stopped":
        typer.echo(f"the recording had to end: {status.get('ended')}", err=True)
        raise typer.Exit(1)


async def _record(
    service: Service, settings: GatewaySettings, seconds: float | None, console: Console | None
) -> None:
    running = asyncio.ensure_future(until_signal(service))
    if seconds is not None:
        asyncio.get_running_loop().call_later(seconds, running.cancel)
    if console is not None and console.is_terminal:
        with Live(console=console, transient=True, auto_refresh=False) as live:
            while not running.done():
                live.update(_screen(service, settings), refresh=True)
                await asyncio.wait({running}, timeout=REFRESH_S)
    try:
        await running
    except asyncio.CancelledError:
        logging.getLogger(__name__).info("the time is over")


def _screen(service: Service, settings: GatewaySettings) -> Table:
    """Counters, live."""
    status = service.recording.status()
    modules = service.pipeline.stream.modules.values()
    written, lost = status.get("written", {}), sum(status.get("lost", {}).values())
    screen = Table.grid(padding=(0, 2))
    state = status["state"]
    shown = f"[green]{state}[/]" if state == "recording" else f"[red]{status.get('ended', state)}[/]"
    screen.add_row(shown, str(status.get("file", "")))
    screen.add_row(
        f"{status.get('seconds', 0):.0f} s",
        f"{status.get('bytes', 0) / 1e6:.1f} MB, {written.get('chunks', 0)} chunks, "
        f"{written.get('skeleton', 0)} poses; not recorded {lost}; "
        f"waited for the disk {status.get('stalls', 0)}×",
    )
    screen.add_row(
        f"{len(modules)} modules",
        f"packets received {sum(record.received for record in modules)}, "
        f"lost {sum(record.lost for record in modules)}; "
        + ("broker connected" if service.mqtt.is_connected else f"NO BROKER at {settings.mqtt.host}"),
    )
    if "warning" in status:
        screen.add_row("[yellow]disk[/]", status["warning"])
    screen.add_row("", "[dim]Ctrl-C ends the recording[/]")
    return screen
