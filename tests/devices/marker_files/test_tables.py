"""Tables of markers as QTM, Motive and Nexus export them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devices.marker_files import read_markers
from devices.vendor_formats.sheets import FormatError

QTM = """NO_OF_FRAMES\t3
NO_OF_CAMERAS\t8
NO_OF_MARKERS\t2
FREQUENCY\t200
NO_OF_ANALOG\t0
ANALOG_FREQUENCY\t0
DESCRIPTION\t--
TIME_STAMP\t2022-06-03, 10:47:36.627\t94247.45402301
DATA_INCLUDED\t3D
EVENT\tstart\t1\t0.00000
MARKER_NAMES\tLASI\tRASI\t
TRAJECTORY_TYPES\tMeasured\tMixed
{rows}"""
PLAIN = "1.000\t2.000\t3.000\t4.0\t5.0\t6.0\n\t\t\t7.0\t8.0\t9.0\n0.000\t0.000\t0.000\t7.0\t8.0\t9.5\n"
NUMBERED = (
    "Frame\tTime\tLASI X\tLASI Y\tLASI Z\tRASI X\tRASI Y\tRASI Z\n"
    "5\t0.02000\t1.000\t2.000\t3.000\t4.000\t5.000\t6.000\n"
    "6\t0.02500\tNULL\tNULL\tNULL\t7.000\t8.000\t9.000\n"
    "7\t0.03000\t0.000\t0.000\t0.000\t7.000\t8.000\t9.500\n"
)
MOTIVE = """Format Version,1.23,Take Name,Walk,Capture Frame Rate,120.000000,Export Frame Rate,100.000000,\
Total Frames in Take,3,Rotation Type,Quaternion,Length Units,{unit},Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body,Marker,Marker,Marker,Marker,Marker,Marker,Marker,Marker,Marker
,Name,Ball,Ball,Ball,Ana:LASI,Ana:LASI,Ana:LASI,"Ana:RASI","Ana:RASI","Ana:RASI",Unlabeled 12,,
,ID,1,1,1,2,2,2,3,3,3,4,4,4
,,Position,Position,Position,Position,Position,Position,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,X,Y,Z,X,Y,Z,X,Y,Z
0,0.000000,9,9,9,1.0,2.0,3.0,4.0,5.0,6.0,,,
1,0.010000,9,9,9,,,,7.0,8.0,9.0,1.0,1.0,2.0
2,0.020000,9,9,9,,,,7.0,8.0,9.5,1.0,1.0,2.0
"""
NEXUS = """Devices
1000
,,Force - Force,,
Frame,Sub Frame,Fx,Fy,Fz
,,N,N,N
11,0,1,2,3
11,1,1,2,3

Trajectories
100
,,Ana:LASI,,,Ana:RASI,,
Frame,Sub Frame,X,Y,Z,X,Y,Z
,,mm,mm,mm,mm,mm,mm
11,0,1,2,3,4,5,6
12,0,,,,7,8,9
13,0,,,,7,8,9.5

Model Outputs
100
,,Ana:LHipAngles,,
Frame,Sub Frame,X,Y,Z
,,deg,deg,deg
11,0,1,2,3
"""
PLACES = np.array(
    [[[1, 2, 3], [4, 5, 6]], [[np.nan] * 3, [7, 8, 9]], [[np.nan] * 3, [7, 8, 9.5]]], dtype=float
)


def written(folder: Path, text: str, name: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("text", "name", "rate_hz", "begins_s"),
    [
        (QTM.format(rows=PLAIN), "walk.tsv", 200.0, 0.0),
        (QTM.format(rows=NUMBERED), "walk.txt", 200.0, 0.02),
        (MOTIVE.format(unit="Millimeters"), "walk.csv", 100.0, 0.0),
        (NEXUS, "walk.csv", 100.0, 0.1),
        (NEXUS.replace(",", ";").replace("9.5", "9,5"), "walk.csv", 100.0, 0.1),
        (NEXUS[NEXUS.index("Trajectories") :].replace(",", "\t"), "walk.txt", 100.0, 0.1),
    ],
)
def test_every_program_s_table_gives_the_same_markers(
    tmp_path: Path, text: str, name: str, rate_hz: float, begins_s: float
) -> None:
    trial = read_markers(written(tmp_path, text, name))
    np.testing.assert_allclose(trial.columns(("LASI", "RASI")), 1e-3 * PLACES)
    assert (trial.rate_hz, trial.begins_s) == (rate_hz, pytest.approx(begins_s))
    assert trial.notes == ()


def test_motive_tells_its_unit_and_which_points_have_no_name(tmp_path: Path) -> None:
    trial = read_markers(written(tmp_path, MOTIVE.format(unit="Meters"), "walk.csv"))
    assert trial.labels == ("LASI", "RASI", "")
    np.testing.assert_allclose(trial.columns(("LASI", "RASI")), PLACES)
    assert np.isfinite(trial.unlabelled()[1:]).all()


def test_a_table_that_ends_early_is_told(tmp_path: Path) -> None:
    text = QTM.format(rows=PLAIN).replace("NO_OF_FRAMES\t3", "NO_OF_FRAMES\t30")
    (note,) = read_markers(written(tmp_path, text, "walk.tsv")).notes
    assert "3 frames, of which its header tells 30" in note


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time,x,y\n0,1,2\n", "no table of markers as QTM, Motive or Nexus"),
        (QTM.format(rows=""), "no frame below its header"),
        (QTM.format(rows=PLAIN).replace("DATA_INCLUDED\t3D", "DATA_INCLUDED\t6D"), "export 3D data"),
        (QTM.format(rows=PLAIN).replace("FREQUENCY\t200", "FREQUENCY\t0"), "FREQUENCY is '0'"),
        (MOTIVE.format(unit="Furlongs"), "Length Units is 'Furlongs'"),
        (MOTIVE.format(unit="Meters").replace("Marker", "Bone"), "export with Markers"),
        (MOTIVE.format(unit="Meters").split("Frame,Time")[0], "no line that begins with Frame"),
        ("Trajectories\n100\n", "no table of markers"),
        (NEXUS.replace(",,mm", ",,V"), "no X, Y, Z in mm"),
    ],
)
def test_what_is_no_such_table_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(FormatError, match=said) as caught:
        read_markers(written(tmp_path, text, "walk.csv"))
    assert "\n" not in str(caught.value)
    assert "export" in str(caught.value) or "wanted" in str(caught.value)


def test_a_damaged_table_never_raises_anything_else(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    for text in (QTM.format(rows=PLAIN), QTM.format(rows=NUMBERED), MOTIVE.format(unit="Meters"), NEXUS):
        for _ in range(60):
            damaged = bytearray(text.encode())
            for at in generator.integers(0, len(damaged), 6):
                damaged[at] = generator.choice(list(b'0,\t\nX";'))
            path = tmp_path / "damaged.csv"
            path.write_bytes(damaged[: generator.integers(1, len(damaged))])
            try:
                read_markers(path)
            except FormatError as error:
                assert "\n" not in str(error)  # noqa: PT017
