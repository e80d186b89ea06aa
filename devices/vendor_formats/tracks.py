"""Rows of one or several files to tracks of modules: what all readers share once a table is read.

A module's rows are (n, 13): specific force, m/s², angular rate, rad/s, field in arbitrary units, orientation
w x y z to east-north-up; NaN: not there.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from devices.deferred import Rotation
from devices.recorded_tracks import FusedTrack, ModuleTrack, track_of
from devices.vendor_formats.sheets import FloatArray, FormatError

NORTH_WEST_UP_DEG = 90.0
"""Turn about z that takes north-west-up, the world of Xsens and x-io, to east-north-up."""

MOST_MODULES = 60
"""Ids from 60 on are left to local measuring devices."""


_SIDES = frozenset(("left", "right", "l", "r"))


def labels_of(paths: Sequence[Path]) -> list[str]:
    """Return a name for each file: its stem without what all have in common, cut between words."""
    stems = [path.stem for path in paths]
    words = [re.split(r"(?<=[_\- ])", stem) for stem in stems]
    shared = 0
    while len(stems) > 1 and all(len(each) > shared + 1 for each in words):
        # Of 'left thigh' and 'left shank' the side belongs to both names.
        if len({each[shared] for each in words}) > 1 or words[0][shared].strip("_- ").lower() in _SIDES:
            break
        shared += 1
    return ["".join(each[shared:]) for each in words]


def refuse_repeats(labels: Sequence[str]) -> None:
    """Raise ``FormatError`` for two modules of one name, or for more than there can be."""
    for label in labels:
        if labels.count(label) > 1:
            raise FormatError(f"two modules are called '{label}': name each once")
    if len(labels) > MOST_MODULES:
        raise FormatError(f"{len(labels)} modules: {MOST_MODULES} at most can be in one recording")


def add_tracks(
    module: int,
    label: str,
    times: FloatArray,
    rows: FloatArray,
    modules: list[ModuleTrack],
    fused: list[FusedTrack],
) -> None:
    """Add the tracks of rows (n, 13), as above: raw readings, orientations, or both.

    Raises ``FormatError`` when there is neither.
    """
    acc, gyr, mag, q = rows[:, :3], rows[:, 3:6], rows[:, 6:9], rows[:, 9:]
    if not (np.isfinite(acc).any() or np.isfinite(q).any()):
        raise FormatError(f"module '{label}' has neither an acceleration nor an orientation in any row")
    if np.isfinite(acc).any():
        modules.append(track_of(module, label, times, acc, gyr, mag))
    if np.isfinite(q).any():
        fused.append(FusedTrack(module, label, times, q))


def stamped_tracks(
    labels: Sequence[str], tables: Sequence[tuple[FloatArray, FloatArray]], align: str
) -> tuple[list[ModuleTrack], list[FusedTrack]]:
    """Return the modules' tracks by number: raw readings, and orientations.

    tables: of each its stamps (n,), s, and rows (m, 13); align: ``stamps`` or ``start``.
    Raises ``FormatError``, also when stamps that are to agree do not overlap.
    """
    zero = min(times[0] for times, _ in tables)
    end = min(times[-1] for times, _ in tables)
    if align == "stamps" and any(times[0] >= end for times, _ in tables):
        raise FormatError(
            "the modules' time stamps do not overlap: they were not synchronised; --align start lets "
            "all begin together"
        )
    modules: list[ModuleTrack] = []
    fused: list[FusedTrack] = []
    for module, (label, (times, rows)) in enumerate(zip(labels, tables, strict=True)):
        # Without synchronisation the stamps of different modules have nothing in common.
        begin = times[0] if align == "start" else zero
        add_tracks(module, label, times - begin, rows, modules, fused)
    return modules, fused


def turned(values: FloatArray, world_deg: float = NORTH_WEST_UP_DEG) -> FloatArray:
    """Return orientations (n, 4) to east-north-up, of quaternions (n, 4) or matrices (n, 9); else NaN.

    world_deg: turn about z that takes the file's world to east-north-up.
    """
    world = Rotation.from_euler("z", world_deg, degrees=True)
    q = np.full((len(values), 4), np.nan)
    if values.shape[1] == 9:
        # Rows of zeros stand for what the device did not know: they are no rotations.
        known = np.isfinite(values).all(axis=1) & (np.abs(np.linalg.det(values.reshape(-1, 3, 3)) - 1) < 0.1)
        rotation = Rotation.from_matrix(values[known].reshape(-1, 3, 3))
    else:
        known = np.abs(np.linalg.norm(values, axis=1) - 1) < 0.1
        rotation = Rotation.from_quat(values[known], scalar_first=True)
    if known.any():
        q[known] = (world * rotation).as_quat(canonical=True, scalar_first=True)
    return q
