"""OpenSim: ``.sto`` with orientations for OpenSense, ``.mot`` with joint angles. Text.

Orientations are segment to world in columns ``<segment>_imu``; segments have axes x anterior, y superior,
z to the right, as OpenSim's bodies have, so with world axes y-up OpenSense needs no further rotation.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gateway.frames import FloatArray
from gateway.recording.exporters.opensim_names import COORDINATES
from gateway.recording.exporters.take import Take, rotation

_VERSION = "4.5"


def write_sto(take: Take, path: Path, _units_per_m: float) -> None:
    """Raises ``OSError``."""
    head = [
        f"DataRate={take.rate_hz:.9f}".rstrip("0").rstrip("."),
        "DataType=Quaternion",
        "version=3",
        f"OpenSimVersion={_VERSION}",
        "endheader",
        "\t".join(["time", *(f"{name}_imu" for name in take.skeleton.segment_names)]),
    ]
    with path.open("w", encoding="ascii") as file:
        file.write("\n".join(head) + "\n")
        for time_s, pose in zip(take.time_s, take.q_wb, strict=True):
            cells = (",".join(f"{component:.9f}" for component in q) for q in pose)
            file.write("\t".join([f"{time_s:.6f}", *cells]) + "\n")


def write_mot(take: Take, path: Path, units_per_m: float) -> None:
    """Angles in degrees: those that the model knows under its names, the others under ours.

    Raises ``OSError``.
    """
    columns, values = ["time"], [take.time_s]
    for name, series in (*_root_columns(take, units_per_m), *_angle_columns(take)):
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
    with path.open("w", encoding="ascii") as file:
        file.write("\n".join(head) + "\n")
        np.savetxt(file, table, fmt="%.8f", delimiter="\t")


def _root_columns(take: Take, units_per_m: float) -> list[tuple[str, FloatArray]]:
    """The root against the ground, by the order of rotations of OpenSim's pelvis: z, x, y."""
    root = int(np.flatnonzero(take.skeleton.parents < 0)[0])
    angles = np.degrees(np.unwrap(rotation(take.q_wb[:, root]).as_euler("ZXY"), axis=0))
    name = take.skeleton.segment_names[root]
    turns = zip(("tilt", "list", "rotation"), angles.T, strict=True)
    places = zip("xyz", take.p_w[:, root].T * units_per_m, strict=True)
    return [(f"{name}_{turn}", series) for turn, series in turns] + [
        (f"{name}_t{axis}", series) for axis, series in places
    ]


def _angle_columns(take: Take) -> list[tuple[str, FloatArray]]:
    columns = []
    for joint, angle, name in take.angle_names:
        coordinate, sign = COORDINATES.get(name, (name, 1.0))
        series = take.joint_angles[:, joint, angle]
        if not np.isnan(series).any():
            columns.append((coordinate, sign * np.degrees(series)))
    return columns
