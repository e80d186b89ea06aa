"""Tables of marker trajectories as programs export them: QTM's TSV, Motive's and Nexus' CSV.

QTM writes lines of ``NAME<tab>value`` above the frames, with ``FREQUENCY`` and ``MARKER_NAMES``; lengths
are millimetres. Motive writes pairs of name and value in the first line, then rows of what each column is
(type, name, position, axis). Nexus writes sections, of which ``Trajectories`` is the one of the markers: its
rate, names, axes and units, a line each.
"""

from __future__ import annotations

import codecs
import csv
import math
import re
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import numpy as np

from devices.marker_files.naming import without_prefixes
from devices.marker_files.trial import METRES, FloatArray, MarkerTrial, joined_pieces, metres_of, seen_points
from devices.vendor_formats.sheets import FormatError, read_lines

QTM, MOTIVE, NEXUS = "NO_OF_FRAMES", "Format Version", "Trajectories"
"""What such files begin with; a section of Nexus may stand behind others."""
_QTM_NAME = re.compile(r"[A-Z][A-Z_]*[A-Z]")
_AXES = ["X", "Y", "Z"]
_NAMELESS = re.compile(r"unlabell?ed\b.*|", re.IGNORECASE)
_MOTIVE_MARKER = "marker"
"""Type of Motive's columns of points that were seen; rigid bodies, bones and their markers are computed."""
_REMEDY = "export the trial again, or as C3D"


@dataclass(frozen=True)
class _Columns:
    """Where the numbers of a table are, and what they mean."""

    labels: list[str]
    first: list[int]
    """Column of each marker's x, which y and z follow."""
    rate_hz: float
    metres: float
    begin: int
    """Index of the first row of numbers."""
    is_numbered: bool = True
    """Whether the first column holds the frame's number."""
    time: int | None = None
    """Column of the time, s."""
    n_frames: int | None = None
    """As the header tells."""


def read_table(path: Path) -> MarkerTrial:
    """Read the markers of a table. Raises ``FormatError`` with what is wrong, where, and what to do."""
    lines = read_lines(path)
    start = lines[0].lstrip('"')
    delimiter = "\t" if start.startswith(QTM) else max(",;\t", key=lines[0].count)
    rows = list(csv.reader(lines, delimiter=delimiter))
    if start.startswith(QTM):
        found = _qtm(rows, path)
    elif start.startswith(MOTIVE):
        found = _motive(rows, path)
    else:
        rows = list(csv.reader(lines, delimiter=max(",;\t", key="".join(lines[:20]).count)))
        found = _nexus(rows, path)
    return _trial(rows, found, path)


def _qtm(rows: list[list[str]], path: Path) -> _Columns:
    head: dict[str, list[str]] = {}
    begin = 0
    for row in rows:
        if not row or not _QTM_NAME.fullmatch(row[0].strip()):
            break
        head.setdefault(row[0].strip(), [cell.strip() for cell in row[1:]])
        begin += 1
    labels = [name for name in head.get("MARKER_NAMES", []) if name]
    if "3D" not in head.get("DATA_INCLUDED", ["3D"]) or not labels:
        raise FormatError(f"{path}: no MARKER_NAMES, or no 3D data: export 3D data with headers from QTM")
    # A line of column names, with frame and time before them, comes only where it was asked for.
    columns = rows[begin] if begin < len(rows) else []
    leading = 0
    if columns and not _is_number(columns[0]):
        leading = sum(
            cell.strip().casefold() in {"frame", "time", "smpte", "timestamp"} for cell in columns[:4]
        )
        begin += 1
    elif columns:
        leading = max(0, len([cell for cell in columns if cell.strip()]) - 3 * len(labels))
        leading = leading if leading <= 2 else 0
    first = [leading + 3 * m for m in range(len(labels))]
    rate_hz = _rate(head.get("FREQUENCY", [""])[0], "FREQUENCY", path)
    count = _number(head.get("NO_OF_FRAMES", [""])[0])
    return _Columns(
        labels, first, rate_hz, METRES["mm"], begin,
        is_numbered=leading > 0,
        time=1 if leading == 2 else None,
        n_frames=None if math.isnan(count) else int(count),
    )  # fmt: skip


def _motive(rows: list[list[str]], path: Path) -> _Columns:
    head = {name.strip(): value.strip() for name, value in zip(rows[0][::2], rows[0][1::2], strict=False)}
    axes = next((n for n, row in enumerate(rows[:12]) if row and row[0].strip() == "Frame"), None)
    if axes is None or axes < 3:
        raise FormatError(f"{path}: no line that begins with Frame below Motive's header: {_REMEDY}")
    above = [[cell.strip() for cell in row] for row in rows[1:axes] if any(cell.strip() for cell in row)]
    types = next((row for row in above if {"marker", "bone", "rigid body"} & {c.casefold() for c in row}), [])
    names = above[above.index(types) + 1] if types and above.index(types) + 1 < len(above) else []
    letters = [cell.strip().upper() for cell in rows[axes]]
    first = [
        n for n, (kind, _, what) in enumerate(zip(types, names, above[-1] if above else [], strict=False))
        if kind.casefold() == _MOTIVE_MARKER and letters[n : n + 3] == _AXES and what == "Position"
    ]  # fmt: skip
    if not first:
        raise FormatError(f"{path}: no columns of markers: export with Markers (Motive: CSV, Markers on)")
    unit = head.get("Length Units", "Meters")
    metres = metres_of(unit)
    if metres is None:
        raise FormatError(
            f"{path}: Length Units is '{unit}': one of {', '.join(METRES)} is wanted: {_REMEDY}"
        )
    rate_hz = _rate(head.get("Export Frame Rate") or head.get("Capture Frame Rate", ""), "Frame Rate", path)
    return _Columns([names[n] for n in first], first, rate_hz, metres, axes + 1, time=1)


def _nexus(rows: list[list[str]], path: Path) -> _Columns:
    at = next((n for n, row in enumerate(rows) if row and row[0].strip() == NEXUS), None)
    if at is None or at + 5 >= len(rows):
        raise FormatError(
            f"{path}: no table of markers as QTM, Motive or Nexus export it (it lacks '{NEXUS}'): {_REMEDY}"
        )
    names, axes, units = rows[at + 2], rows[at + 3], rows[at + 4]
    first = [n for n in range(2, len(axes) - 2) if [cell.strip() for cell in axes[n : n + 3]] == _AXES]
    labels = [names[n].strip() if n < len(names) else "" for n in first]
    unit = units[first[0]] if first and first[0] < len(units) else "mm"
    metres = metres_of(unit)
    if not first or metres is None:
        raise FormatError(f"{path}: line {at + 4}: no X, Y, Z in mm of any marker: {_REMEDY}")
    return _Columns(labels, first, _rate(rows[at + 1][0], "line 2 of Trajectories", path), metres, at + 5)


def _trial(rows: list[list[str]], found: _Columns, path: Path) -> MarkerTrial:
    """Return the rows of numbers as a trial; of numbered ones, those before the first without a number."""
    frames = [row for row in rows[found.begin :] if row]
    if found.is_numbered:
        frames = list(takewhile(lambda row: _is_number(row[0]), frames))
    if not frames:
        raise FormatError(f"{path}: no frame below its header: {_REMEDY}")
    width = max(found.first) + 3
    cells = [[*row, *[""] * (width - len(row))] for row in frames]
    values = [[_number(cell) for n in found.first for cell in row[n : n + 3]] for row in cells]
    points: FloatArray = np.array(values).reshape(len(values), -1, 3) * found.metres
    own = without_prefixes(["" if _NAMELESS.fullmatch(label) else label for label in found.labels])
    labels, places, notes = joined_pieces(own, seen_points(points), path)
    if found.n_frames not in (None, len(frames)):
        more = f"{path}: {len(frames)} frames, of which its header tells {found.n_frames}: all that are there"
        notes = (more, *notes)
    begins_s = 0.0
    if found.time is not None:
        begins_s = _number(cells[0][found.time])
    elif found.is_numbered:
        begins_s = (_number(cells[0][0]) - 1.0) / found.rate_hz
    begins_s = max(0.0, begins_s) if math.isfinite(begins_s) else 0.0
    return MarkerTrial(path.stem, labels, found.rate_hz, places, {}, found.metres, begins_s, notes)


def _rate(text: str, name: str, path: Path) -> float:
    rate_hz = _number(text)
    if not 0 < rate_hz < 1e5:
        raise FormatError(f"{path}: {name} is '{text}': a number of frames a second is wanted: {_REMEDY}")
    return rate_hz


def _is_number(cell: str) -> bool:
    return not math.isnan(_number(cell))


def _number(cell: str) -> float:
    """Return a number with decimal point or comma; NaN for a cell that holds none."""
    try:
        return float(cell.strip().replace(",", "."))
    except ValueError:
        return math.nan


def is_table(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of such a table."""
    text = head.removeprefix(codecs.BOM_UTF8).decode("latin-1").lstrip('"')
    return text.startswith((QTM, MOTIVE, NEXUS))
