"""The worn suit as JSON, every number bit for bit.

A rig file cannot serve: reading one normalises quaternions, and the last bit of a number then differs. Fields
are found by the dataclasses themselves, so that a suit that grows is still stored whole.
"""

from __future__ import annotations

import dataclasses
import enum
import json
import re
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.errors import SettingsError

_Dataclass = TypeVar("_Dataclass")


def encode_suit(suit: WornSuit) -> bytes:
    """The suit as JSON text."""
    return json.dumps(_plain(suit), indent=1).encode()


def decode_suit(text: bytes) -> WornSuit:
    """The suit that ``text`` was made of. Raises ``SettingsError`` for a text that describes none."""
    try:
        return _built(WornSuit, json.loads(text))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise SettingsError(f"the recorded suit cannot be read: {error}") from error


def _plain(value: Any) -> Any:
    """JSON values; numbers of arrays in their shortest exact form."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: _plain(getattr(value, field.name)) for field in fields if field.init}
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.str, "shape": list(value.shape), "values": value.ravel().tolist()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return _plain_scalar(value)


def _plain_scalar(value: Any) -> Any:
    if isinstance(value, enum.Enum):
        return value.value
    return value.item() if isinstance(value, np.generic) else value


def _built(kind: type[_Dataclass], plain: dict[str, Any]) -> _Dataclass:
    """A dataclass of its plain form: fields that the text lacks keep their defaults, others are refused."""
    hints = typing.get_type_hints(kind)
    names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(plain) - names)
    if unknown:
        raise ValueError(f"'{unknown[0]}' is not known to this version: a newer one wrote it")
    return kind(**{name: _value(hints[name], item) for name, item in plain.items()})


def _value(hint: Any, plain: Any) -> Any:
    """A field's value of its plain form, by the field's type."""
    if isinstance(plain, dict) and set(plain) == {"dtype", "shape", "values"}:
        return np.array(plain["values"], dtype=_number_type(plain["dtype"])).reshape(plain["shape"])
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in {typing.Union, types.UnionType}:
        options = [option for option in inner if option is not type(None)]
        return None if plain is None else _value(options[0], plain)
    if origin in {tuple, list}:
        hints = inner if len(inner) == len(plain) and ... not in inner else (inner[0],) * len(plain)
        return origin(_value(each, item) for each, item in zip(hints, plain, strict=True))
    if origin in {dict, Mapping}:
        return {_value(inner[0], key): _value(inner[1], item) for key, item in plain.items()}
    return _scalar(hint, plain)


def _number_type(name: object) -> np.dtype[Any]:
    """Plain numbers only: numpy would also read objects, records and expressions from such a name."""
    if not re.fullmatch(r"[<>|=][biuf][1248]", str(name)):
        raise ValueError(f"{str(name)[:20]!r} is no type of a number")
    return np.dtype(str(name))


def _scalar(hint: Any, plain: Any) -> Any:
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _built(hint, plain)
    is_converted = isinstance(hint, type) and (issubclass(hint, enum.Enum) or hint is int)
    return hint(plain) if is_converted else plain
