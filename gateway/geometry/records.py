"""Named values in one block of memory: NumPy's structured types, declared as classes.

A class that extends ``Record`` names the fields and says what they are; ``records`` makes an array of them.
In Python as in a kernel ``segments[s].zero_rate.rate[i]`` is then a number in that memory, nothing is copied
and a kernel is handed a record as one address. All fields are multiples of eight bytes: none is padded.
"""

from __future__ import annotations

from typing import (
    Annotated,
    Any,
    NamedTuple,
    Protocol,
    TypeVar,
    cast,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

import numpy as np
from numpy.typing import NDArray

from gateway.frames import FloatArray


class Record:
    """What declarations extend. What ``records`` returns is in truth ``np.record``, with these attributes."""


R = TypeVar("R", bound=Record)
R_co = TypeVar("R_co", bound=Record, covariant=True)

Vector = Annotated[FloatArray, 3]
Matrix = Annotated[FloatArray, 3, 3]
Six = Annotated[FloatArray, 6]
Block = Annotated[FloatArray, 6, 6]


class Records(Protocol[R_co]):
    """An array of records, as kernels and type checkers see it; in truth an ``np.ndarray``."""

    def __len__(self) -> int: ...
    @overload
    def __getitem__(self, key: int) -> R_co: ...
    @overload
    def __getitem__(self, key: str) -> NDArray[Any]: ...
    def __setitem__(self, key: Any, value: Any) -> None: ...
    def copy(self) -> Any:
        """Return a copy that shares no memory."""
        ...


def layout(kind: type[Record]) -> np.dtype[np.void]:
    """Return the structured type of the fields that a class declares.

    They are ``float``, ``int``, arrays as ``Vector`` (``Annotated[FloatArray, 3]``), other such classes, and
    arrays of these (``Annotated[Records[Reading], Reading, 12]``). Raises ``TypeError`` for anything else
    and for a name that attributes of NumPy hide.
    """
    fields = [(name, *_field(hint)) for name, hint in get_type_hints(kind, include_extras=True).items()]
    hidden = [name for name, *_ in fields if hasattr(np.record, name) or hasattr(np.ndarray, name)]
    if hidden:
        raise TypeError(f"{kind.__name__}: {', '.join(hidden)} cannot be read, NumPy has the name itself")
    return np.dtype(fields, align=True)


def _field(hint: Any) -> tuple[Any, ...]:
    """Return type and shape of a field as ``np.dtype`` takes them."""
    if get_origin(hint) is Annotated:
        _, *extent = get_args(hint)
        if isinstance(extent[0], type):
            return layout(extent[0]), tuple(extent[1:])
        return "f8", tuple(extent)
    if hint in (float, int):
        return ("f8" if hint is float else "i8",)
    if isinstance(hint, type) and issubclass(hint, Record):
        return (layout(hint),)
    raise TypeError(f"a record cannot hold {hint!r}")


_TYPES: dict[type[Record], np.dtype[np.void]] = {}


def records(kind: type[R], n: int) -> Records[R]:
    """Return n records, all zero."""
    if kind not in _TYPES:  # the same object each time: the compiler knows it at once
        _TYPES[kind] = np.dtype((np.record, layout(kind)))
    return cast(Records[R], np.zeros(n, _TYPES[kind]))


def record(kind: type[R]) -> R:
    """Return one record, all zero."""
    return records(kind, 1)[0]


def array_of(one: R) -> Records[R]:
    """Return the array that a record made by ``record`` is all of."""
    return cast(Records[R], cast(np.record, one).base)


class Constant(NamedTuple):
    """A row of a table of constants."""

    default: float
    unit: str
    meaning: str
    origin: str


def constant(default: float, unit: str, meaning: str, origin: str) -> Any:
    """Return a row; in the eyes of type checkers the number that a record has in its place."""
    return Constant(default, unit, meaning, origin)


def constants_of(table: type[Record]) -> dict[str, Constant]:
    """Return the rows of a table by name: a class of which every field is a ``constant``."""
    return {name: row for name, row in vars(table).items() if isinstance(row, Constant)}


def table_of(table: type[R], **changes: float) -> R:
    """Return a record of the defaults, some of them changed. Raises ``TypeError`` for a name not in there."""
    rows = constants_of(table)
    unknown = changes.keys() - rows.keys()
    if unknown:
        raise TypeError(f"no such constant: {', '.join(sorted(unknown))}")
    made = record(table)
    for name, row in rows.items():
        setattr(made, name, changes.get(name, row.default))
    return made
