"""The broker that a command's options name: the options, and the settings of what was given."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from pydantic import ValidationError

from gateway.cli.option_groups import with_options
from gateway.outputs.settings import MqttSettings, TlsSettings

Host = Annotated[str, typer.Option(help="Host of the MQTT broker.")]
Port = Annotated[int, typer.Option(min=1, max=65535, help="Port of the MQTT broker.")]
Username = Annotated[str | None, typer.Option(help="User name at the broker.")]
PasswordFile = Annotated[
    Path | None, typer.Option(help="File with the password; else MOCAP_MQTT_PASSWORD is taken.")
]
Protocol = Annotated[Literal["3.1.1", "5"], typer.Option(help="MQTT version.")]
CaFile = Annotated[
    Path | None, typer.Option(help="Speak TLS; certificates (PEM) to check the broker against.")
]
BaseTopic = Annotated[str, typer.Option(help="First part of the topics.")]


def broker_settings(ca_file: Path | None, **options: Any) -> MqttSettings:
    """Settings of the options given, by their names. Ends the command with what is wrong in them."""
    try:
        return MqttSettings(tls=None if ca_file is None else TlsSettings(ca_file=ca_file), **options)
    except ValidationError as error:
        typer.echo("; ".join(problem["msg"] for problem in error.errors()), err=True)
        raise typer.Exit(2) from None


@dataclass(frozen=True)
class BrokerChoice:
    """What the user said about where the broker is."""

    host: Host = "127.0.0.1"
    port: Port = 1883
    username: Username = None
    password_file: PasswordFile = None
    ca_file: CaFile = None
    protocol: Protocol = "3.1.1"
    base_topic: BaseTopic = "mocap"

    def settings(self) -> MqttSettings:
        """As ``broker_settings``."""
        return broker_settings(**asdict(self))


with_broker = with_options(BrokerChoice)
"""For a command whose first parameter is a ``BrokerChoice``."""
