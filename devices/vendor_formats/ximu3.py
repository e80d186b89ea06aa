"""x-IMU3: a folder a module with ``Inertial.csv``, and ``Magnetometer.csv``, ``Quaternion.csv`` if sent.

Units stand in the names of the columns; times are µs of a clock that all modules share when synchronised.
Orientations are from sensor axes to north-west-up.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from devices.recorded_tracks import RecordedTracks
from devices.vendor_formats.gaps import in_order, index_of_times, rate_of, spread, usual_interval
from devices.vendor_formats.sheets import FloatArray, FormatError, open_sheet
from devices.vendor_formats.tracks import refuse_repeats, stamped_tracks, turned
from firmware_protocol.samples import STANDARD_GRAVITY

INERTIAL = "Inertial.csv"
_TIMES = ("Timestamp (us)",)
_UNITS = {
    "deg/s": np.pi / 180,
    "g": STANDARD_GRAVITY,
    "a.u.": 1.0,
    "": 1.0,
    "uT": 1.0,
    "rad/s": 1.0,
    "m/s^2": 1.0,
}
_SERIAL = re.compile(r"\s*[0-9A-F]{4}(-?[0-9A-F]{4})+\b.*$")


def folders_of(path: Path) -> list[Path]:
    """Return the modules' folders: the one named, or those in it."""
    return (
        [path] if (path / INERTIAL).is_file() else sorted(each.parent for each in path.glob(f"*/{INERTIAL}"))
    )


def read_ximu3(paths: Sequence[Path], *, align: str = "stamps", partial: bool = False) -> RecordedTracks:
    """Read modules, numbered from 0 in the order of the folders, each with the name it gave itself.

    align: as of ``read_movella_dot``. Raises ``FormatError``.
    """
    folders = [folder for path in paths for folder in folders_of(path)]
    if not folders:
        raise FormatError(
            f"{paths[0]} holds no '{INERTIAL}', and no folder in it does: x-IMU3 data are wanted"
        )
    labels = [_label(folder) for folder in folders]
    refuse_repeats(labels)
    notes: list[str] = []
    tables = [_module(folder, partial, notes) for folder in folders]
    modules, fused = stamped_tracks(labels, tables, align)
    rate_hz = rate_of(np.array([usual_interval(np.diff(times)) for times, _ in tables]), folders[0])
    begun_ns = _begun_ns(folders[0])
    return RecordedTracks(
        "ximu3", rate_hz, tuple(modules), fused=tuple(fused), begun_utc_ns=begun_ns, notes=tuple(notes)
    )


def _module(folder: Path, partial: bool, notes: list[str]) -> tuple[FloatArray, FloatArray]:
    """Return times (n,), s, and readings (n, 13) as in ``MtFile``, at the instants of the inertial samples.

    The magnetometer samples by itself, more slowly: it is interpolated between its own instants.
    """
    times, inertial = _table(folder / INERTIAL, 6, partial, notes)
    readings = np.full((len(times), 13), np.nan)
    # The file has the gyroscope first, our rows the accelerometer.
    readings[:, :3], readings[:, 3:6] = inertial[:, 3:], inertial[:, :3]
    for name, columns in (("Magnetometer.csv", slice(6, 9)), ("Quaternion.csv", slice(9, 13))):
        path = folder / name
        if not path.is_file():
            continue
        at, values = _table(path, columns.stop - columns.start, partial, notes)
        if name == "Quaternion.csv":
            readings[:, columns] = _at_same_instants(times, at, turned(values))
        else:
            readings[:, columns] = np.stack([np.interp(times, at, column) for column in values.T], axis=1)
    return spread(index_of_times(times), times, readings, folder / INERTIAL)


def _at_same_instants(times: FloatArray, at: FloatArray, q: FloatArray) -> FloatArray:
    """Return orientations (n, 4) within half an interval of the samples; NaN where there is none."""
    nearest = np.clip(np.searchsorted(at, times), 1, max(len(at) - 1, 1))
    nearest = np.minimum(nearest, len(at) - 1)
    nearest -= np.abs(at[np.maximum(nearest - 1, 0)] - times) < np.abs(at[nearest] - times)
    is_near = np.abs(at[nearest] - times) < 0.5 * np.median(np.diff(times))
    return np.where(is_near[:, None], q[nearest], np.nan)


def _table(path: Path, width: int, partial: bool, notes: list[str]) -> tuple[FloatArray, FloatArray]:
    """Return times (n,), s, and values (n, width) in SI units, by the units in the names of the columns."""
    sheet = open_sheet(path, lambda names: names[0] in _TIMES, "'Timestamp (us)' first", is_partial=partial)
    names = sheet.names[1 : width + 1]
    if len(names) < width:
        raise FormatError(f"{path}: {width} columns of values are wanted, there are {', '.join(names)}")
    table = sheet.columns([sheet.names[0], *names])
    table = table[in_order(table[:, 0], sheet, sheet.names[0])]
    if sheet.note:
        notes.append(sheet.note)
    if len(table) < 2:
        raise FormatError(f"{path} has {len(table)} sample(s): two at least are needed")
    times = table[:, 0] * 1e-6
    return times, table[:, 1:] * np.array([_scale(path, name) for name in names])


def _scale(path: Path, column: str) -> float:
    found = re.search(r"\(([^)]*)\)", column)
    unit = found.group(1) if found else ""
    if unit not in _UNITS:
        raise FormatError(
            f"{path}: column '{column}' is in '{unit}'; known: {', '.join(filter(None, _UNITS))}"
        )
    return _UNITS[unit]


def _command(folder: Path) -> dict[str, object]:
    """Return what ``Command.json`` holds; empty if it is not there or damaged."""
    try:
        entries = json.loads((folder / "Command.json").read_text(encoding="utf-8"))
        return {key: value for entry in entries for key, value in entry.items()}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}


def _label(folder: Path) -> str:
    """Return the folder's name without serial number and interface, as users set it, or the module's own."""
    named = _SERIAL.sub("", folder.name).strip()
    ping = _command(folder).get("ping")
    own = ping.get("name") or ping.get("deviceName") if isinstance(ping, dict) else None
    return named or str(own or folder.name)


def _begun_ns(folder: Path) -> int:
    """Return when the logger began, ns, its wall clock taken as UTC; 0: unknown."""
    try:
        begun = datetime.strptime(str(_command(folder).get("time")), "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return 0
    return int(begun.timestamp()) * 10**9
