"""Bias and weight of muscles, and measurements that guide them, as a YAML file."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from gateway.analysis.muscle_curves import Curves
from gateway.errors import GatewayError, SettingsError, nearest
from gateway.frames import FloatArray
from gateway.support.settings_files import Strict, load_settings


class MuscleEntry(Strict):
    """Muscles of a name, which may hold * (``vas*_l``); later entries win."""

    name: str = Field(min_length=1)
    bias: Annotated[float, Field(ge=0, le=1)] = Field(default=0.0, description="activity that costs nothing")
    weight: Annotated[float, Field(gt=0, le=1e6)] = Field(
        default=1.0, description="of the squared distance from the bias"
    )
    strength: Annotated[float, Field(gt=0, le=10)] = Field(
        default=1.0, description="largest force, of the model's"
    )


class GuideSettings(Strict):
    """Activities or forces that were measured."""

    file: Path = Field(
        description="CSV: time_s, and a column a muscle: its activity from 0 to 1, or MUSCLE_n: its force, N"
    )
    weight: Annotated[float, Field(gt=0, le=1e6)] = Field(
        default=20.0, description="of muscles that are measured, while they are"
    )


class MuscleFile(Strict):
    """What `analyse --muscles FILE` reads."""

    strength: Annotated[float, Field(gt=0, le=10)] = Field(
        default=1.0, description="largest force of all muscles, of the model's"
    )
    curves: Curves = Field(
        default=Curves.NONE,
        description="what the largest force follows: none, length, or length_velocity of the muscle",
    )
    muscles: list[MuscleEntry] = Field(default=[])
    guide: GuideSettings | None = None


@dataclass(frozen=True)
class MuscleCosts:
    """W muscles over F instants."""

    strength: FloatArray  # (W,)
    bias: FloatArray  # (F, W)
    weight: FloatArray  # (F, W)
    is_force: NDArray[np.bool_]  # (W,) whose bias was measured as a force, at the largest force
    curves: Curves = Curves.NONE


def plain_costs(names: tuple[str, ...], frames: int) -> MuscleCosts:
    """Return costs that are alike for all muscles."""
    zero = np.zeros((frames, len(names)))
    return MuscleCosts(np.ones(len(names)), zero, np.ones_like(zero), np.zeros(len(names), dtype=bool))


def load_costs(path: Path, names: tuple[str, ...], peak_n: FloatArray, time_s: FloatArray) -> MuscleCosts:
    """Return a file's costs for these muscles, peak forces (W,), N, and instants (F,), s.

    Raises ``SettingsError`` naming file, entry and remedy."""
    file = load_settings(path, MuscleFile)
    found = replace(plain_costs(names, len(time_s)), curves=file.curves)
    found.strength[:] = file.strength
    for number, entry in enumerate(file.muscles):
        meant = [i for i, name in enumerate(names) if fnmatchcase(name, entry.name)]
        if not meant:
            raise SettingsError(
                f"{path}: muscles.{number}.name: no muscle is called '{entry.name}'"
                + nearest(entry.name, names)
            )
        found.strength[meant] = file.strength * entry.strength
        found.bias[:, meant], found.weight[:, meant] = entry.bias, entry.weight
    if file.guide is not None:
        source = path.parent / file.guide.file
        _guide(source, file.guide.weight, names, peak_n * found.strength, time_s, found)
    return found


def _guide(
    path: Path, weight: float, names: tuple[str, ...], peak_n: FloatArray, time_s: FloatArray,
    into: MuscleCosts,
) -> None:  # fmt: skip
    """Enter measured activities as biases of ``into``, where and while there are any, in place."""
    columns = _read_table(path)
    if "time_s" not in columns:
        raise SettingsError(f"{path}: no column 'time_s'; it has {', '.join(columns)}")
    measured_at = columns.pop("time_s")
    for column, values in columns.items():
        is_force = column not in names and column.removesuffix("_n") in names
        name = column.removesuffix("_n") if is_force else column
        if name not in names:
            raise SettingsError(f"{path}: column '{column}' is no muscle" + nearest(column, names))
        w = names.index(name)
        known = np.isfinite(values)
        if not known.any():
            continue
        share = values[known] / (peak_n[w] if is_force else 1.0)
        within = (time_s >= measured_at[known][0]) & (time_s <= measured_at[known][-1])
        into.bias[within, w] = np.clip(np.interp(time_s[within], measured_at[known], share), 0.0, 1.0)
        into.weight[within, w] = weight
        into.is_force[w] |= is_force


def _read_table(path: Path) -> dict[str, FloatArray]:
    """Return columns of numbers by name; an empty field is NaN. Raises ``GatewayError``."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            heads, *rows = csv.reader(file)
    except OSError as error:
        raise GatewayError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise SettingsError(f"{path}: no table with a row of names") from error
    try:
        values = np.array([[float(cell) if cell.strip() else np.nan for cell in row] for row in rows])
    except ValueError as error:
        raise SettingsError(f"{path}: {error}; numbers are wanted under the row of names") from error
    if values.ndim != 2 or values.shape[1] != len(heads):
        raise SettingsError(f"{path}: its rows do not all have the {len(heads)} fields of the row of names")
    return {head.strip(): values[:, i] for i, head in enumerate(heads)}
