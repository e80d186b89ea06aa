"""``view``: the live 3-D page."""

from __future__ import annotations

import asyncio
import contextlib
import io
from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from devices.extras import how_to_add
from gateway.cli.broker_options import BrokerChoice, with_broker
from gateway.cli.progress import progress_bar
from gateway.contract.topics import ANY_GATEWAY
from gateway.errors import GatewayError
from gateway.outputs.settings import MqttSettings
from gateway.recording import open_recording
from gateway.support.credentials import AccessToken, token_for

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"
PAGE_TOKEN_VARIABLE = "MOCAP_PAGE_TOKEN"
"""Environment variable that may hold the token of the page."""


@with_broker
def view(
    broker: BrokerChoice,
    recording: Annotated[
        Path | None, typer.Argument(help="A recording to play; without one, what a gateway publishes now.")
    ] = None,
    gateway: Annotated[str, typer.Option(help="Name of the gateway; + for the first heard.")] = ANY_GATEWAY,
    page_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = 8080,
    page_host: Annotated[
        str,
        typer.Option(
            help="Address that the page listens on. Elsewhere than on this machine it needs a token: "
            "whoever opens the page can also press its buttons."
        ),
    ] = LOOPBACK,
    token_file: Annotated[
        Path | None,
        typer.Option(help="File with the token that opens the page; else MOCAP_PAGE_TOKEN is taken."),
    ] = None,
    muscles: Annotated[
        float | None,
        typer.Option(
            min=2,
            max=400,
            metavar="KG",
            help="Show muscles coloured by activity, of a person of this mass (extra biomech).",
        ),
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for a broker that is not there yet.")] = False,
) -> None:
    """Show the moving body on a page in the browser, live or from a recording.

    The page loads nothing from elsewhere and works on a phone. It only subscribes: it cannot slow the
    gateway down, and may run on another machine.
    """
    settings = broker.settings()
    token = token_for("the page", page_host, token_file, PAGE_TOKEN_VARIABLE, "--token-file")
    place = _Place(page_host, page_port, token)
    with contextlib.suppress(KeyboardInterrupt):
        if recording is None:
            asyncio.run(_serve_live(settings, gateway, place, wait, muscles))
        else:
            asyncio.run(_serve_recording(recording, place, muscles))


class _Place(NamedTuple):
    """Where the page is, and what whoever opens it must show."""

    host: str
    port: int
    token: AccessToken | None


@contextlib.asynccontextmanager
async def _page(place: _Place) -> AsyncIterator[viser.ViserServer]:
    """A page behind its gate, while it is wanted. Raises ``GatewayError`` without the extra."""
    try:
        import viser  # noqa: PLC0415 - an extra, and slow to import
    except ImportError:
        raise GatewayError(f"the page needs the extra 'viewer': {how_to_add('viewer')}") from None
    from gateway.viewer.gate import Door, Gate  # noqa: PLC0415 - beside the extra

    with contextlib.redirect_stdout(io.StringIO()):  # it would name the port behind the gate
        server = viser.ViserServer(LOOPBACK, 0, label="mocap-gateway", verbose=False)
    try:
        async with Gate(place.host, place.port, server.get_port(), Door(place.token)):
            shown = "/?token=… (the token's own text)" if place.token is not None else ""
            typer.echo(f"live page: http://{place.host}:{place.port}{shown}")
            yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


async def _serve_live(
    settings: MqttSettings, gateway: str, place: _Place, waits: bool, muscles_kg: float | None
) -> None:
    async with _page(place) as server:
        from gateway.viewer.live import LiveViewer  # noqa: PLC0415 - needs the extra

        await LiveViewer(server, settings, gateway, muscles_kg).run(waits)


async def _serve_recording(recording: Path, place: _Place, muscles_kg: float | None) -> None:
    with progress_bar(f"reading {recording.name}") as tell:
        opened = open_recording(recording)
        arrays = opened.skeleton_arrays(tell)
    async with _page(place) as server:
        from gateway.viewer.marker_points import recorded_markers  # noqa: PLC0415 - needs the extra
        from gateway.viewer.playback import Playback  # noqa: PLC0415 - needs the extra

        markers = recorded_markers(opened, arrays)
        await Playback(server, arrays, recording.stem, markers, muscles_kg).run()
