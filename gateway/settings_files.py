"""YAML files to checked settings, with errors that name the file, the field, the value and the remedy."""

from __future__ import annotations

import types
import typing
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from gateway.errors import SettingsError, nearest

Model = TypeVar("Model", bound=BaseModel)


def shipped_folder() -> Path:
    """The shipped configuration: ``config/`` of the source tree, or its copy in an installed package."""
    in_tree = Path(__file__).parent.parent / "config"
    return in_tree if (in_tree / "bodies").is_dir() else Path(__file__).parent / "shipped_config"


def find_file(name: str, kind: str, beside: Path | None = None) -> Path:
    """The file that ``name`` means: a path (also relative to the naming file's folder), or a shipped one.

    kind: "bodies" or "rigs". Raises ``SettingsError`` naming the shipped ones.
    """
    candidates = [Path(name)]
    if beside is not None:
        candidates.insert(0, beside.parent / name)
    candidates.append(shipped_folder() / kind / f"{name}.yaml")
    for path in candidates:
        if path.is_file():
            return path
    shipped = sorted(path.stem for path in (shipped_folder() / kind).glob("*.yaml"))
    raise SettingsError(
        f"there is no file '{name}', and no shipped one of that name in {kind}{nearest(name, shipped)}"
    )


def load_yaml(path: Path) -> Any:
    """The content of a YAML file. Raises ``SettingsError`` with file and line when it cannot be read."""
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SettingsError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise SettingsError(f"{path}:{where} {problem}") from error


def load_settings(path: Path, model: type[Model]) -> Model:
    """A YAML file as ``model``. Raises ``SettingsError`` with one line for each thing wrong."""
    content = load_yaml(path)
    if not isinstance(content, dict):
        raise SettingsError(
            f"{path}: holds {type(content).__name__}, not named settings ('key: value' lines)"
        )
    try:
        return model.model_validate(content)
    except ValidationError as error:
        lines = [f"{path}: {_explain(problem, model)}" for problem in error.errors()]
        raise SettingsError("\n".join(lines)) from error


def _explain(problem: Any, model: type[BaseModel]) -> str:
    location = [part for part in problem["loc"] if not _is_union_tag(part)]
    where = ".".join(str(part) for part in location)
    if problem["type"] == "extra_forbidden":
        known = _known_keys(model, problem["loc"][:-1])
        return f"unknown setting '{where}'{nearest(str(location[-1]), known)}"
    if problem["type"] == "missing":
        return f"'{where}' is missing"
    message = problem["msg"].removeprefix("Value error, ")
    return f"'{where}' is {problem['input']!r}: {message}" if where else message


def _is_union_tag(part: object) -> bool:
    return isinstance(part, str) and (part[:1].isupper() or "[" in part)


def _known_keys(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The keys allowed at a place inside ``model``."""
    current: type[BaseModel] | None = model
    for part in location:
        if current is None or isinstance(part, int) or _is_union_tag(part):
            continue
        field = current.model_fields.get(part)
        current = _model_within(field.annotation) if field else None
    if current is None:
        return []
    return [field.alias or name for name, field in current.model_fields.items()]


def _model_within(annotation: Any) -> type[BaseModel] | None:
    """The first pydantic model inside an annotation such as ``list[Model] | None``."""
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        return annotation if issubclass(annotation, BaseModel) else None
    for inner in typing.get_args(annotation):
        if (found := _model_within(inner)) is not None:
            return found
    return None
