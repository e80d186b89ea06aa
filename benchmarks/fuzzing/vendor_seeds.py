"""Small good files of other makers' formats."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence

import c3d
import numpy as np

from benchmarks.fuzzing.vendors import PARTS

_ROWS = 5
_QUATERNION = ("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3")
_MATRIX = tuple(f"Mat[{row}][{column}]" for column in (1, 2, 3) for row in (1, 2, 3))
_SENSORS = tuple(f"{sensor}_{axis}" for sensor in ("Acc", "Gyr", "Mag") for axis in "XYZ")
_READINGS = (0.1, -0.2, 9.8, 0.01, 0.0, -0.3, 0.5, -0.7, 0.4)


def of_vendors() -> dict[str, list[bytes]]:
    """Return a few rows of every format, by target."""
    mvnx = (
        b'<mvnx version="4"><subject label="a" frameRate="60" segmentCount="1"><segments>'
        b'<segment label="Pelvis" id="1"/></segments><frames>'
        + b"".join(
            b'<frame time="%d" index="%d" type="normal"><orientation>1 0 0 0</orientation>'
            b"<position>0 0 1</position></frame>" % (n, n)
            for n in range(3)
        )
        + b"</frames></subject></mvnx>"
    )
    columns = (
        b"rate_hz: 100\nmodules:\n- name: pelvis\n  specific_force: {columns: [x, y, z], unit: g}\n"
        b"  orientation: {columns: [a, b, c, d], order: xyzw, world: nwu, inverse: true}\n"
    )
    table = b"x,y,z,a,b,c,d\n" + b"0,0,1,0,0,0,1\n" * 4
    timed = columns.replace(b"rate_hz: 100", b"time: {column: t, unit: ms}")
    rows = b"".join(b"%d,0,0,1,0,0,0,1\n" % (10 * n) for n in range(4))
    return {
        "import_mvnx": [mvnx],
        "import_csv": [columns + PARTS + table, timed + PARTS + b"t,x,y,z,a,b,c,d\n" + rows],
        "import_xsens": [
            _xsens(";", _QUATERNION, (1.0, 0.0, 0.0, 0.0)),
            _xsens("\t", _MATRIX, (1, 0, 0, 0, 1, 0, 0, 0, 1)),
        ],
        "import_movella_dot": [_movella_dot(0), PARTS.join([_movella_dot(0), _movella_dot(2)])],
        "import_c3d": [_c3d()],
        "import_trc": [_trc()],
        "import_ximu3": [_ximu3()],
    }


def _c3d() -> bytes:
    """Three frames of two markers."""
    writer = c3d.Writer(point_rate=100)
    writer.set_point_labels(["A", "B"])
    frame = np.tile([100.0, 200.0, 300.0, 0.0, 1.0], (2, 1)).astype(np.float32)
    writer.add_frames([(frame, np.empty((0, 0), np.float32))] * 3)
    file = io.BytesIO()
    writer.write(file)
    return file.getvalue()


def _lines(rows: Iterable[Sequence[object]], delimiter: str) -> str:
    return "".join(delimiter.join(map(str, row)) + "\n" for row in rows)


def _xsens(delimiter: str, names: Sequence[str], orientation: Iterable[float]) -> bytes:
    """Xsens text of one module, with its orientations."""
    head = "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Firmware Version: 4.4.0\n"
    rows = [(28597 + n, *_READINGS, *orientation) for n in range(_ROWS)]
    return (head + _lines([("PacketCounter", *_SENSORS, *names), *rows], delimiter)).encode()


def _movella_dot(late: int) -> bytes:
    """One module's file; late: samples by which it began later."""
    head = (
        f"sep=,\nDeviceTag:,Module {late}\nSyncStatus:,Synced\nOutputRate:,60Hz\n"
        "StartTime: ,2024-12-09_17:31:07_886 CET\n\n"
    )
    rows = [(n + 1, 1020235923 + 16667 * (n + late), *_READINGS) for n in range(_ROWS)]
    return (head + _lines([("PacketCounter", "SampleTimeFine", *_SENSORS), *rows], ",")).encode()


def _ximu3() -> bytes:
    """Inertial, Magnetometer, Quaternion and Command of one module."""
    times = [917419171 + 20035 * n for n in range(_ROWS)]
    inertial = ["Timestamp (us)", *(f"Gyroscope {axis} (deg/s)" for axis in "XYZ")]
    inertial += [f"Accelerometer {axis} (g)" for axis in "XYZ"]
    field = ["Timestamp (us)", *(f"Magnetometer {axis} (uT)" for axis in "XYZ")]
    tables = (
        [inertial, *((time, 90, 0, 0, 0, 0, 1) for time in times)],
        [field, *((time, 20, 0, -40) for time in times)],
        [("Timestamp (us)", "W", "X", "Y", "Z"), *((time, 1, 0, 0, 0) for time in times)],
    )
    return PARTS.join([*(_lines(table, ",").encode() for table in tables), b'[{"device_name": "x-IMU3"}]'])


def _trc() -> bytes:
    """Frames of two markers, of which one was not seen in the second."""
    names = (
        "DataRate",
        "CameraRate",
        "NumFrames",
        "NumMarkers",
        "Units",
        "OrigDataRate",
        "OrigDataStartFrame",
    )
    head = [
        ("PathFileType", "4", "(X/Y/Z)", "walk.trc"),
        (*names, "OrigNumFrames"),
        ("60.00", "60.00", _ROWS, 2, "mm", "60.00", 1, _ROWS),
        ("Frame#", "Time", "R.ASIS", "", "", "L.ASIS", "", ""),
        ("", "", "X1", "Y1", "Z1", "X2", "Y2", "Z2"),
        ("",),
    ]
    seen = [(n + 1, f"{n / 60:.3f}", 100.0, 900.5, -20.0 + n, 100.0, 901.5, 220.0) for n in range(_ROWS)]
    seen[1] = (*seen[1][:5], "", "", "")
    return _lines([*head, *seen], "\t").encode()
