"""``modules show``, ``set``, ``undo``, ``backup`` and ``restore``: what modules keep."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml

from devices.device_backup import parse_unique_id
from gateway.cli.modules_suit import Operations, SuitChoice, run_with_suit, with_suit
from gateway.errors import GatewayError
from gateway.support.settings_files import load_yaml

Device = Annotated[str, typer.Argument(help="Module id, 'relay', or the beginning of a unique id.")]


@with_suit
def show(suit: SuitChoice, device: Device) -> None:
    """Print all settings of a module."""

    async def work(operations: Operations) -> int:
        read = await operations.perform("read", {"device": device})
        typer.echo(f"# module {read['module']}, unique id {read['unique_id']}")
        typer.echo(_yaml(read["settings"]), nl=False)
        return 0

    run_with_suit(suit, work)


@with_suit
def set_settings(
    suit: SuitChoice,
    device: Device,
    settings: Annotated[list[str], typer.Argument(metavar="KEY=VALUE...", help="Settings and their values.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for a script.")] = False,
) -> None:
    """Change settings of a module: written, committed, and read back. Needs --allow-writes."""
    wanted = dict(map(_parsed, settings))

    async def work(operations: Operations) -> int:
        done = await operations.perform("set", {"device": device, "settings": wanted})
        if as_json:
            typer.echo(json.dumps(done))
        else:
            _print_change(done["unique_id"], done["before"], done["after"])
        return 0

    run_with_suit(suit, work)


@with_suit
def undo(suit: SuitChoice) -> None:
    """Write back what stood in the modules before the last change. Needs --allow-writes."""

    async def work(operations: Operations) -> int:
        return print_restored(await operations.perform("undo", {}), "it stood so already")

    run_with_suit(suit, work)


@with_suit
def backup(
    suit: SuitChoice, file: Annotated[Path, typer.Argument(help="YAML file to write; - for the terminal.")]
) -> None:
    """Save all settings of all modules that can be heard."""

    async def work(operations: Operations) -> int:
        saved = await operations.perform("backup", {})
        text = f"# settings of {len(saved['modules'])} modules, by unique id\n" + _yaml(saved)
        if str(file) == "-":
            typer.echo(text, nl=False)
            return 0
        _write(file, text)
        typer.echo(f"settings of {len(saved['modules'])} modules are in {file}")
        return 0

    run_with_suit(suit, work)


@with_suit
def restore(
    suit: SuitChoice, file: Annotated[Path, typer.Argument(help="YAML file that `backup` wrote.")]
) -> None:
    """Write saved settings back to the modules they came from. Needs --allow-writes."""
    modules = _saved_modules(file)

    async def work(operations: Operations) -> int:
        return print_restored(await operations.perform("restore", {"modules": modules}), "nothing differs")

    run_with_suit(suit, work)


def _saved_modules(file: Path) -> dict[str, dict[str, Any]]:
    """Return settings by unique id from a file of ``backup``. Raises ``GatewayError`` for another file."""
    saved = load_yaml(file)
    modules = saved.get("modules") if isinstance(saved, dict) else None
    no_backup = f"{file} is no file that `modules backup` wrote"
    if not isinstance(modules, dict):
        raise GatewayError(f"{no_backup}: under 'modules:' it has no settings by unique id")
    for uid, settings in modules.items():
        try:
            parse_unique_id(str(uid))
        except ValueError as error:
            raise GatewayError(f"{no_backup}: under 'modules:' {error}") from error
        if not isinstance(settings, dict):
            raise GatewayError(f"{no_backup}: under '{uid}:' it has no settings by name")
    return {str(uid).lower(): settings for uid, settings in modules.items()}


def print_changes(changes: list[dict[str, Any]], otherwise: str) -> None:
    """One line a setting that was changed, or ``otherwise``."""
    for change in changes:
        _print_change(change["unique_id"], change["before"], change["after"])
    if not changes:
        typer.echo(otherwise)


def print_restored(done: Mapping[str, Any], otherwise: str) -> int:
    """Print what was written back and what not. Exit code: 1 when it was not all."""
    is_all = not (done["failures"] or done["absent"])
    print_changes(done["changes"], otherwise if is_all else "nothing was changed")
    for uid in done["absent"]:
        typer.echo(f"{uid}: not heard, left out", err=True)
    for uid, reason in done["failures"].items():
        typer.echo(f"{uid}: {reason}", err=True)
    return 0 if is_all else 1


def _print_change(unique_id: str, before: dict[str, Any], after: dict[str, Any]) -> None:
    for name, value in after.items():
        was = before.get(name)
        typer.echo(f"{unique_id}: {name} {_brief(was)} → {_brief(value)}{' (as before)' * (was == value)}")


def _brief(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _parsed(text: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise GatewayError(f"'{text}' is no setting: write KEY=VALUE, such as sampling_rate=200")
    if name == "label":
        return name, value  # also when it looks like a number
    try:
        return name, yaml.safe_load(value)
    except yaml.YAMLError:
        return name, value


def _yaml(content: Any) -> str:
    text: str = yaml.safe_dump(
        content, sort_keys=False, default_flow_style=None, allow_unicode=True, width=100
    )
    return text


def _write(file: Path, text: str) -> None:
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise GatewayError(f"{file} cannot be written: {error.strerror}") from error
