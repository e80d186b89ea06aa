"""``view``: the live 3-D page."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from pathlib import Path
from typing import Annotated, Literal

import typer
from pydantic import ValidationError

from gateway.errors import GatewayError
from gateway.outputs.settings import MqttSettings
from gateway.outputs.topics import ANY_GATEWAY

LOOPBACK = "127.0.0.1"


def view(
    host: Annotated[str, typer.Option(help="Host of the MQTT broker.")] = LOOPBACK,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the MQTT broker.")] = 1883,
    username: Annotated[str | None, typer.Option(help="User name at the broker.")] = None,
    password_file: Annotated[
        Path | None, typer.Option(help="File with the password; else MOCAP_MQTT_PASSWORD is taken.")
    ] = None,
    protocol: Annotated[Literal["3.1.1", "5"], typer.Option(help="MQTT version.")] = "3.1.1",
    base_topic: Annotated[str, typer.Option(help="First part of the topics.")] = "mocap",
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
    """Show the moving body on a page in the browser, live.

    The page loads nothing from elsewhere and works on a phone. It only subscribes: it cannot slow the
    gateway down, and may run on another machine.
    """
    try:
        settings = MqttSettings(
            host=host,
            port=port,
            username=username,
            password_file=password_file,
            protocol=protocol,
            base_topic=base_topic,
        )
    except ValidationError as error:
        typer.echo("; ".join(problem["msg"] for problem in error.errors()), err=True)
        raise typer.Exit(2) from None
    refuse_busy_port(page_host, page_port)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(settings, gateway, (page_host, page_port), wait))


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


async def _serve(settings: MqttSettings, gateway: str, page: tuple[str, int], waits: bool) -> None:
    try:
        import viser  # noqa: PLC0415 - an extra, and slow to import
    except ImportError:
        raise GatewayError("the page needs the extra 'viewer': pip install 'mocap-gateway[viewer]'") from None
    from gateway.viewer.live import LiveViewer  # noqa: PLC0415 - needs the extra

    server = viser.ViserServer(*page, label="mocap-gateway", verbose=False)
    try:
        typer.echo(f"live page: http://{page[0]}:{page[1]}")
        await LiveViewer(server, settings, gateway).run(waits)
    finally:
        server.stop()
