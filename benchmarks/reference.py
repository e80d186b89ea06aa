"""``python -m benchmarks.reference``: write the pages of commands and of the configuration.

They come from what the program declares: its command line and its settings.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer

from benchmarks.figures import table
from gateway.cli.main import app
from gateway.settings import GatewaySettings

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "reference"
_WRITTEN = "Written by `python -m benchmarks.reference`, never by hand."
_KINDS = {"string": "text", "null": "nothing", "boolean": "true, false"}
_BOUNDS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
_COMMANDS = f"""# Commands

{_WRITTEN} Each command shows the same with `--help`.
"""
_CONFIGURATION = f"""# Configuration

{_WRITTEN} The file is YAML. `mocap-gateway config check my.yaml` names every mistake;
`mocap-gateway config schema` gives all of this to an editor. Begin with the annotated
[config/gateway.yaml](../../config/gateway.yaml).
"""


def commands_page() -> str:
    """Return the page of all commands: what each does, its arguments and options, an example."""
    return "\n".join([_COMMANDS, *_sections(typer.main.get_command(app), "mocap-gateway", None)])


def _sections(command: Any, name: str, parent: Any) -> Iterator[str]:
    context = command.context_class(command, parent=parent, info_name=name.rpartition(" ")[2])
    if hasattr(command, "commands"):
        for below in command.commands:
            yield from _sections(command.get_command(context, below), f"{name} {below}", context)
        return
    yield f"## {name.removeprefix('mocap-gateway ')}\n"
    yield f"{_plain(command.help)}\n"
    rows = [_row(parameter, context) for parameter in command.params if parameter.name != "help"]
    if rows:
        yield table(["argument or option", "value", "what", "default"], rows) + "\n"
    if command.epilog:
        yield f"{_example(command.epilog)}\n"


def _row(parameter: Any, context: Any) -> list[str]:
    is_option = parameter.opts[0].startswith("-")
    names = ", ".join(f"`{each}`" for each in [*parameter.opts, *parameter.secondary_opts])
    value = "" if getattr(parameter, "is_flag", False) else str(parameter.display_type(context))
    default = parameter.default
    shown = "required" if parameter.required else ""
    if is_option and default not in (None, False, [], ()) and not callable(default):
        shown = f"`{getattr(default, 'value', default)}`"
    shown = {"`True`": "on", "`False`": "off"}.get(shown, shown)
    name = names if is_option else f"`{parameter.name}`"
    return [name, _cell(value.strip("<>")), _cell(parameter.help or ""), shown]


def _example(epilog: str) -> str:
    """Return the examples below a command's help as a block; they are separated by semicolons."""
    word, _, commands = epilog.partition(":")
    if not word.startswith("Example"):
        return _plain(epilog)
    lines = [each.strip().partition(", ")[0] for each in commands.split("; ")]
    return "```sh\n" + "\n".join(lines) + "\n```"


def configuration_page() -> str:
    """Return the page of the configuration: a section a model, a row a field."""
    schema = GatewaySettings.model_json_schema()
    models = schema.pop("$defs")
    parts = [_CONFIGURATION, "## The file\n", _fields(schema, models)]
    for name, model in models.items():
        if "properties" in model:
            parts += [f"## {name}\n", f"{_plain(model.get('description', ''))}\n", _fields(model, models)]
    return "\n".join(parts)


def _fields(model: Mapping[str, Any], models: Mapping[str, Any]) -> str:
    required = model.get("required", ())
    rows = [
        [
            f"`{name}`",
            _type(field, models),
            _cell(field.get("description", "")),
            "required" if name in required else _default(field),
        ]
        for name, field in model["properties"].items()
    ]
    return table(["key", "value", "what", "default"], rows) + "\n"


def _default(field: Mapping[str, Any]) -> str:
    default = field.get("default")
    if default is None or isinstance(default, dict | list):
        return ""
    return f"`{str(default).lower() if isinstance(default, bool) else default}`"


def _type(field: Mapping[str, Any], models: Mapping[str, Any]) -> str:
    """Return what may stand there: a word, a range, or a link to the section of a model."""
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})" if "properties" in models[name] else _type(models[name], models)
    if several := field.get("anyOf") or field.get("oneOf") or field.get("allOf"):
        return " or ".join(dict.fromkeys(_type(each, models) for each in several))
    if words := field.get("enum", [field["const"]] if "const" in field else []):
        return ", ".join(f"`{each}`" for each in words)
    if field.get("type") == "array":
        return f"list of {_type(field.get('items', {}), models)}"
    if field.get("type") == "object":
        values = field.get("additionalProperties")
        return f"name to {_type(values, models)}" if isinstance(values, dict) else "keys"
    kind = field.get("type", "any")
    bounds = ", ".join(f"{sign} {field[key]:g}" for key, sign in _BOUNDS.items() if key in field)
    return f"{_KINDS.get(kind, kind)} {bounds}".rstrip()


def _plain(text: str | None) -> str:
    """Join the lines of each paragraph."""
    return "\n\n".join(" ".join(part.split()) for part in (text or "").replace("\f", "").split("\n\n"))


def _cell(text: str) -> str:
    return _plain(text).replace("|", "\\|").replace("<", "&lt;").replace("\n", " ")


def main() -> None:
    """Write both pages."""
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")


def pages() -> dict[str, str]:
    """Return the text of each page by the name of its file."""
    return {"commands.md": commands_page(), "configuration.md": configuration_page()}


if __name__ == "__main__":
    main()
