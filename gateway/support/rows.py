"""Rows of numbers with names, in memory that compiled code reads and writes too.

A row is one element of a structured array whose numbers all take eight bytes. A kernel gets the array and
names the numbers as attributes (``rows[k].start_us``); Python has the same memory as attributes of a ``Row``,
as plain ``int`` and ``float``, so that neither copies anything to the other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Memory = NDArray[np.uint8]
"""The bytes of one row, or of a part of one."""

WORD = 8
"""Bytes of a number."""


def memory_of(rows: NDArray[Any], row: int = 0) -> Memory:
    """Return the bytes of one row of a structured array (n,), not a copy of them."""
    size = rows.dtype.itemsize
    return rows.view(np.uint8)[row * size : (row + 1) * size]


def part(memory: Memory, layout: np.dtype[Any], name: str) -> Memory:
    """Return the bytes of a field of a row, not a copy of them."""
    assert layout.fields is not None
    declared, begin = layout.fields[name][:2]
    return memory[begin : begin + declared.itemsize]


class Row:
    """One row; classes that extend it name the numbers by ``Integer`` and ``Real``."""

    def __init__(self, memory: Memory) -> None:
        self.integers = memory.data.cast("q")
        self.reals = memory.data.cast("d")


class _Number:
    """Place of a number in the rows of a layout."""

    def __init__(self, layout: np.dtype[Any], name: str) -> None:
        assert layout.fields is not None
        declared, begin = layout.fields[name][:2]
        assert declared.itemsize == WORD, f"{name} is not a number of eight bytes"
        self.place = begin // WORD


class Integer(_Number):
    """An integer of a row as an attribute; stores raise ``ValueError`` beyond 64 bits."""

    def __get__(self, row: Row, _owner: type[Row] | None = None) -> int:
        return row.integers[self.place]

    def __set__(self, row: Row, value: int) -> None:
        row.integers[self.place] = value


class Real(_Number):
    """A floating-point number of a row as an attribute."""

    def __get__(self, row: Row, _owner: type[Row] | None = None) -> float:
        return row.reals[self.place]

    def __set__(self, row: Row, value: float) -> None:
        row.reals[self.place] = value
