"""Xsens text exports: MT Manager and MTw, one file a module; also what OpenSense reads.

Lines of ``// Name: value``, then the names of the columns, then a row a sample: tabs, ``;`` or commas.
Acceleration m/s², angular rate rad/s, field in arbitrary units, orientation as quaternion or matrix from
sensor axes to north-west-up.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.recorded_tracks import FusedTrack, ModuleTrack, RecordedTracks
from devices.vendor_formats.gaps import IntArray, checked_rate, in_order, spread, unwrapped
from devices.vendor_formats.sheets import FloatArray, FormatError, Sheet, open_sheet
from devices.vendor_formats.tracks import add_tracks, labels_of, refuse_repeats, turned

COUNTERS = ("PacketCounter", "Counter")
_COUNTER_BITS = 16
_RATE = re.compile(r"//\s*(?:Update|Sample) rate:\s*(\d+\.?\d*)", re.IGNORECASE)
_ACC, _GYR, _MAG = ([f"{sensor}_{axis}" for axis in "XYZ"] for sensor in ("Acc", "Gyr", "Mag"))
_MATRIX = [f"Mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3)]
_QUATERNIONS = (
    [f"Quat_q{i}" for i in range(4)],
    [f"Quat_{axis}" for axis in "wxyz"],
    [f"Quat_{axis}" for axis in "WXYZ"],
)


@dataclass(frozen=True)
class MtFile:
    """One module's file."""

    path: Path
    rate_hz: float | None
    counter: IntArray  # (n,)
    readings: FloatArray  # (n, 13) specific force, angular rate, field, orientation w x y z; NaN: not there
    note: str | None


def read_xsens_text(
    paths: Sequence[Path], rate_hz: float | None = None, *, partial: bool = False
) -> RecordedTracks:
    """Read modules, numbered from 0 in the order of the files, on one time by their packet counters.

    rate_hz: for files that do not have theirs. partial: take the rows before a bad one. Raises
    ``FormatError``.
    """
    files = [read_mt_file(path, partial=partial) for path in paths]
    labels = labels_of(paths)
    refuse_repeats(labels)
    rate = rate_hz or next((file.rate_hz for file in files if file.rate_hz), None)
    if rate is None:
        raise FormatError(f"{paths[0]} does not tell its rate ('// Update Rate: …'): give it with --rate")
    # Modules of one measurement have one rate; different ones are files of different measurements.
    odd = next((file for file in files if file.rate_hz and abs(file.rate_hz - rate) > 1e-6), None)
    if odd is not None and rate_hz is None:
        raise FormatError(f"{odd.path} has {odd.rate_hz:g} Hz, {paths[0]} {rate:g} Hz: import them apart")
    starts = _starts([file.counter[0] for file in files])
    modules: list[ModuleTrack] = []
    fused: list[FusedTrack] = []
    for module, (file, label, start) in enumerate(zip(files, labels, starts, strict=True)):
        # Counters show which rows are missing; their differences between modules show when each began.
        index = file.counter - file.counter[0]
        times, rows = spread(index, (start + index) / rate, file.readings, file.path)
        add_tracks(module, label, times, rows, modules, fused)
    notes = tuple(file.note for file in files if file.note)
    return RecordedTracks("xsens", rate, tuple(modules), fused=tuple(fused), notes=notes)


def read_mt_file(path: Path, *, partial: bool = False) -> MtFile:
    """Read one module's file, its orientations turned to east-north-up. Raises ``FormatError``."""
    sheet = open_sheet(
        path,
        lambda names: any(name in names for name in COUNTERS),
        "a line with 'PacketCounter' (MT Manager, MTw, OpenSense)",
        is_partial=partial,
    )
    counter_name = next(name for name in COUNTERS if name in sheet.names)
    present = [names for names in (_ACC, _GYR, _MAG) if sheet.has(*names)]
    turn_names = orientation_columns(sheet)
    if not present and not turn_names:
        raise FormatError(
            f"{path}: has neither Acc_X, Acc_Y, Acc_Z nor an orientation (Quat_… or Mat[1][1] …); "
            f"its columns are {', '.join(sheet.names)}"
        )
    wanted = [counter_name, *(name for names in present for name in names), *turn_names]
    table = sheet.columns(wanted)
    readings = np.full((len(table), 13), np.nan)
    for first, names in zip((0, 3, 6), (_ACC, _GYR, _MAG), strict=True):
        if names in present:
            start = wanted.index(names[0])
            readings[:, first : first + 3] = table[:, start : start + 3]
    if turn_names:
        readings[:, 9:] = turned(table[:, -len(turn_names) :])

    rates = [
        checked_rate(float(found.group(1)), path) for line in sheet.preamble if (found := _RATE.match(line))
    ]
    counter = unwrapped(table[:, 0], _COUNTER_BITS, path, counter_name)
    rows = in_order(counter, sheet, counter_name)
    return MtFile(path, rates[0] if rates else None, counter[rows], readings[rows], sheet.note)


def orientation_columns(sheet: Sheet) -> list[str]:
    """Return the columns of the orientation, quaternion (4) or matrix (9, row by row); empty: none."""
    return next((names for names in (*_QUATERNIONS, _MATRIX) if sheet.has(*names)), [])


def _starts(first: list[np.int64]) -> list[int]:
    """Return when each module began, in samples after the earliest."""
    size = 1 << _COUNTER_BITS
    # Counters wrap: the difference that is nearest to zero is the true one.
    after = [int((count - first[0] + size // 2) % size - size // 2) for count in first]
    return [count - min(after) for count in after]
