"""YAML files to checked settings, with errors that name the file, the field, the value and the remedy."""

from __future__ import annotations

import contextlib
import re
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from gateway.errors import SettingsError, nearest
from gateway.support import yaml_text
from gateway.support.former_names import current
from gateway.support.names import IN_WORDS

Model = TypeVar("Model", bound=BaseModel)

_SECRET = re.compile("password|secret|token|credential", re.IGNORECASE)
"""Names of settings whose value is never repeated."""
_NAMED_BY = {"bodies": "body", "rigs": "rig"}
"""The setting of a file that names another one, by the folder of the shipped ones."""
_MOST_PROBLEMS = 20
"""Said of one file at a time."""
_LONGEST_LINE = 400


class Strict(BaseModel):
    """Settings that refuse what they do not know, and do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def shipped_folder() -> Path:
    """Return the shipped configuration: ``config/`` of the source tree, or its copy in an installed
    package."""
    in_tree = Path(__file__).parents[2] / "config"
    return in_tree if (in_tree / "bodies").is_dir() else Path(__file__).parents[1] / "shipped_config"


def find_file(name: str, kind: str, beside: Path | None = None) -> Path:
    """Return the file that ``name`` means: a path (also relative to the naming file's folder), or a shipped
    one.

    kind: a folder of the shipped ones, such as "rigs"; beside: the file that names it. Raises
    ``SettingsError`` naming the shipped ones.
    """
    candidates = [Path(name)]
    if beside is not None:
        # What lies beside the file that names it comes before the working directory.
        candidates.insert(0, beside.parent / name)
    candidates.append(shipped_folder() / kind / f"{name}.yaml")
    for path in candidates:
        # A name of any length or character may stand there, which the system refuses by errors of its own.
        with contextlib.suppress(OSError, ValueError):
            if path.is_file():
                return path
    shipped = sorted(path.stem for path in (shipped_folder() / kind).glob("*.yaml"))
    where = "" if beside is None else f"{beside}: '{_NAMED_BY.get(kind, kind)}': "
    raise SettingsError(
        f"{where}there is no file '{_shortened(name)}', and no shipped one of that name in {kind}"
        + nearest(name, shipped)
    )


def load_yaml(path: Path) -> Any:
    """Return the content of a YAML file. Raises ``SettingsError`` with file and line when it cannot be
    read."""
    text = read_text(path)
    try:
        return current(yaml_text.load(text))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        if isinstance(error, yaml.reader.ReaderError):
            problem = f"is no text: character {error.position + 1} of it is a control character"
        if r"'\t'" in problem:
            problem = "a tab where spaces are wanted: indent with spaces"
        raise SettingsError(f"{path}:{where} {problem}: 'key: value' lines (YAML) are wanted") from error


def read_text(path: Path) -> str:
    """Return the text of a file. Raises ``SettingsError`` with what to do when it cannot be read."""
    try:
        with path.open("rb") as file:
            data = file.read(yaml_text.LARGEST_TEXT + 1)
        if len(data) > yaml_text.LARGEST_TEXT:
            most = f"{yaml_text.LARGEST_TEXT >> 20} MiB"
            raise SettingsError(f"{path}: is larger than {most}: it is another file")
        return data.decode("utf-8")
    except FileNotFoundError:
        raise SettingsError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise SettingsError(f"{path}: is a folder: name the file in it") from None
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: is no text in UTF-8 (byte {error.start}): save it as UTF-8") from error
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read: {error.strerror or error}") from error


def load_settings(path: Path, model: type[Model], changes: Mapping[str, Any] | None = None) -> Model:
    """Return a YAML file as ``model``. Raises ``SettingsError`` with one line for each thing wrong.

    changes: values that count instead of those of the file, nested as there.
    """
    content = load_yaml(path)
    if content is None:
        raise SettingsError(f"{path}: is empty: 'key: value' lines are wanted")
    if not isinstance(content, dict):
        raise SettingsError(f"{path}: is another file: {_wanted_of(model)}")
    required = [name for name, field in model.model_fields.items() if field.is_required()]
    unknown = [str(key) for key in content if key not in _known_keys(model, ())]
    if len(unknown) > len(content) / 2 and required and not content.keys() & set(required):
        shown = ", ".join(f"'{_shortened(key, 40)}'" for key in unknown[:3])
        raise SettingsError(
            f"{path}: is another file, or all is misspelt: {_wanted_of(model)}; it has {shown}"
            + (" …" if len(unknown) > 3 else "")
        )
    if changes:
        content = _changed(content, changes)
    try:
        settings = model.model_validate(content)
    except ValidationError as error:
        problems = error.errors()
        # One mistake, as a wrong indent, may give hundreds of problems.
        lines = [f"{path}: {explained(problem, model)}" for problem in problems[:_MOST_PROBLEMS]]
        if len(problems) > _MOST_PROBLEMS:
            lines.append(f"{path}: and {len(problems) - _MOST_PROBLEMS} more like these")
        raise SettingsError("\n".join(lines)) from error
    truths = [_place(place) for place in _numbers_from_truths(content, settings)]
    if truths:
        lines = [f"{path}: '{place}' is a truth value where a number is wanted" for place in truths]
        raise SettingsError("\n".join(lines[:_MOST_PROBLEMS]))
    return settings


def _wanted_of(model: type[BaseModel]) -> str:
    """Return which settings are wanted in a file, those first without which it is none."""
    by_need = sorted(model.model_fields.items(), key=lambda field: not field[1].is_required())
    names = [field.alias or name for name, field in by_need]
    return f"'key: value' lines for {', '.join(names[:6])} … are wanted"


def _numbers_from_truths(
    given: Any, read: Any, place: tuple[object, ...] = ()
) -> Iterator[tuple[object, ...]]:
    """Yield the places where ``true``, ``yes`` or the like was read as 1: pydantic takes it for a number.

    A number type of our own would have to be named at each of hundreds of settings, and one forgotten would
    take truths again.
    """
    if isinstance(given, bool):
        if isinstance(read, (int, float)) and not isinstance(read, bool):
            yield place
    elif isinstance(given, dict) and isinstance(read, BaseModel):
        for name, field in type(read).model_fields.items():
            key = field.alias or name
            yield from _numbers_from_truths(given.get(key), getattr(read, name), (*place, key))
    elif isinstance(given, dict) and isinstance(read, Mapping):
        for key in given:
            yield from _numbers_from_truths(given[key], read.get(key), (*place, key))
    elif isinstance(given, list) and isinstance(read, (list, tuple)):
        for k, (one, own) in enumerate(zip(given, read, strict=False)):
            yield from _numbers_from_truths(one, own, (*place, k))


def as_shown(value: object) -> str:
    """Return a value that a message may repeat; what may hold a user name and a password is not."""
    text = repr(value)
    return "…" if "@" in text else _shortened(text)


def _changed(content: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    changed = dict(content)
    for name, value in changes.items():
        inner = changed.get(name)
        is_section = isinstance(value, Mapping) and isinstance(inner, Mapping)
        changed[name] = _changed(inner, value) if is_section else value  # type: ignore[arg-type]
    return changed


def explained(problem: Any, model: type[BaseModel]) -> str:
    """Return field, value and what is wanted, of one of the errors that pydantic found in a ``model``."""
    if problem["type"] == "extra_forbidden":
        *within, name = problem["loc"]
        return f"unknown setting '{_place((*within, _Key(name)))}'" + nearest(
            _shortened(str(name)), _known_keys(model, tuple(within))
        )
    where = _place(problem["loc"])
    if problem["type"] == "missing":
        return f"'{where}' is missing"
    message = message_of(problem)
    shown = "…" if _SECRET.search(where) else as_shown(problem["input"])
    return _shortened(f"'{where}' is {shown}: {message}" if where else message, _LONGEST_LINE)


def message_of(problem: Any) -> str:
    """Return what is wrong with a value and what is wanted, of one of pydantic's errors."""
    limits = {name: _plain_number(limit) for name, limit in problem.get("ctx", {}).items()}
    if "pattern" in limits:
        return IN_WORDS.get(str(limits["pattern"])) or f"a text of the form {limits['pattern']} is wanted"
    kind = problem["type"].removesuffix("_type").removesuffix("_parsing")
    if kind in _OF_BOUNDS and str(problem["input"]).lower() == "nan":
        return "that is not a number"
    wanted = _WANTED.get(kind)
    return str(problem["msg"]).removeprefix("Value error, ") if wanted is None else wanted.format(**limits)


def _plain_number(limit: object) -> object:
    """Return a whole number without the decimals that it has as a limit of other numbers."""
    return int(limit) if isinstance(limit, float) and limit.is_integer() else limit


_OF_BOUNDS = {"greater_than", "greater_than_equal", "less_than", "less_than_equal"}
"""Bounds, each of which NaN breaks."""
_LIST = "a list is wanted: [one, another], or lines that begin with '- '"
_SECTION = "a section of 'key: value' lines is wanted"
_WHOLE = "a whole number is wanted, without a unit"
_CHOICE = "{expected} is wanted"
_WANTED = {
    "list": _LIST,
    "tuple": _LIST,
    "set": _LIST,
    "frozen_set": _LIST,
    "dict": _SECTION,
    "model": _SECTION,
    "model_attributes": _SECTION,
    "string": "a text is wanted",
    "path": "a path is wanted",
    "float": "a number is wanted, without its unit",
    "finite_number": "a finite number is wanted",
    "int": _WHOLE,
    "int_from_float": _WHOLE,
    "int_parsing_size": "that is too large a number",
    "bool": "true or false is wanted",
    "literal_error": _CHOICE,
    "enum": _CHOICE,
    "greater_than": "more than {gt} is wanted",
    "greater_than_equal": "at least {ge} is wanted",
    "less_than": "less than {lt} is wanted",
    "less_than_equal": "at most {le} is wanted",
    "too_short": "it has too few entries: at least {min_length}",
    "too_long": "it has too many entries: at most {max_length}",
    "string_too_short": "at least {min_length} character(s) are wanted",
    "string_too_long": "at most {max_length} characters are wanted",
    "missing": "it is missing",
    "extra_forbidden": "there is no such setting",
}
"""By pydantic's kinds of errors, whose own words are of Python's types."""


class _Key(str):
    """A name of the file's own, whatever it looks like."""


def _place(location: tuple[object, ...]) -> str:
    named = (part for part in location if isinstance(part, _Key) or not is_union_tag(part))
    return ".".join(_shortened(str(part)) for part in named)


def _shortened(text: str, length: int = 80) -> str:
    return text if len(text) <= length else f"{text[: length - 1]}…"


def is_union_tag(part: object) -> bool:
    """Return whether a part of a pydantic location names a member of a union, and no setting."""
    return isinstance(part, str) and (part[:1].isupper() or "[" in part)


def _known_keys(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the keys allowed at a place inside ``model``."""
    current: list[type[BaseModel]] = [model]
    for part in location:
        if isinstance(part, int) or is_union_tag(part):
            current = [one for one in current if one.__name__ == part] or current
            continue
        fields = [one.model_fields[part] for one in current if part in one.model_fields]
        if fields:
            current = _models_within(fields[0].annotation)
        else:  # which of a union it is, by the word that tells them apart
            current = [one for one in current if _is_named(one, part)]
    return [field.alias or name for one in current[:1] for name, field in one.model_fields.items()]


def _is_named(model: type[BaseModel], word: str) -> bool:
    return any(word in typing.get_args(field.annotation) for field in model.model_fields.values())


def _models_within(annotation: Any) -> list[type[BaseModel]]:
    """Return the pydantic models inside an annotation such as ``list[Model] | None``."""
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [found for inner in typing.get_args(annotation) for found in _models_within(inner)]
