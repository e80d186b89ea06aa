"""Rows of numbers with names, in memory that compiled code reads and writes too.

A row is one element of a structured array whose numbers all take eight bytes. A kernel gets the array and
names the numbers as attributes (``rows[k].start_us``); Python has the same memory as attributes of a ``Row``,
as plain ``int`` and ``float``, so that neither copies anything to the other. State that Python hardly touches
is declared more simply, by ``gateway.geometry.records``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

Memory = NDArray[np.uint8]
"""The bytes of one row, or of a part of one."""


def memory_of(rows: NDArray[Any], row: int = 0) -> Memory:
    """Return the bytes of one row of a structured array (n,), not a copy of them."""
    size = rows.dtype.itemsize
    return rows.view(np.uint8)[row * size : (row + 1) * size]


def part(memory: Memory, layout: np.dtype[Any], name: str) -> Memory:
    """Return the bytes of a field of a row, not a copy of them."""
    assert layout.fields is not None
    declared, begin = layout.fields[name][:2]
    return memory[begin : begin + declared.itemsize]


def fields_of(layout: np.dtype[Any], *public: str) -> list[tuple[str, Any]]:
    """Return the ``_fields_`` of a ``Row``: the numbers of a layout by name, those not ``public`` with ``_``
    before it. What is no number is left to ``part``."""
    assert layout.fields is not None
    found: list[tuple[str, Any]] = []
    for name, (declared, *_) in layout.fields.items():
        if declared in _NUMBERS:
            found.append((name if name in public else f"_{name}", _NUMBERS[declared]))
        else:
            found.append((f"{name}_bytes", ctypes.c_uint8 * declared.itemsize))
    return found


_NUMBERS: Mapping[object, type] = {
    np.dtype(np.int64): ctypes.c_int64,
    np.dtype(np.float64): ctypes.c_double,
}


class Row(ctypes.Structure):
    """One row. A class that extends it names its ``layout``, has ``_fields_ = fields_of(layout)`` and
    annotates those that it uses; integers wrap at 64 bits."""

    layout: ClassVar[np.dtype[Any]]
    memory: Memory
    """The bytes of the row, not a copy of them. Taken from the array and not from the row: a row that keeps
    an array over itself could never be freed, since NumPy's arrays hide from the garbage collector."""

    def __new__(cls, *_arguments: object, memory: Memory | None = None, **_named: object) -> Self:
        """Return a row of its own, all zeros, or the one that has this memory."""
        kept = memory_of(np.zeros(1, cls.layout)) if memory is None else memory
        row = cls.from_buffer(kept.data)
        row.memory = kept
        return row
