"""Ground reactions as OpenSim keeps them, ``.mot`` or ``.sto``: force, place and torque, y up, in metres.

Columns of one foot or plate share what is left of their names without ``ground``, ``force``, ``torque`` or
``moment`` and the letter at the end: ``ground_force_vx``, ``ground_force_px``, ``ground_torque_x`` have
nothing, ``1_ground_force_vx`` has ``1``, ``ground_force_r_vx`` has ``r``.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from devices.marker_files.force_plates import ForcePlate, ForcePlates
from devices.marker_files.trial import FloatArray
from devices.vendor_formats.sheets import FormatError

SUFFIXES = (".mot", ".sto")
_COLUMN = re.compile(r"(?P<name>.*?)_?(?P<kind>[vpm]?)(?P<axis>[xyz])")
_WORDS = re.compile(r"ground|forces?|torques?|moments?|_")
_HALF_M = 10.0
"""Of a surface that has no edges in the file."""
_LEAST_FORCE_N = 10.0
"""Below it the place of a force is not looked at."""


def read_ground_reactions(path: Path) -> ForcePlates:
    """Read each foot's or plate's columns as one plate, axes of the file.

    Raises ``FormatError``, ``OSError``.
    """
    labels, table = _table(path)
    if labels[0].lower() != "time":
        raise FormatError(f"{path}: the first column is '{labels[0]}', 'time' is wanted")
    found: dict[str, dict[str, list[int]]] = {}
    for column, label in enumerate(labels[1:], 1):
        matched = _COLUMN.fullmatch(label.lower())
        if matched is None:
            continue
        name = matched["name"]
        kind = "m" if "torque" in name or "moment" in name else matched["kind"] or "v"
        own = found.setdefault(_WORDS.sub("", name), {}).setdefault(kind, [0, 0, 0])
        own["xyz".index(matched["axis"])] = column
    plates = tuple(
        _plate(table, columns) for columns in found.values() if {"v", "p"} <= {*columns} and _whole(columns)
    )
    if not plates:
        raise FormatError(
            f"{path}: no force and its place, such as ground_force_vx to ground_force_pz, among "
            f"{', '.join(labels[1:7])}"
        )
    times = table[:, 0]
    steps = np.diff(times)
    # Times are rounded in such files, so steps may differ by a fifth.
    if len(times) < 2 or steps.min() <= 0 or np.ptp(steps) > 0.2 * steps.mean():
        raise FormatError(f"{path}: its times do not rise in equal steps: resample it")
    return ForcePlates(float((len(times) - 1) / (times[-1] - times[0])), plates, float(times[0]))


def _table(path: Path) -> tuple[list[str], FloatArray]:
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    ends = [i for i, line in enumerate(lines) if line.strip().lower() == "endheader"]
    if not ends or len(lines) < ends[0] + 3:
        raise FormatError(f"{path}: no 'endheader' with columns and numbers below: not a file of OpenSim")
    labels = lines[ends[0] + 1].split()
    rows = [line.split() for line in lines[ends[0] + 2 :] if line.strip()]
    for number, row in enumerate(rows, ends[0] + 3):
        if len(row) != len(labels):
            raise FormatError(f"{path}: line {number}: {len(row)} numbers under {len(labels)} names")
    try:
        return labels, np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise FormatError(f"{path}: {error}") from error


def _whole(columns: dict[str, list[int]]) -> bool:
    return all(all(own) for own in columns.values())


def _plate(table: FloatArray, columns: dict[str, list[int]]) -> ForcePlate:
    force, place = (np.nan_to_num(table[:, columns[kind]]) for kind in "vp")
    torque = np.nan_to_num(table[:, columns["m"]]) if "m" in columns else np.zeros_like(force)
    is_loaded = np.linalg.norm(force, axis=1) > _LEAST_FORCE_N
    middle = np.median(place[is_loaded], axis=0) if is_loaded.any() else np.zeros(3)
    edges = _HALF_M * np.array([[1, 0, 1], [1, 0, -1], [-1, 0, -1], [-1, 0, 1]])
    return ForcePlate(middle + edges, force, torque + np.cross(place - middle, force))
