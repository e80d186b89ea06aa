"""The suit that a ``modules`` command is about: how it is reached, and its modules as a table."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Group, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

from firmware_protocol import RELAY
from gateway.cli.options import broker_settings, link_of, with_options
from gateway.contract.topics import ANY_GATEWAY
from gateway.errors import GatewayError
from gateway.outputs.settings import MqttSettings
from gateway.settings import load_gateway_settings
from gateway.support.settings_files import as_shown

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

    async def perform(self, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Perform a verb of ``gateway.modules``. Raises ``GatewayError``."""


with_suit = with_options(SuitChoice)
"""For a command whose first parameter is a ``SuitChoice``."""


@contextlib.asynccontextmanager
async def operations_of(choice: SuitChoice, needs_all: bool = True) -> AsyncIterator[Operations]:
    """Open the suit; ``needs_all``: whether all its links must be there, or only one of them.

    Raises ``GatewayError`` or ``LinkError``.
    """
    from gateway.body.rig import load_rig
    from gateway.modules.journal import Journal, default_journal_path
    from gateway.modules.remote import remote_suit
    from gateway.modules.session import suit_session

    if choice.mqtt is not None:
        async with remote_suit(_broker(choice), choice.gateway) as remote:
            yield remote
        return

    journal = Journal(default_journal_path())
    if choice.link is not None:
        if choice.rig is None:
            raise GatewayError("--link needs --rig: name a shipped rig, such as suit_17, or a rig file")
        suit, links = load_rig(choice.rig), [link_of(choice.link)]
        async with suit_session(links, suit, allow_writes=choice.allow_writes, journal=journal) as local:
            yield local
        return

    if choice.config is None:
        raise GatewayError(
            "where is the suit? give -c CONFIG, or --link PORT --rig RIG, or --mqtt HOST:PORT of a "
            "running gateway"
        )
    settings = load_gateway_settings(choice.config)
    async with suit_session(
        settings.links,
        load_rig(choice.rig or settings.rig, choice.config),
        allow_writes=choice.allow_writes or settings.allow_device_writes,
        journal=journal,
        clock_mode=settings.clock.mode,
        needs_all=needs_all,
    ) as local:
        yield local


def run_with_suit(
    choice: SuitChoice, work: Callable[[Operations], Awaitable[int]], needs_all: bool = True
) -> None:
    """Open the suit, do the work, end with its exit code. Ends by Ctrl-C without a word.

    needs_all: whether all its links must be there, or only one of them.
    """

    async def run() -> int:
        async with operations_of(choice, needs_all) as operations:
            return await work(operations)

    try:
        code = asyncio.run(run())
    except KeyboardInterrupt:
        # 128 + SIGINT, as shells have it.
        code = 130
    raise typer.Exit(code)


def _broker(choice: SuitChoice) -> MqttSettings:
    assert choice.mqtt is not None
    host, colon, port = choice.mqtt.rpartition(":")
    if not (colon and host and port.isdecimal() and 0 < int(port) < 2**16):
        raise GatewayError(f"--mqtt {as_shown(choice.mqtt)}: write HOST:PORT, such as 127.0.0.1:1883")
    return broker_settings(
        choice.ca_file,
        host=host,
        port=int(port),
        username=choice.username,
        password_file=choice.password_file,
        base_topic=choice.base_topic,
    )


_UNKNOWN = "–"
_LOW_BATTERY = 20
_NOTABLE_LOSS = 1.0
WIDEST = 150
"""Columns that a wide table takes at most, save for many kinds of gaps."""
_BRIEF = ("id", "segment", "unique id", "battery", "Hz", "loss %")
"""What fits on 80 columns."""
_COLUMNS = (*_BRIEF, "firmware", "gaps", "resets", "ppm", "residual µs", "offset s")
_TEXT_COLUMNS = {"unique id", "segment", "firmware", "gaps"}
_FOLDED_COLUMNS = {"segment"}


def modules_screen(listed: Mapping[str, Any], is_wide: bool = False) -> RenderableType:
    """Return the table, what is missing, and conflicts with their remedy."""
    shared = {conflict["module"] for conflict in listed["conflicts"]}
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    columns = _COLUMNS if is_wide else _BRIEF
    for column in columns:
        justify: JustifyMethod = "left" if column in _TEXT_COLUMNS else "right"
        table.add_column(column, justify=justify, no_wrap=column not in _FOLDED_COLUMNS, overflow="fold")
    for module in listed["modules"]:
        cells = _cells(module, takes_commands=module["module"] not in listed.get("without_commands", ()))
        style = "bold red" if module["module"] in shared else ""
        table.add_row(*(cells[column] for column in columns), style=style)
    return Group(table, *_remarks(listed))


def _cells(module: Mapping[str, Any], *, takes_commands: bool) -> dict[str, Text]:
    battery, rate, loss = module["battery_percent"], module["rate_hz"], module["loss_percent"]
    is_relay = module["module"] == RELAY
    ppm, residual, offset = _clock_cells(module["clock"])
    return {
        "id": Text("relay" if is_relay else str(module["module"])),
        "segment": Text(
            module["segment"] or ("" if is_relay else "not in the rig"), "" if module["segment"] else "dim"
        ),
        "unique id": Text(
            module["unique_id"] or ("does not answer" if takes_commands else _UNKNOWN),
            "yellow" if takes_commands and not module["answers"] else "",
        ),
        "battery": Text(
            _number(battery, ".0f", " %"), "red" if battery is not None and battery < _LOW_BATTERY else ""
        ),
        "Hz": Text(f"{rate:.{int(rate < 1000)}f}", "yellow" if not rate and not is_relay else ""),
        "loss %": Text(_number(loss, ".2f"), "yellow" if loss is not None and loss > _NOTABLE_LOSS else ""),
        "firmware": Text(module["firmware"] or _UNKNOWN),
        "gaps": Text(" ".join(f"{length}:{count}" for length, count in module["gaps"].items())),
        "resets": Text(str(module["resets"]), "yellow" if module["resets"] else ""),
        "ppm": ppm,
        "residual µs": residual,
        "offset s": offset,
    }


def _clock_cells(clock: Mapping[str, Any] | None) -> tuple[Text, Text, Text]:
    """Return rate, residual and offset; a rate that is not known yet says so."""
    if clock is None:
        return Text(_UNKNOWN), Text(_UNKNOWN), Text(_UNKNOWN)
    is_settled = clock["state"] == "settled"
    return (
        Text(_number(clock["ppm"], "+.1f")) if is_settled else Text("measuring", "dim"),
        Text(_number(clock["residual_us"], ".0f")),
        Text(f"{clock['offset_ns'] * 1e-9:.6f}"),
    )


def _remarks(listed: Mapping[str, Any]) -> list[Text]:
    remarks = [
        Text(
            f"conflict: module id {conflict['module']} is shared by {' and '.join(conflict['unique_ids'])}: "
            "their samples cannot be told apart.\n"
            "  remedy: mocap-gateway modules assign (gives one a free id, then asks which is which), or\n"
            f"  mocap-gateway modules set {conflict['unique_ids'][-1]} module_id=FREE_ID",
            "bold red",
        )
        for conflict in listed["conflicts"]
    ]
    # a gateway of an older version says neither
    absent, mute = listed.get("absent", {}), set(listed.get("without_commands", ()))
    remarks += [Text(f"link '{name}' is not open: {reason}", "bold red") for name, reason in absent.items()]
    silent = [module["module"] for module in listed["modules"] if not module["answers"]]
    if quiet := [str(module) for module in silent if module in mute]:
        remarks.append(Text(f"take no commands: {', '.join(quiet)}: they cannot be identified or set here"))
    deaf = [str(module) for module in silent if module not in mute]
    if deaf:
        remarks.append(
            Text(
                f"no answer to commands: {', '.join(deaf)}: samples come and count; to be identified, "
                "assigned or set, its firmware must take commands, and what is sent must reach it",
                "yellow",
            )
        )
    present = {module["module"] for module in listed["modules"]}
    missing = [f"{name} ({module})" for name, module in listed["segments"].items() if module not in present]
    if missing:
        remarks.append(
            Text(
                f"not heard: {', '.join(missing)}: switched off, out of range, or with another id "
                "(mocap-gateway modules assign)",
                "yellow",
            )
        )
    return remarks


def _number(value: float | None, form: str, unit: str = "") -> str:
    return _UNKNOWN if value is None else f"{value:{form}}{unit}"
