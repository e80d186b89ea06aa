"""``view``: the live 3-D page."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gateway.cli import broker_options
from gateway.cli.progress import progress_bar
from gateway.errors import GatewayError
from gateway.outputs.settings import MqttSettings
from gateway.outputs.topics import ANY_GATEWAY
from gateway.recording import open_recording

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"


def view(
    recording: Annotated[
        Path | None, typer.Argument(help="A recording to play; without one, what a gateway publishes now.")
    ] = None,
    host: broker_options.Host = LOOPBACK,
    port: broker_options.Port = 1883,
    username: broker_options.Username = None,
    password_file: broker_options.PasswordFile = None,
    ca_file: broker_options.CaFile = None,
    protocol: broker_options.Protocol = "3.1.1",
    base_topic: broker_options.BaseTopic = "mocap",
    gateway: Annotated[str, typer.Option(help="Name of the gateway; + for the first heard.")] = ANY_GATEWAY,
    page_port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the page.")] = 8080,
    page_host: Annotated[
        str,
        typer.Option(
            help="Address that the page listens on. Everybody who reaches it can look, and press its buttons."
        ),
    ] = LOOPBACK,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for a broker that is not there yet.")] = False,
) -> None:
    """Show the moving body on a page in the browser, live or from a recording.

    The page loads nothing from elsewhere and works on a phone. It only subscribes: it cannot slow the
    gateway down, and may run on another machine.
    """
    settings = broker_options.broker_settings(
        host=host,
        port=port,
        username=username,
        password_file=password_file,
        ca_file=ca_file,
        protocol=protocol,
        base_topic=base_topic,
    )
    refuse_busy_port(page_host, page_port)
    with contextlib.suppress(KeyboardInterrupt):
        if recording is None:
            asyncio.run(_serve_live(settings, gateway, (page_host, page_port), wait))
        else:
            asyncio.run(_serve_recording(recording, (page_host, page_port)))


def refuse_busy_port(host: str, port: int) -> None:
    """Raises ``GatewayError`` if the page could not listen there."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise GatewayError(
                f"the page cannot listen on {host}:{port} ({error.strerror}): name another one with "
                "--page-port or --page-host"
            ) from None


@contextlib.contextmanager
def _page(address: tuple[str, int]) -> Iterator[viser.ViserServer]:
    """A page, while it is wanted. Raises ``GatewayError`` without the extra."""
    try:
        import viser  # noqa: PLC0415 - an extra, and slow to import
    except ImportError:
        raise GatewayError("the page needs the extra 'viewer': pip install 'mocap-gateway[viewer]'") from None
    server = viser.ViserServer(*address, label="mocap-gateway", verbose=False)
    try:
        typer.echo(f"live page: http://{address[0]}:{address[1]}")
        yield server
    finally:
        server.stop()


async def _serve_live(settings: MqttSettings, gateway: str, address: tuple[str, int], waits: bool) -> None:
    with _page(address) as server:
        from gateway.viewer.live import LiveViewer  # noqa: PLC0415 - needs the extra

        await LiveViewer(server, settings, gateway).run(waits)


async def _serve_recording(recording: Path, address: tuple[str, int]) -> None:
    with progress_bar(f"reading {recording.name}") as tell:
        arrays = open_recording(recording).skeleton_arrays(tell)
    with _page(address) as server:
        from gateway.viewer.playback import Playback  # noqa: PLC0415 - needs the extra

        await Playback(server, arrays, recording.stem).run()
