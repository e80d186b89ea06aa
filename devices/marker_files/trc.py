"""TRC: marker trajectories as text with tabs (Motion Analysis, OpenSim)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from devices.marker_files.naming import without_prefixes
from devices.marker_files.trial import METRES, FloatArray, MarkerTrial, label_notes, metres_of, seen_points
from devices.vendor_formats.sheets import FormatError, read_lines

FIRST_WORD = "PathFileType"
_FRAME_NUMBER = re.compile(r"\"?-?\d+([.,]0*)?\"?")
_HEAD_LINES = 5
_LEADING = 2  # frame number, time
_LATEST_S = 1e6
_SAME_RATE = 0.02
_MOST_TEXT = 0.5
"""Of a frame's fields that are no numbers; beyond it the line is no frame."""


def read_trc(path: Path) -> MarkerTrial:
    """Read all markers of a file. Raises ``FormatError`` naming the line, and what was found there.

    Empty fields, fields that hold no number, and three times the same number are a marker that was not seen.
    """
    lines = read_lines(path)
    if not lines[0].startswith(FIRST_WORD):
        raise FormatError(
            f"{path}: line 1: not a TRC file, which begins with '{FIRST_WORD}': export it again"
        )
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
    labels = without_prefixes([name for name in (x.strip() for x in lines[3].split("\t")[_LEADING:]) if name])
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
    factor = _metres_per_unit(head, path)
    places: FloatArray = np.array(rows).reshape(len(rows), len(labels), 3) * factor
    rate_hz = _positive(head, "DataRate", path)
    notes += label_notes(labels, path)
    times = _times(lines[begin:])
    notes += _time_notes(times, rate_hz, path)
    begins_s = times[0] if times else 0.0
    return MarkerTrial(path.stem, labels, rate_hz, seen_points(places), {}, factor, begins_s, tuple(notes))


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
            rows.append(_row(line, number, n_values, path, texts))
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
    head = dict(zip(lines[1].split(), lines[2].split(), strict=False))  # some write more than one tab
    for name in ("DataRate", "NumFrames", "NumMarkers", "Units"):
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


def _metres_per_unit(head: dict[str, str], path: Path) -> float:
    metres = metres_of(head["Units"])
    if metres is None:
        raise FormatError(f"{path}: line 3: Units is '{head['Units']}': one of {', '.join(METRES)} is wanted")
    return metres


def _row(line: str, number: int, n_values: int, path: Path, texts: list[str]) -> list[float]:
    """Return the coordinates of a frame, NaN where a field holds none; fields of text are added to ``texts``.

    Raises ``FormatError`` where their number is another, and where most are text.
    """
    fields = line.rstrip("\r\n").split("\t")[_LEADING:]
    while len(fields) > n_values and not fields[-1].strip():
        fields.pop()
    # a row may leave out the tabs of markers at its end that were not seen
    fields += [""] * (-len(fields) % 3 if len(fields) < n_values else 0)
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
