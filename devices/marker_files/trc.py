"""TRC: marker trajectories as text with tabs (Motion Analysis, OpenSim)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from devices.marker_files.naming import without_prefixes
from devices.marker_files.trial import (
    METRES,
    FloatArray,
    MarkerTrial,
    assumed_metres,
    joined_pieces,
    metres_of,
    seen_points,
)
from devices.vendor_formats.sheets import FormatError, read_lines

FIRST_WORD = "PathFileType"
_NAMES_OF_HEAD = "datarate"
"""Begins the second line of the header, which is the first that tells anything."""
_LINES_BEFORE = 20
"""Within which the header must come: some write blank lines or a comment first."""
_FRAME_NUMBER = re.compile(r"\"?-?\d+([.,]0*)?\"?")
_HEAD_LINES = 5
_LEADING = 2  # frame number, time
_LATEST_S = 1e6
_SAME_RATE = 0.02
_MOST_SHORT = 0.2
"""Of its coordinates, that a row leaves out whose last markers were not seen. The last row may be cut off."""
_MOST_TEXT = 0.5
"""Of a frame's fields that are no numbers; beyond it the line is no frame."""


def read_trc(path: Path) -> MarkerTrial:
    """Read all markers of a file. Raises ``FormatError`` naming the line, and what was found there.

    Empty fields, fields that hold no number, and three times the same number are a marker that was not seen.
    """
    lines = _from_header_on(read_lines(path), path)
    again = next((n for n, line in enumerate(lines[1:], 1) if line.startswith(FIRST_WORD)), len(lines))
    further = [f"{path}: from line {again + 1} on another trial: left out"] if again < len(lines) else []
    lines = lines[:again]
    if len(lines) < _HEAD_LINES:
        raise FormatError(f"{path}: cut off: {len(lines)} lines, of which a header alone takes {_HEAD_LINES}")
    if "\t" not in lines[3]:
        raise FormatError(
            f"{path}: line 4: no tab between the markers' names: TRC columns are parted by tabs"
        )
    head = _head(lines, path)
    first = lines[_HEAD_LINES - 1].split("\t")[0].strip()
    begin = _HEAD_LINES - 1 if _FRAME_NUMBER.fullmatch(first) else _HEAD_LINES  # some leave out X1, Y1, …
    own = [name for name in (x.strip() for x in lines[3].split("\t")[_LEADING:]) if name]
    thrice = len({*own}) == len(own[::3]) and own == [name for name in own[::3] for _ in range(3)]
    labels = without_prefixes(own[::3] if thrice else own)
    rows, notes = _rows(lines, begin, 3 * len(labels), path)
    notes += further
    expected = int(_positive(head, "NumFrames", path))
    if len(rows) != expected:
        notes.append(f"{path}: {len(rows)} frames, of which its header tells {expected}: all that are there")
    if len(labels) != int(_positive(head, "NumMarkers", path)):
        notes.append(
            f"{path}: line 4 names {len(labels)} markers, NumMarkers in line 3 is {head['NumMarkers']}: "
            "line 4 counts"
        )
    points: FloatArray = np.array(rows).reshape(len(rows), len(labels), 3)
    factor, unit_notes = _metres_per_unit(head, points, path)
    times = _times(lines[begin:])
    rate_hz, rate_notes = _rate(head, times, path)
    labels, places, label_notes = joined_pieces(labels, seen_points(points * factor), path)
    notes += [*unit_notes, *rate_notes, *label_notes]
    begins_s = times[0] if times else 0.0
    return MarkerTrial(path.stem, labels, rate_hz, places, {}, factor, begins_s, tuple(notes))


def _from_header_on(lines: list[str], path: Path) -> list[str]:
    """Return the lines from the header's first on, whatever precedes it.

    Raises ``FormatError`` for a file that has none.
    """
    for n, line in enumerate(lines[:_LINES_BEFORE]):
        if line.startswith(FIRST_WORD):
            return lines[n:]
        if line.casefold().startswith(_NAMES_OF_HEAD):
            return ["", *lines[n:]] if n == 0 else lines[n - 1 :]
    raise FormatError(f"{path}: line 1: not a TRC file, which begins with '{FIRST_WORD}': export it again")


def _rate(head: dict[str, str], times: list[float], path: Path) -> tuple[float, list[str]]:
    """Return the frames a second that the header tells, or, where it tells none, the times; and notes.

    Raises ``FormatError`` where neither does.
    """
    written = head["DataRate"]
    usual = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if usual > 0 and written.strip("0.,") == "":
        return 1.0 / usual, [f"{path}: DataRate in line 3 is '{written}': {1.0 / usual:g} by its times"]
    rate_hz = _positive(head, "DataRate", path)
    return rate_hz, _time_notes(times, rate_hz, path)


def _rows(lines: list[str], begin: int, n_values: int, path: Path) -> tuple[list[list[float]], list[str]]:
    """Return the values of all frames, and notes on what was left out at the end: a line cut off, or text.

    Raises ``FormatError`` as ``_row`` does for any other line, and where there is no frame at all.
    """
    own = [(number, line) for number, line in enumerate(lines[begin:], begin + 1) if line.strip()]
    notes = []
    while own and not _FRAME_NUMBER.fullmatch(own[-1][1].split("\t")[0].strip()):
        number, line = own.pop()
        notes = [f"{path}: from line {number} on text and no frames: left out"]
    rows, texts = [], list[str]()
    for at, (number, line) in enumerate(own):
        try:
            rows.append(_row(line, number, n_values, path, texts, is_last=at == len(own) - 1))
        except FormatError:
            # Only the last line can have been cut off; another one like it is damage.
            if at < len(own) - 1 or not rows:
                raise
            notes.append(f"{path}: line {number}, the last one, is cut off: left out")
    if not rows:
        raise FormatError(f"{path}: cut off: no frame behind its header")
    if texts:
        notes.append(f"{path}: {len(texts)} coordinates are no numbers ('{texts[0]}'): not seen there")
    return rows, notes


def _times(rows: list[str]) -> list[float]:
    """Return the times of all frames, s; empty where the first one's field is no time."""
    times = []
    for row in rows:
        fields = row.split("\t")
        try:
            times.append(_number(fields[1]))
        except (IndexError, ValueError):
            if not times and row.strip():
                return []
    return times if times and abs(times[0]) < _LATEST_S else []


def _time_notes(times: list[float], rate_hz: float, path: Path) -> list[str]:
    """Return where the column of times contradicts the rate of the header."""
    steps = np.diff(times)
    if not len(steps):
        return []
    usual = float(np.median(steps))
    if not 1.0 - _SAME_RATE < usual * rate_hz < 1.0 + _SAME_RATE:
        measured = f"{1.0 / usual:.4g} frames a second" if usual > 0 else "no rate"
        return [f"{path}: its times tell {measured}, DataRate in line 3 {rate_hz:g}: DataRate counts"]
    odd = np.flatnonzero(np.abs(steps - usual) > 0.5 * usual)
    if len(odd):
        return [
            f"{path}: times jump behind frame {odd[0] + 1}, by {steps[odd[0]]:.4g} s (places: {len(odd)}): "
            "frames are missing or out of order; they are taken one after the other"
        ]
    return []


def _head(lines: list[str], path: Path) -> dict[str, str]:
    names, values = ([cell.strip() for cell in line.rstrip().split("\t")] for line in lines[1:3])
    if len(names) != len(values) or "" in names:
        names, values = lines[1].split(), lines[2].split()  # some write more than one tab
    head = dict(zip(names, values, strict=False))
    for name in ("DataRate", "NumFrames", "NumMarkers"):
        if name not in head:
            raise FormatError(f"{path}: lines 2 and 3 do not tell {name}: not a TRC file, or damaged")
    return head


def _positive(head: dict[str, str], name: str, path: Path) -> float:
    try:
        value = _number(head[name])
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise FormatError(f"{path}: line 3: {name} is '{head[name]}': a number above 0 is wanted")
    return value


def _metres_per_unit(head: dict[str, str], points: FloatArray, path: Path) -> tuple[float, tuple[str, ...]]:
    unit = head.get("Units", "")
    if not unit:
        return assumed_metres(points, path)
    metres = metres_of(unit)
    if metres is None:
        raise FormatError(f"{path}: line 3: Units is '{unit}': one of {', '.join(METRES)} is wanted")
    return metres, ()


def _row(
    line: str, number: int, n_values: int, path: Path, texts: list[str], *, is_last: bool
) -> list[float]:
    """Return the coordinates of a frame, NaN where a field holds none; fields of text are added to ``texts``.

    Raises ``FormatError`` where their number is another, and where most are text.
    """
    fields = line.rstrip("\r\n").split("\t")[_LEADING:]
    while len(fields) > n_values and not fields[-1].strip():
        fields.pop()
    # a row may leave out the tabs of markers at its end that were not seen
    missing = n_values - len(fields)
    if 0 < missing < (3 if is_last else _MOST_SHORT * n_values):
        fields += [""] * missing
    if len(fields) != n_values:
        raise FormatError(
            f"{path}: line {number}: {len(fields)} coordinates where {n_values} are wanted: "
            "three a marker that line 4 names: export it again"
        )
    values = [_value(field) for field in fields]
    own = [field.strip() for field, value in zip(fields, values, strict=True) if value is None]
    if len(own) > _MOST_TEXT * n_values:
        raise FormatError(f"{path}: line {number}: '{own[0]}' and others are no numbers")
    texts += own
    return [np.nan if value is None else value for value in values]


def _value(field: str) -> float | None:
    """NaN for an empty field, None for one that is no number."""
    try:
        return _number(field)
    except ValueError:
        return None


def _number(field: str) -> float:
    """Return a number with decimal point or comma; where both occur, the last one parts the decimals.

    NaN for an empty field. Raises ``ValueError``.
    """
    text = field.strip().strip("\"'")
    if not text:
        return np.nan
    if "," in text and "." in text:
        thousands = min(",", ".", key=text.rindex)
        text = text.replace(thousands, "")
    return float(text.replace(",", "."))
