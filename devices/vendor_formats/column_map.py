"""CSV of any kind, its columns named in a map: which are what, in which unit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from devices.recorded_tracks import FusedTrack, ModuleTrack, RecordedTracks
from devices.vendor_formats.gaps import RATES, in_order, index_of_times, rate_of, spread
from devices.vendor_formats.sheets import FloatArray, FormatError, Sheet, open_sheet
from devices.vendor_formats.tracks import NORTH_WEST_UP_DEG, add_tracks, refuse_repeats, turned
from firmware_protocol.samples import STANDARD_GRAVITY

Three = Annotated[list[str], Field(min_length=3, max_length=3)]
Four = Annotated[list[str], Field(min_length=4, max_length=4)]
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SCALES = {
    "m/s²": 1.0,
    "m/s^2": 1.0,
    "g": STANDARD_GRAVITY,
    "mg": 1e-3 * STANDARD_GRAVITY,
    "rad/s": 1.0,
    "deg/s": np.pi / 180,
}
_BEYOND = (4000.0, 350.0)
"""m/s² and rad/s (400 g, 20 000 °/s): no sensor that is worn reads more."""
_USUAL_FORCE = (3.0, 30.0)
"""m/s², what the median length of the specific force lies between: at rest it is that of gravity."""
_USUAL_RATE = 20.0
"""rad/s, what the median length of the angular rate lies below: nobody turns so fast for long."""
_WORLDS = {"enu": 0.0, "nwu": NORTH_WEST_UP_DEG}


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TimeColumn(_Strict):
    """Where the time stands."""

    column: str
    unit: Literal["s", "ms", "us", "ns"] = "s"


class Acceleration(_Strict):
    """Of the accelerometer; at rest it reads gravity, upwards."""

    columns: Three
    unit: Literal["m/s²", "m/s^2", "g", "mg"] = "m/s²"


class AngularRate(_Strict):
    """Of the gyroscope."""

    columns: Three
    unit: Literal["rad/s", "deg/s"] = "rad/s"


class Field3(_Strict):
    """Of the magnetometer, in any unit."""

    columns: Three


class Orientation(_Strict):
    """Fused elsewhere, sensor axes to a world with Z up."""

    columns: Four
    order: Literal["wxyz", "xyzw"] = "wxyz"
    world: Literal["enu", "nwu"] = Field(default="enu", description="east-north-up or north-west-up")
    inverse: bool = Field(default=False, description="the file has world axes to sensor axes")


class MappedModule(_Strict):
    """One module's columns."""

    name: str = Field(min_length=1, description="what it is called; best the segment's name")
    file: str | None = Field(default=None, description="its file beside the map; none: the one imported")
    specific_force: Acceleration | None = None
    angular_rate: AngularRate | None = None
    magnetic_field: Field3 | None = None
    orientation: Orientation | None = None

    @model_validator(mode="after")
    def _has_something(self) -> MappedModule:
        if self.specific_force is None and self.orientation is None:
            raise ValueError("a module needs 'specific_force' or 'orientation'")
        return self


class ColumnMap(_Strict):
    """A map file."""

    rate_hz: float | None = Field(
        default=None, ge=RATES[0], le=RATES[1], description="for files without a time"
    )
    time: TimeColumn | None = None
    modules: list[MappedModule] = Field(min_length=1, max_length=60)

    @model_validator(mode="after")
    def _has_time(self) -> ColumnMap:
        if (self.time is None) == (self.rate_hz is None):
            raise ValueError("either 'time' (a column) or 'rate_hz' is needed")
        return self


def read_mapped_csv(
    path: Path | None, columns: ColumnMap, folder: Path, *, partial: bool = False
) -> RecordedTracks:
    """Read modules; ``path`` is of those that name no file, ``folder`` of those that do.

    Raises ``FormatError``.
    """
    refuse_repeats([module.name for module in columns.modules])
    sheets: dict[Path, Sheet] = {}
    modules: list[ModuleTrack] = []
    fused: list[FusedTrack] = []
    read = []
    for mapped in columns.modules:
        file = path if mapped.file is None else folder / mapped.file
        if file is None:
            raise FormatError(f"module '{mapped.name}' of the map names no file, and none was given")
        # Several modules may stand in one file, which is read once.
        if file not in sheets:
            sheets[file] = _sheet(file, mapped, columns, partial)
        read.append(_module(sheets[file], mapped, columns))

    zero = min(times[0] for times, _ in read)
    for number, (mapped, (times, rows)) in enumerate(zip(columns.modules, read, strict=True)):
        add_tracks(number, mapped.name, times - zero, rows, modules, fused)
    rate_hz = columns.rate_hz or rate_of(np.diff(read[0][0]), next(iter(sheets)), decimals=2)
    notes = tuple(sheet.note for sheet in sheets.values() if sheet.note)
    return RecordedTracks("csv", rate_hz, tuple(modules), fused=tuple(fused), notes=notes)


def _wanted(mapped: MappedModule) -> list[str]:
    parts = (mapped.specific_force, mapped.angular_rate, mapped.magnetic_field, mapped.orientation)
    return [name for part in parts if part is not None for name in part.columns]


def _sheet(file: Path, mapped: MappedModule, columns: ColumnMap, partial: bool) -> Sheet:
    wanted = [*([columns.time.column] if columns.time else []), *_wanted(mapped)]
    return open_sheet(
        file,
        lambda names: wanted[0] in names,
        f"a line with '{wanted[0]}', as the map says",
        is_partial=partial,
    )


def _module(sheet: Sheet, mapped: MappedModule, columns: ColumnMap) -> tuple[FloatArray, FloatArray]:
    """Return times (n,), s, and readings (n, 13): specific force, angular rate, field, orientation."""
    names = _wanted(mapped)
    if columns.time is not None:
        _refuse_clock_times(sheet, columns.time)
    table = sheet.columns([*([columns.time.column] if columns.time else []), *names])
    values = table[:, -len(names) :]
    if len(table) < 2:
        raise FormatError(f"{sheet.path} has {len(table)} sample(s): two at least are needed")
    readings = np.full((len(table), 13), np.nan)
    for part, first in ((mapped.specific_force, 0), (mapped.angular_rate, 3), (mapped.magnetic_field, 6)):
        if part is not None:
            at = [names.index(name) for name in part.columns]
            readings[:, first : first + 3] = values[:, at] * _SCALES.get(getattr(part, "unit", ""), 1.0)
    _leave_out_wild(readings, sheet)
    _doubt_units(readings, mapped, sheet)
    if mapped.orientation is not None:
        readings[:, 9:] = _orientations(values, names, mapped.orientation)
    if columns.time is None:
        return np.arange(len(table)) / (columns.rate_hz or 1.0), readings
    rows = in_order(table[:, 0], sheet, columns.time.column)
    times = table[rows, 0] * _SECONDS[columns.time.unit]
    return spread(index_of_times(times), times, readings[rows], sheet.path)


def _refuse_clock_times(sheet: Sheet, time: TimeColumn) -> None:
    """Raise ``FormatError`` where times are text, such as 10:15:02.5."""
    text = sheet.first_cell(time.column)
    if ":" in text:
        raise FormatError(
            f"{sheet.path}, line {sheet.first_line}, column '{time.column}': times are numbers of "
            f"{time.unit}, not '{text}': convert them, or leave 'time' out of the map and give it 'rate_hz'"
        )


def _leave_out_wild(readings: FloatArray, sheet: Sheet) -> None:
    """Take readings that no sensor gives out of the rows (n, 13); the sheet notes how many."""
    wild = np.zeros(len(readings), dtype=np.bool_)
    for first, most in zip((0, 3), _BEYOND, strict=True):
        part = readings[:, first : first + 3]
        is_wild = (np.abs(part) > most).any(axis=1)
        part[is_wild] = np.nan
        wild |= is_wild
    if wild.any():
        sheet.add_note(
            f"{sheet.path}: {int(wild.sum())} rows beyond {_BEYOND[0]:g} m/s² or {_BEYOND[1]:g} rad/s, which "
            "no sensor reads, count as lost"
        )


def _doubt_units(readings: FloatArray, mapped: MappedModule, sheet: Sheet) -> None:
    """Note readings that another unit than the map's would explain."""
    force, rate = (_usual_length(readings[:, first : first + 3]) for first in (0, 3))
    if mapped.specific_force is not None and (force < _USUAL_FORCE[0] or force > _USUAL_FORCE[1]):
        sheet.add_note(
            f"{sheet.path}: the specific force of '{mapped.name}' is usually {force:.3g} m/s² long, and "
            f"should be 9.8 at rest: is its unit '{mapped.specific_force.unit}'?"
        )
    if mapped.angular_rate is not None and rate > _USUAL_RATE:
        sheet.add_note(
            f"{sheet.path}: the angular rate of '{mapped.name}' is usually {rate:.3g} rad/s: is its unit "
            f"'{mapped.angular_rate.unit}'?"
        )


def _usual_length(vectors: FloatArray) -> float:
    """Return the median length of vectors (n, 3), of those that are known; NaN: of none."""
    lengths = np.linalg.norm(vectors, axis=1)
    known = lengths[np.isfinite(lengths)]
    return float(np.median(known)) if len(known) else float("nan")


def _orientations(values: FloatArray, names: list[str], kind: Orientation) -> FloatArray:
    q = values[:, [names.index(name) for name in kind.columns]]
    if kind.order == "xyzw":
        q = q[:, [3, 0, 1, 2]]
    if kind.inverse:
        q = q * [1, -1, -1, -1]
    return turned(q, _WORLDS[kind.world])
