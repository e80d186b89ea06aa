"""``mocap-gateway config``: check a configuration, show what may stand in one."""

from __future__ import annotations

import json
from pathlib import Path

import typer
from rich.console import Console

from gateway.body.rig import load_rig
from gateway.cameras.broker_link import link_of
from gateway.reconstruction import refuse_unreadable
from gateway.settings import GatewaySettings, load_gateway_settings

config_app = typer.Typer(
    help="Check a configuration file, or show what may stand in one.", no_args_is_help=True
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
