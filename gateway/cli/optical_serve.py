"""``mocap-gateway optical serve``: a trial as Qualisys QTM would stream it."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from typing import Annotated

import typer

from devices.emulators.qtm_stand_in import QtmStandIn
from devices.marker_files import MarkerTrial, read_markers
from devices.qtm_link import DEFAULT_PORT
from gateway.errors import GatewayError


def serve(
    file: Annotated[Path, typer.Argument(help="Trial, C3D or TRC.")],
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to serve on; 0: any that is free.")
    ] = DEFAULT_PORT,
    host: Annotated[str, typer.Option(help="Address to serve on.")] = "127.0.0.1",
    up: Annotated[str, typer.Option(help="Axis of the file that points up: x, y or z.")] = "z",
    speed: Annotated[float, typer.Option(min=0.01, max=100, help="1: as captured.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="Stop at the end; else begin anew.")] = False,
) -> None:
    """Stand in for a Qualisys QTM: serve a trial by its real-time protocol, to try a set-up without cameras.

    Whoever connects sees it from the beginning on. Written from the published protocol; no QTM was at hand.
    """
    if up not in {"x", "y", "z"}:
        raise GatewayError(f"--up {up}: x, y or z is wanted")
    asyncio.run(_serve(read_markers(file), file, port, host, up, speed, once))


async def _serve(
    trial: MarkerTrial, file: Path, port: int, host: str, up: str, speed: float, once: bool
) -> None:
    ended = asyncio.Event()
    stand_in = QtmStandIn(
        trial, host=host, port=port, up=f"+{up.upper()}", speed=speed, repeats=not once, on_end=ended.set
    )
    try:
        await stand_in.start()
    except OSError as error:
        raise GatewayError(f"{host}:{port} cannot be served: {error.strerror or error}") from error
    typer.echo(
        f"{file}: {trial.n_frames} frames at {trial.rate_hz:g} Hz as QTM streams them; "
        f"a gateway hears them with the link qtm://{host}:{stand_in.port}; Ctrl-C ends",
        err=True,
    )
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    await ended.wait()
    await stand_in.stop()
    typer.echo(f"{stand_in.sent} frames sent")
