"""``mocap-gateway config``: check a configuration, show what may stand in one, make a key."""

from __future__ import annotations

import json
from pathlib import Path

import typer
from rich.console import Console

from devices.signed_link import write_key
from gateway.body.rig import load_rig
from gateway.cameras.broker_link import link_of
from gateway.errors import GatewayError
from gateway.reconstruction import refuse_unreadable
from gateway.settings import GatewaySettings, load_gateway_settings

config_app = typer.Typer(
    help="Check a configuration file, show what may stand in one, make a key.",
    no_args_is_help=True,
)


@config_app.command(epilog="Example: mocap-gateway config check config/gateway.yaml")
def check(file: Path = typer.Argument(Path("config/gateway.yaml"), help="Configuration file.")) -> None:
    """Check a configuration, the rig and the body it names. Opens nothing."""
    settings = load_gateway_settings(file)
    suit = load_rig(settings.rig, file)
    refuse_unreadable(settings.reconstructor, suit)
    for link in settings.links:
        link_of(link, settings.mqtt, lambda: settings.mqtt.port)
    Console().print(
        f"[green]{file} is good[/green]: gateway '{settings.gateway}', {len(settings.links)} link(s), "
        f"{len(suit.module_ids)} modules on body '{suit.skeleton.name}', {settings.assembly.rate_hz:g} Hz, "
        f"reconstructor '{settings.reconstructor}', broker {settings.mqtt.broker} "
        f"{settings.mqtt.host}:{settings.mqtt.port}",
        soft_wrap=True,
    )


@config_app.command(epilog="Example: mocap-gateway config schema > gateway.schema.json")
def schema() -> None:
    """Print the JSON Schema of the configuration, for editors and for reading."""
    typer.echo(json.dumps(GatewaySettings.model_json_schema(), indent=2))


@config_app.command(epilog="Example: mocap-gateway config key /etc/mocap/wifi.key")
def key(file: Path = typer.Argument(help="New file for the key; one that is there stays as it is.")) -> None:
    """Make a key for a signed link, in a file that only you may read.

    Its line, 64 hexadecimal digits, is what the modules of that link are given.
    """
    try:
        write_key(file)
    except OSError as error:
        raise GatewayError(f"cannot make {file}: {error.strerror}") from None
    Console().print(
        f"[green]{file} holds a new key[/green]: give it to the modules, and write in the configuration "
        f"[bold]url: udp://…?key_file={file.absolute()}[/bold] (or tcp://…)",
        soft_wrap=True,
    )
