"""Options that several commands share, written once: as dataclasses, and what their texts mean."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from pydantic import ValidationError

from devices.link import SUIT
from gateway.errors import GatewayError
from gateway.outputs.settings import MqttSettings, TlsSettings
from gateway.sources.link_settings import LinkSettings
from gateway.support.settings_files import as_shown, message_of

Command = Callable[..., None]


def with_options(*groups: type[Any]) -> Callable[[Command], Command]:
    """Give a command the options of ``groups`` in place of its first parameters, one a group.

    groups: dataclasses whose fields are annotated as typer wants options, every one with a default.
    """
    options = [
        option for group in groups for option in inspect.signature(group, eval_str=True).parameters.values()
    ]

    def dressed(command: Command) -> Command:
        """Return a command that takes the options one by one, and passes them on by group."""
        own = list(inspect.signature(command, eval_str=True).parameters.values())[len(groups) :]

        @wraps(command)
        def with_group(**given: Any) -> None:
            chosen = [
                group(**{field.name: given.pop(field.name) for field in fields(group)}) for group in groups
            ]
            command(*chosen, **given)

        parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in [*own, *options]]
        with_group.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_group.__annotations__ = {each.name: each.annotation for each in parameters}
        del with_group.__wrapped__  # its annotations would be taken instead
        return with_group

    return dressed


AsJson = Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")]
Embedded = Annotated[bool, typer.Option("--embedded", help="Publish on a broker of our own.")]
ReplaceFiles = Annotated[bool, typer.Option("--force", help="Replace existing files.")]

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
Failover = Annotated[
    list[str] | None,
    typer.Option(metavar="HOST:PORT", help="A further node of the broker's cluster; repeatable."),
]


def broker_settings(ca_file: Path | None, **options: Any) -> MqttSettings:
    """Return settings of the options by name; exit with status 2 and a line for what is wrong in them."""
    try:
        return MqttSettings(tls=None if ca_file is None else TlsSettings(ca_file=ca_file), **options)
    except ValidationError as error:
        typer.echo("; ".join(map(_complaint, error.errors())), err=True)
        raise typer.Exit(2) from None


def _complaint(problem: Any) -> str:
    """Say what is wrong, after the option that it stands in."""
    message = message_of(problem)
    if not problem["loc"]:
        return message
    option = str(problem["loc"][0]).replace("_", "-")
    return f"--{option} {as_shown(problem['input'])}: {message}"


def link_of(url: str) -> LinkSettings:
    """Return the link that ``--link`` names. Raises ``GatewayError`` for what cannot be one."""
    try:
        return LinkSettings(name=SUIT, url=url)
    except ValidationError as error:
        raise GatewayError(
            "; ".join(f"--link: {message_of(problem)}" for problem in error.errors())
        ) from None


@dataclass(frozen=True)
class BrokerChoice:
    """What the user said about where the broker is."""

    host: Host = "127.0.0.1"
    port: Port = 1883
    failover: Failover = None
    username: Username = None
    password_file: PasswordFile = None
    ca_file: CaFile = None
    protocol: Protocol = "3.1.1"
    base_topic: BaseTopic = "mocap"

    def settings(self) -> MqttSettings:
        """Return the settings; exits as ``broker_settings``."""
        return broker_settings(**asdict(self) | {"failover": tuple(self.failover or ())})


with_broker = with_options(BrokerChoice)
"""For a command whose first parameter is a ``BrokerChoice``."""


def seconds_of(option: str, text: str) -> tuple[float, float]:
    """Return from when to when, s. Raises ``GatewayError``, which names the option."""
    span = re.fullmatch(r"(\d+\.?\d*):(\d+\.?\d*)", text)
    if span is None or float(span[1]) >= float(span[2]):
        raise GatewayError(f"{option} {text}: seconds FROM:TO are wanted, such as 0.5:3")
    return float(span[1]), float(span[2])


def refuse_existing(
    path: Path, force: bool, option: str | None = "--output", source: Path | None = None
) -> None:
    """Raise ``GatewayError`` for a file that is there, unless it may be replaced.

    option: what names it; None: an argument. source: what it is made of, which never may be.
    """
    named = "" if option is None else f" with {option}"
    if source is not None and path.exists() and source.exists() and path.samefile(source):
        raise GatewayError(f"{path} is itself what is read: name another file{named}")
    if path.exists() and not force:
        raise GatewayError(f"{path} exists: name another file{named}, or replace it with --force")


def refuse_absent_folder(path: Path) -> None:
    """Raise ``GatewayError`` for a file to write whose folder is not there: before what takes minutes."""
    if not path.parent.is_dir():
        raise GatewayError(f"{path}: there is no folder {path.parent} to write it to")
