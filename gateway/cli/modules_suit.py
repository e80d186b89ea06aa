"""Which suit a ``modules`` command is about: read by the command itself, or by a running gateway."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer

from gateway.body.rig import load_rig
from gateway.cli.option_groups import with_options
from gateway.contract.topics import ANY_GATEWAY
from gateway.errors import GatewayError
from gateway.modules.journal import Journal, default_journal_path
from gateway.modules.remote import remote_suit
from gateway.modules.session import suit_session
from gateway.outputs.settings import MqttSettings, TlsSettings
from gateway.settings import load_gateway_settings

_SUIT = "Which suit"


@dataclass(frozen=True)
class SuitChoice:
    """What the user said about where the suit is."""

    config: Annotated[
        Path | None,
        typer.Option("--config", "-c", rich_help_panel=_SUIT, help="Configuration: its links and its rig."),
    ] = None
    link: Annotated[
        str | None, typer.Option(rich_help_panel=_SUIT, help="Port or URL of the suit, with --rig.")
    ] = None
    rig: Annotated[str | None, typer.Option(rich_help_panel=_SUIT, help="Rig: a shipped one or a file.")] = (
        None
    )
    mqtt: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", rich_help_panel=_SUIT, help="Ask the running gateway behind this broker."
        ),
    ] = None
    gateway: Annotated[
        str, typer.Option(rich_help_panel=_SUIT, help="Its name; + for the only one that is online.")
    ] = ANY_GATEWAY
    base_topic: Annotated[str, typer.Option(rich_help_panel=_SUIT, help="First part of its topics.")] = (
        "mocap"
    )
    username: Annotated[str | None, typer.Option(rich_help_panel=_SUIT, help="User name at the broker.")] = (
        None
    )
    password_file: Annotated[
        Path | None,
        typer.Option(rich_help_panel=_SUIT, help="File with the password; else MOCAP_MQTT_PASSWORD."),
    ] = None
    ca_file: Annotated[
        Path | None,
        typer.Option(rich_help_panel=_SUIT, help="Speak TLS; certificates to check the broker against."),
    ] = None
    allow_writes: Annotated[
        bool,
        typer.Option(
            "--allow-writes", rich_help_panel=_SUIT, help="Let this command change what modules keep."
        ),
    ] = False


class Operations(Protocol):
    """What carries out the verbs of ``gateway.contract.requests``."""

    async def perform(self, verb: str, data: Mapping[str, Any]) -> dict[str, Any]: ...


with_suit = with_options(SuitChoice)
"""For a command whose first parameter is a ``SuitChoice``."""


@contextlib.asynccontextmanager
async def operations_of(choice: SuitChoice) -> AsyncIterator[Operations]:
    """The suit, opened. Raises ``GatewayError`` or ``LinkError``."""
    if choice.mqtt is not None:
        async with remote_suit(_broker(choice), choice.gateway) as remote:
            yield remote
        return
    journal = Journal(default_journal_path())
    if choice.link is not None:
        if choice.rig is None:
            raise GatewayError("--link needs --rig: name a shipped rig, such as suit_17, or a rig file")
        suit, urls = load_rig(choice.rig), {"suit": choice.link}
        async with suit_session(urls, suit, allow_writes=choice.allow_writes, journal=journal) as local:
            yield local
        return
    if choice.config is None:
        raise GatewayError(
            "where is the suit? give -c CONFIG, or --link PORT --rig RIG, or --mqtt HOST:PORT of a "
            "running gateway"
        )
    settings = load_gateway_settings(choice.config)
    async with suit_session(
        {link.name: link.url for link in settings.links},
        load_rig(choice.rig or settings.rig, choice.config),
        allow_writes=choice.allow_writes or settings.allow_device_writes,
        journal=journal,
        clock_mode=settings.clock.mode,
    ) as local:
        yield local


def run_with_suit(choice: SuitChoice, work: Callable[[Operations], Awaitable[int]]) -> None:
    """Open the suit, do the work, end with its exit code. Ends by Ctrl-C without a word."""

    async def run() -> int:
        async with operations_of(choice) as operations:
            return await work(operations)

    try:
        code = asyncio.run(run())
    except KeyboardInterrupt:
        code = 130
    raise typer.Exit(code)


def _broker(choice: SuitChoice) -> MqttSettings:
    assert choice.mqtt is not None
    host, colon, port = choice.mqtt.rpartition(":")
    if not (colon and host and port.isdecimal() and 0 < int(port) < 2**16):
        raise GatewayError(f"--mqtt {choice.mqtt}: write HOST:PORT, such as 127.0.0.1:1883")
    return MqttSettings(
        host=host,
        port=int(port),
        username=choice.username,
        password_file=choice.password_file,
        tls=None if choice.ca_file is None else TlsSettings(ca_file=choice.ca_file),
        base_topic=choice.base_topic,
    )
