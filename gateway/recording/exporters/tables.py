"""Everything as one table, a row a frame, units in the names of the columns: CSV and Parquet."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.frames import Status
from gateway.recording.exporters.take import Take, markers_of
from gateway.support.extras import require_package

_LENGTHS = {1.0: "m", 100.0: "cm", 1000.0: "mm"}
_STATUS = np.array([status.name.lower() for status in Status])


def columns(take: Take, units_per_m: float) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the name and values (F,) of every column. What was recorded is NaN in frames that were not."""
    unit = _LENGTHS.get(units_per_m, f"per_m_{units_per_m:g}")
    recorded = take.recorded
    # Row of the recorded frame by grid frame; -1 where nothing was recorded.
    row = np.full(len(take.q_wb), -1)
    row[np.round((recorded.time_ns - take.begun_ns) * 1e-9 * take.rate_hz).astype(np.int64)] = np.arange(
        len(recorded.time_ns)
    )

    yield "time_s", take.time_s
    elapsed_s = take.time_s - take.begins_s
    yield "gateway_time_ns", take.begun_ns + np.round(elapsed_s * 1e9).astype(np.int64)
    for s, name in enumerate(take.skeleton.segment_names):
        for i, axis in enumerate("wxyz"):
            yield f"{name}_orientation_{axis}", take.q_wb[:, s, i]
        for i, axis in enumerate("xyz"):
            yield f"{name}_position_{axis}_{unit}", take.p_w[:, s, i] * units_per_m
        for i, axis in enumerate("xyz"):
            yield f"{name}_angular_rate_{axis}_rad_per_s", _at(recorded.angular_rate[:, s, i], row)
        for i, axis in enumerate("xyz"):
            series = _at(recorded.joint_acceleration[:, s, i], row)
            yield f"{name}_joint_acceleration_enu_{axis}_m_per_s2", series
        yield f"{name}_sigma_rad", _at(recorded.sigma[:, s], row)
        status = _STATUS[recorded.status[:, s]]
        yield f"{name}_status", np.where(row >= 0, status[np.maximum(row, 0)], "not_recorded")
    for joint, angle, name in take.angle_names:
        yield f"{name}_deg", np.degrees(take.joint_angles[:, joint, angle])
    yield from _marker_columns(take, units_per_m, unit)


def _marker_columns(take: Take, units_per_m: float, unit: str) -> Iterator[tuple[str, NDArray[Any]]]:
    markers = markers_of(take)
    if markers is None:
        return
    for m, label in enumerate(markers.labels):
        for i, axis in enumerate("xyz"):
            yield f"marker_{label}_{axis}_{unit}", markers.positions[:, m, i] * units_per_m
        yield f"marker_{label}_residual_{unit}", markers.residuals[:, m] * units_per_m
        yield f"marker_{label}_used", markers.used[:, m]


def write_csv(take: Take, path: Path, units_per_m: float) -> None:
    """Write a take as CSV. Raises ``OSError``."""
    write_csv_columns(dict(columns(take, units_per_m)), path)


def write_parquet(take: Take, path: Path, units_per_m: float) -> None:
    """Write a take as Parquet. Raises ``GatewayError`` without the extra ``export``, ``OSError``."""
    write_parquet_columns(dict(columns(take, units_per_m)), path)


def write_csv_columns(table: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write columns of equal length, by name, as CSV. Raises ``OSError``."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(zip(*(_cells(values) for values in table.values()), strict=True))


def write_parquet_columns(table: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write columns of equal length, by name, as Parquet.

    Raises ``GatewayError`` without the extra ``export``, ``OSError``.
    """
    require_package("pyarrow")
    import pyarrow  # noqa: PLC0415 - an extra
    import pyarrow.parquet  # noqa: PLC0415

    pyarrow.parquet.write_table(pyarrow.table(dict(table)), path)


def _at(values: NDArray[Any], row: NDArray[np.int64]) -> NDArray[Any]:
    """Return recorded values at every frame; NaN where none was recorded."""
    return np.where(row >= 0, values[np.maximum(row, 0)], np.nan)


def _cells(values: NDArray[Any]) -> list[str]:
    """Return values as texts; a float has nine significant digits, NaN becomes an empty cell."""
    if values.dtype.kind != "f":
        return [str(value) for value in values.tolist()]
    return ["" if math.isnan(value) else f"{value:.9g}" for value in values.tolist()]
