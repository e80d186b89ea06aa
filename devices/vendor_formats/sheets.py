"""Tables of numbers in text files, with errors that say where they are wrong."""

from __future__ import annotations

import codecs
import csv
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from devices.recording_file import RecordingError

FloatArray = NDArray[np.float64]

_DELIMITERS = "\t;,"
_HEADER_LINES = 200
"""Within which the names of the columns must come."""
_SHOWN = 40
LARGEST_FILE = 1 << 30
"""Bytes: 40 hours of a module at 100 Hz. Read whole, a file takes several times as much memory."""


class FormatError(RecordingError):
    """A file that is not what its format promises; ``str(error)`` says where, what, and the remedy."""


@dataclass
class Sheet:
    """A text file with a line of column names and rows of numbers below it."""

    path: Path
    preamble: tuple[str, ...]
    """Lines above the names."""
    names: tuple[str, ...]
    rows: list[str]
    delimiter: str
    is_partial: bool
    """Whether to end at the first bad row, instead of refusing the file."""
    note: str | None = None
    """What was left out or mended, after ``columns``."""
    first_line: int = 0
    """Number of the line that is the first of ``rows``."""

    def add_note(self, text: str) -> None:
        """Note one thing more, once."""
        if self.note is None or text not in self.note:
            self.note = text if self.note is None else f"{self.note}; {text}"

    def columns(self, wanted: Sequence[str]) -> FloatArray:
        """Return columns (n, len(wanted)); an empty cell is NaN. Raises ``FormatError``."""
        absent = [name for name in wanted if name not in self.names]
        if absent:
            raise FormatError(
                f"{self.path}, line {len(self.preamble) + 1}: no column '{absent[0]}'; "
                f"there are {', '.join(self.names)}"
            )
        twice = [name for name in wanted if self.names.count(name) > 1]
        if twice:
            raise FormatError(
                f"{self.path}, line {len(self.preamble) + 1}: column '{twice[0]}' is there twice: give each "
                "a name of its own"
            )
        self._refuse_comma_decimals()
        at = [self.names.index(name) for name in wanted]
        if not self.rows:
            raise FormatError(f"{self.path} has no row of numbers below line {len(self.preamble) + 1}")
        try:
            table: FloatArray = np.loadtxt(
                self.rows, delimiter=self.delimiter, usecols=at, ndmin=2, comments=None, quotechar='"'
            )
        # NumPy reads whole numbers fast, but neither empty cells nor does it say where it failed.
        except ValueError:
            table = self._one_by_one(at)
        if not len(table):
            raise FormatError(f"{self.path} has no row of numbers below line {len(self.preamble) + 1}")
        return table

    def _refuse_comma_decimals(self) -> None:
        """Raise ``FormatError`` where commas part cells and decimals alike, which shifts all columns."""
        if self.delimiter != "," or not self.rows:
            return
        n_cells = len(self._cells(self.rows[0].rstrip(", ")))
        if n_cells > len(self.names):
            raise FormatError(
                f"{self.path}, line {self.first_line}: has {n_cells} cells for {len(self.names)} columns: "
                "where decimals are written with commas, let semicolons or tabs part the cells"
            )

    def _cells(self, line: str) -> list[str]:
        if '"' not in line:
            return line.split(self.delimiter)
        return next(csv.reader([line], delimiter=self.delimiter), [])

    def first_cell(self, name: str) -> str:
        """Return the text of a column in the first row; empty: it is not there."""
        cells = self.rows[0].split(self.delimiter) if self.rows and name in self.names else []
        at = self.names.index(name) if cells else 0
        return _bare(cells[at])[:_SHOWN] if at < len(cells) else ""

    def has(self, *names: str) -> bool:
        """Return whether all these columns are there."""
        return all(name in self.names for name in names)

    def _one_by_one(self, at: list[int]) -> FloatArray:
        """Return the columns, read cell by cell: slowly, but with errors that name the row."""
        table = []
        for row, line in enumerate(self.rows):
            try:
                table.append(self._row(line, at, self.first_line + row))
            except FormatError as error:
                if not self.is_partial:
                    remedy = "; --partial imports the rows before it" if row else ""
                    raise FormatError(f"{error}{remedy}") from None
                self.add_note(f"{error}: this row and {len(self.rows) - row - 1} after it were left out")
                del self.rows[row:]
                break
        return np.array(table, dtype=np.float64).reshape(-1, len(at))

    def _row(self, line: str, at: list[int], number: int) -> list[float]:
        cells = self._cells(line)
        if len(cells) <= max(at):
            raise FormatError(
                f"{self.path}, line {number}: ends after {len(cells)} of {len(self.names)} columns, "
                "as a file does that was cut off"
            )
        return [self._number(_bare(cells[i]), number, self.names[i]) for i in at]

    def _number(self, text: str, line: int, column: str) -> float:
        try:
            return float(text.replace(",", ".")) if text else float("nan")
        except ValueError:
            raise FormatError(
                f"{self.path}, line {line}, column '{column}': a number is wanted, not {text[:_SHOWN]!r}"
            ) from None


def _bare(cell: str) -> str:
    """Return a cell without the blanks and the quotes around it."""
    return cell.strip().strip('"').strip()


def _is_words(cells: Sequence[str]) -> bool:
    """Return whether cells hold text, as units, and no number."""
    texts = [text for text in map(_bare, cells) if text]
    return len(texts) > 1 and not any(map(_is_number, texts))


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file. Raises ``FormatError`` when it cannot be read, is empty or no text."""
    try:
        refuse_device(path)
        if path.stat().st_size > LARGEST_FILE:
            raise FormatError(f"{path} is larger than {LARGEST_FILE >> 20} MiB: split it")
        data = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    if not data.strip():
        raise FormatError(f"{path} is empty: export or copy it again")
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):  # as some spreadsheets write text
        return data.decode("utf-16", errors="replace").splitlines()
    zero = data.find(0)
    if zero >= 0:
        raise FormatError(
            f"{path} is no text file: byte {zero} is 0 (a binary file, or one never written out)"
        )
    return data.decode("utf-8-sig", errors="replace").splitlines()


def refuse_device(path: Path) -> None:
    """Raise ``FormatError`` for a pipe or a device, which may have no end. Raises ``OSError``."""
    kind = path.stat().st_mode
    if not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
        raise FormatError(f"{path} is a pipe or a device: save what comes of it as a file, and import that")


def open_sheet(
    path: Path, is_header: Callable[[list[str]], bool], wanted: str, *, is_partial: bool = False
) -> Sheet:
    """Return the table of a file whose line of names is the first that ``is_header`` accepts.

    wanted: what that line should have, for the error. Raises ``FormatError``.
    """
    lines = read_lines(path)
    for index, line in enumerate(lines[:_HEADER_LINES]):
        # The character that is most frequent in the line: commas may also be in numbers or names.
        delimiter = max(_DELIMITERS, key=line.count)
        names = [_bare(name) for name in line.split(delimiter)]
        if is_header(names):
            rows = lines[index + 1 :]
            while rows and not rows[-1].strip():
                rows.pop()
            # Lines may end with a delimiter, which names no column.
            while names and not names[-1]:
                names.pop()
            preamble, first_line, note = tuple(lines[:index]), index + 2, None
            if len(rows) > 1 and _is_words(rows[0].split(delimiter)):
                del rows[0]
                note = (
                    f"{path}, line {first_line}: holds no number and was passed over, as a line of units is"
                )
                first_line += 1
            return Sheet(path, preamble, tuple(names), rows, delimiter, is_partial, note, first_line)
    raise FormatError(
        f"{path}: none of the first {_HEADER_LINES} lines names the columns; {wanted} is wanted"
    )
