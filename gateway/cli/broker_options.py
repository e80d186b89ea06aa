"""The broker that a command's options name."""

from __future__ import annotations

from typing import Any

import typer
from pydantic import ValidationError

from gateway.outputs.settings import MqttSettings


def broker_settings(**options: Any) -> MqttSettings:
    """Settings of the options given, by their names. Ends the command with what is wrong in them."""
    try:
        return MqttSettings(**options)
    except ValidationError as error:
        typer.echo("; ".join(problem["msg"] for problem in error.errors()), err=True)
        raise typer.Exit(2) from None
