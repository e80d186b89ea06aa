"""``health``: what the running gateway says of itself, for container health checks and scripts."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from typing import Annotated

import typer

from gateway.errors import GatewayError

DEFAULT_PORT = 9464


def health(
    port: Annotated[
        int, typer.Option(min=1, max=65535, help="`metrics.port` of the gateway.")
    ] = DEFAULT_PORT,
    host: Annotated[str, typer.Option(help="`metrics.host` of the gateway.")] = "127.0.0.1",
    timeout: Annotated[float, typer.Option(min=0.1, max=3600, help="Longest wait, s.")] = 3.0,
) -> None:
    """Ask the running gateway whether it is well: 0 if it is, 1 if not. It needs a `metrics.port`."""
    address = f"http://{host}:{port}/healthz"
    try:
        with urllib.request.urlopen(address, timeout=timeout) as response:
            typer.echo(response.read().decode(errors="replace").strip())
    # An answer with an error status is an answer: its text says what is wrong.
    except urllib.error.HTTPError as error:
        typer.echo(error.read().decode(errors="replace").strip())
        raise typer.Exit(1) from None
    except (OSError, ValueError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", error)
        reason = getattr(reason, "strerror", None) or reason
        raise GatewayError(
            f"no gateway answers at {address} ({reason}): is it running, with `metrics: {{port: {port}}}`?"
        ) from None
