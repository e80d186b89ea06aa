"""Options that several commands share, written once as a dataclass."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from typing import Any

Command = Callable[..., None]


def with_options(group: type[Any]) -> Callable[[Command], Command]:
    """For a command whose first parameter is a ``group``: the options of one stand in its place.

    group: dataclass whose fields are annotated as typer wants options, every one with a default.
    """
    names = [field.name for field in fields(group)]
    options = inspect.signature(group, eval_str=True).parameters.values()

    def dressed(command: Command) -> Command:
        own = list(inspect.signature(command, eval_str=True).parameters.values())[1:]

        @wraps(command)
        def with_group(**given: Any) -> None:
            chosen = group(**{name: given.pop(name) for name in names})
            command(chosen, **given)

        parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in [*own, *options]]
        with_group.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_group.__annotations__ = {each.name: each.annotation for each in parameters}
        del with_group.__wrapped__  # its annotations would be taken instead
        return with_group

    return dressed
