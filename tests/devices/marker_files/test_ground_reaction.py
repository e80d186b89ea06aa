"""Ground reactions of OpenSim's files: names of columns as they occur, places, what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devices.marker_files.ground_reaction import read_ground_reactions
from devices.vendor_formats.sheets import FormatError

NAMES = {
    "opensim": ("ground_force_v{}", "ground_force_p{}", "ground_torque_{}"),
    "numbered before": ("1_ground_force_v{}", "1_ground_force_p{}", "1_ground_torque_{}"),
    "numbered within": ("ground_force1_v{}", "ground_force1_p{}", "ground_moment1_m{}"),
    "by side": ("ground_force_r_v{}", "ground_force_r_p{}", "ground_torque_r_{}"),
    "by body": ("calcn_r_ground_force_v{}", "calcn_r_ground_force_p{}", "calcn_r_ground_torque_{}"),
}


def _file(path: Path, labels: list[str], rows: list[list[float]], begins_s: float = 0.4) -> Path:
    lines = ["grf", "version=1", f"nRows={len(rows)}", "inDegrees=yes", "endheader", "\t".join(labels)]
    lines += ["\t".join(f"{x:g}" for x in [begins_s + 0.01 * i, *row]) for i, row in enumerate(rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
def test_a_force_is_found_by_the_names_of_its_columns(tmp_path: Path, names: tuple[str, ...]) -> None:
    labels = ["time", *(name.format(axis) for name in names for axis in "xyz")]
    row = [10.0, 700.0, -20.0, 0.3, 0.0, 0.1, 0.0, 4.0, 0.0]
    found = read_ground_reactions(_file(tmp_path / "a.mot", labels, [row] * 5))
    assert (found.rate_hz, found.begins_s, len(found.plates)) == (pytest.approx(100.0), 0.4, 1)
    plate = found.plates[0]
    np.testing.assert_allclose(plate.force[0], row[:3])
    np.testing.assert_allclose(plate.centre_of_pressure()[0], [0.3, 0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(plate.moment[0], [0.0, 4.0, 0.0], atol=1e-12)


def test_each_foot_is_a_plate_and_other_columns_are_passed_over(tmp_path: Path) -> None:
    names = [f"{k}ground_force_{kind}{axis}" for k in ("", "1_") for kind in "vp" for axis in "xyz"]
    labels = ["time", "hip_flexion_r", *names]
    rows = [[5.0, *[0.0] * 6, 0.0, 500.0, 0.0, 1.0 + 0.1 * i, 0.2, -0.5] for i in range(3)]
    found = read_ground_reactions(_file(tmp_path / "a.sto", labels, rows))
    assert len(found.plates) == 2
    loaded = found.plates[1]
    np.testing.assert_allclose(loaded.centre_of_pressure()[:, 0], [1.0, 1.1, 1.2])
    np.testing.assert_allclose(loaded.centre[1], 0.2)
    assert not found.plates[0].force.any()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nothing", "no 'endheader'"),
        ("endheader\ntime\thip_flexion_r\n0\t1\n1\t1\n", "no force and its place"),
        ("endheader\nframe\ta\n0\t1\n1\t1\n", "the first column is 'frame'"),
        ("endheader\ntime\ta\n0\t1\n1\n", "line 4: 1 numbers under 2 names"),
        ("endheader\ntime\ta\n0\tx\n1\t2\n", "could not convert"),
    ],
)
def test_what_is_no_such_file_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "bad.mot"
    path.write_text(text)
    with pytest.raises(FormatError, match=said):
        read_ground_reactions(path)


def test_uneven_times_are_refused(tmp_path: Path) -> None:
    labels = [f"ground_force_{kind}{axis}" for kind in "vp" for axis in "xyz"]
    lines = ["endheader", "\t".join(["time", *labels])]
    lines += ["\t".join([str(t), *["1"] * 6]) for t in (0.0, 0.1, 0.5)]
    path = tmp_path / "a.mot"
    path.write_text("\n".join(lines))
    with pytest.raises(FormatError, match="equal steps"):
        read_ground_reactions(path)
