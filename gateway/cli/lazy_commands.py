"""Subcommands that are imported when they are called: a list of them needs none of what they need."""

from __future__ import annotations

import gc
import importlib
from typing import Any, ClassVar, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup


class LazyCommand(NamedTuple):
    """Where a subcommand is, and what the list of commands says about it."""

    source: str
    """``module:name`` of a function, or of a ``typer.Typer`` with subcommands of its own."""
    summary: str
    """First line of its help."""
    epilog: str | None = None
    """Example of a function; a group has its own."""


class LazyGroup(TyperGroup):
    """A command group whose members stand in ``lazy``, in that order."""

    lazy: ClassVar[dict[str, LazyCommand]]

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._is_listing = False
        # what typing errors are compared with
        self.commands = {name: TyperCommand(name, help=each.summary) for name, each in self.lazy.items()}

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names, in the order of ``lazy``."""
        return list(self.lazy)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command; while commands are listed, only its summary."""
        if cmd_name not in self.lazy or self._is_listing:
            return self.commands.get(cmd_name)
        return load(cmd_name, self.lazy[cmd_name])

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the group's help without importing its members."""
        self._is_listing = True
        try:
            super().format_help(ctx, formatter)
        finally:
            self._is_listing = False


def load(name: str, command: LazyCommand) -> Any:
    """Import and return a subcommand.

    The garbage collector pauses meanwhile: an import makes no garbage, and searching takes a tenth of its
    time.
    """
    module, attribute = command.source.split(":")
    gc.disable()
    try:
        target = getattr(importlib.import_module(module), attribute)
    finally:
        gc.enable()
    if isinstance(target, typer.Typer):
        loaded = typer.main.get_command(target)
    else:
        alone = typer.Typer(
            pretty_exceptions_enable=False,
            add_completion=False,
            context_settings={"help_option_names": ["-h", "--help"]},
        )
        alone.command(name, epilog=command.epilog)(target)
        loaded = typer.main.get_command(alone)
    loaded.name = name
    return loaded
