"""OpenSim: ``.sto`` with orientations for OpenSense, ``.mot`` with joint angles. Text.

Orientations are segment to world in columns ``<segment>_imu``; segments have axes x anterior, y superior,
z to the right, as OpenSim's bodies have, so with world axes y-up OpenSense needs no further rotation.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gateway.contract.opensim_names import COORDINATES
from gateway.recording.exporters.opensim_angles import Columns, model_columns, rajagopal_columns
from gateway.recording.exporters.take import Take

_VERSION = "4.5"


def write_sto(take: Take, path: Path, _units_per_m: float) -> None:
    """Write orientations of a take for OpenSense. Raises ``OSError``."""
    head = [
        f"DataRate={take.rate_hz:.9f}".rstrip("0").rstrip("."),
        "DataType=Quaternion",
        "version=3",
        f"OpenSimVersion={_VERSION}",
        "endheader",
        "\t".join(["time", *(f"{name}_imu" for name in take.skeleton.segment_names)]),
    ]
    with path.open("w", encoding="utf-8") as file:
        file.write("\n".join(head) + "\n")
        for time_s, pose in zip(take.time_s, take.q_wb, strict=True):
            # OpenSense separates the parts of a quaternion by commas, columns by tabulators.
            cells = (",".join(f"{component:.9f}" for component in q) for q in pose)
            file.write("\t".join([f"{time_s:.6f}", *cells]) + "\n")


def write_mot(take: Take, path: Path, units_per_m: float) -> None:
    """Write joint angles, degrees, and the root's place for OpenSim. Raises ``OSError``.

    Columns are the coordinates of the body's own model, those that only Rajagopal's model has, and angles
    that are in neither. OpenSim ignores columns that a model does not know.
    """
    columns, values = ["time"], [take.time_s]
    known = [*model_columns(take, units_per_m), *rajagopal_columns(take)]
    for name, series in (*known, *_other_angles(take, {name for name, _ in known})):
        columns.append(name)
        values.append(series)
    table = np.column_stack(values)
    head = [
        path.stem,
        "version=1",
        f"nRows={table.shape[0]}",
        f"nColumns={table.shape[1]}",
        "inDegrees=yes",
        "endheader",
        "\t".join(columns),
    ]
    with path.open("w", encoding="utf-8") as file:
        file.write("\n".join(head) + "\n")
        np.savetxt(file, table, fmt="%.8f", delimiter="\t")


def _other_angles(take: Take, known: set[str]) -> Columns:
    """Return the take's own angles, degrees, that have no name in either model."""
    columns: Columns = []
    for joint, angle, name in take.angle_names:
        series = take.joint_angles[:, joint, angle]
        if name not in known and name not in COORDINATES and not np.isnan(series).any():
            columns.append((name, np.degrees(series)))
    return columns
