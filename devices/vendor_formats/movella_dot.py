"""Movella DOT: CSV exports of its app and of its memory, one file a module.

Some lines ``Name:,value``, then the names of the columns. Acceleration m/s², angular rate °/s, field in
arbitrary units, time stamps in µs; orientations, where exported, from sensor axes to east-north-up.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from devices.recorded_tracks import RecordedTracks
from devices.vendor_formats.gaps import in_order, rate_of, spread, unwrapped
from devices.vendor_formats.sheets import FloatArray, FormatError, Sheet, open_sheet
from devices.vendor_formats.tracks import labels_of, refuse_repeats, stamped_tracks, turned
from devices.vendor_formats.xsens_text import orientation_columns

_STAMP = "SampleTimeFine"
_STAMP_BITS = 32
_COUNTER_BITS = 32
_SENSORS = [f"{sensor}_{axis}" for sensor in ("Acc", "Gyr", "Mag") for axis in "XYZ"]


def read_movella_dot(
    paths: Sequence[Path], *, align: str = "stamps", partial: bool = False
) -> RecordedTracks:
    """Read modules, numbered from 0 in the order of the files.

    align: ``stamps`` for modules that were synchronised, ``start`` lets all begin together. Raises
    ``FormatError``, also when stamps of several modules do not overlap.
    """
    sheets = [
        open_sheet(path, lambda names: _STAMP in names, f"a line with '{_STAMP}'", is_partial=partial)
        for path in paths
    ]
    tags = [_tag(sheet) for sheet in sheets]
    # Those that nobody has named all have the same tag: then the files' names tell them apart.
    labels = [
        tag if tag and tags.count(tag) == 1 else label
        for tag, label in zip(tags, labels_of(paths), strict=True)
    ]
    refuse_repeats(labels)
    tables = [_module(sheet) for sheet in sheets]
    modules, fused = stamped_tracks(labels, tables, align)
    rate_hz = rate_of(np.diff(tables[0][0]), paths[0])
    notes = tuple(sheet.note for sheet in sheets if sheet.note)
    return RecordedTracks("movella_dot", rate_hz, tuple(modules), fused=tuple(fused), notes=notes)


def _module(sheet: Sheet) -> tuple[FloatArray, FloatArray]:
    """Return times (n,), s, by the module's clock, and readings (n, 13) as in ``MtFile``."""
    sensors = [name for name in _SENSORS if name in sheet.names]
    turn_names = orientation_columns(sheet)
    if not turn_names and not sheet.has(*_SENSORS[:3]):
        raise FormatError(
            f"{sheet.path}: has neither Acc_X, Acc_Y, Acc_Z nor Quat_W …; choose a measurement mode with "
            f"either; its columns are {', '.join(sheet.names)}"
        )
    table = sheet.columns(["PacketCounter", _STAMP, *sensors, *turn_names])
    if len(table) < 2:
        raise FormatError(f"{sheet.path} has {len(table)} sample(s): two at least are needed")
    counter = unwrapped(table[:, 0], _COUNTER_BITS, sheet.path, "PacketCounter")
    rows = in_order(counter, sheet, "PacketCounter")
    counter, table = counter[rows], table[rows]
    stamps = unwrapped(table[:, 1], _STAMP_BITS, sheet.path, _STAMP).astype(np.float64) * np.float64(1e-6)
    if (np.diff(stamps) <= 0).any():
        raise FormatError(f"{sheet.path}: '{_STAMP}' stands still or goes back while PacketCounter grows")
    readings = np.full((len(table), 13), np.nan)
    # The app writes rates in degrees.
    for column, name in enumerate(sensors, start=2):
        scale = np.pi / 180 if name.startswith("Gyr") else 1.0
        readings[:, _SENSORS.index(name)] = table[:, column] * scale
    if turn_names:
        readings[:, 9:] = turned(table[:, -len(turn_names) :], 0.0)
    return spread(counter, stamps, readings, sheet.path)


def _tag(sheet: Sheet) -> str:
    """Return the name that the user gave the module in the app, or an empty text."""
    found = (re.match(r"DeviceTag:\s*,\s*(.+)", line) for line in sheet.preamble)
    return next((match.group(1).strip() for match in found if match), "")
