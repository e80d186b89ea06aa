"""Force plates of all four types: one known load, told in each type's way, comes back the same."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from devices.marker_files.force_plates import read_force_plates
from devices.vendor_formats.sheets import FormatError

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[4] / "shared" / "data"))
CORNERS = np.array(
    [[600, 0, 0], [0, 0, 0], [0, 400, 0], [600, 400, 0]], float
)  # mm; plate x is file x, y is -y
FORCE = np.array([30.0, -20.0, 700.0])  # N, on the person, axes of the file
AT = np.array([0.25, 0.12, 0.0])  # m, where it goes through the surface
TORSION = 3.0  # N m about the vertical


def parameter(name, group, kind, dimensions, data):
    body = struct.pack("bB", kind, len(dimensions)) + bytes(dimensions) + data + b"\0"
    return struct.pack("bb", len(name), group) + name.encode() + struct.pack("<H", len(body) + 2) + body


def c3d_of(tmp_path, kind, signals, origin, extra=b"", name="plate.c3d"):
    """A float C3D of one point and one plate, two frames with two samples each, all the same."""
    channels = len(signals)
    floats = lambda values: np.asarray(values, "<f4").tobytes()  # noqa: E731
    words = lambda values: np.asarray(values, "<u2").tobytes()  # noqa: E731
    fill = b"".join(
        [
            struct.pack("bb", 5, -1) + b"POINT" + struct.pack("<H", 3) + b"\0",
            struct.pack("bb", 6, -2) + b"ANALOG" + struct.pack("<H", 3) + b"\0",
            struct.pack("bb", 14, -3) + b"FORCE_PLATFORM" + struct.pack("<H", 3) + b"\0",
            parameter("UNITS", 1, -1, (2, 1), b"mm"),
            parameter("USED", 2, 2, (), words([channels])),
            parameter("USED", 3, 2, (), words([1])),
            parameter("TYPE", 3, 2, (1,), words([kind])),
            parameter("CORNERS", 3, 4, (3, 4, 1), floats(CORNERS)),
            parameter("ORIGIN", 3, 4, (3, 1), floats(origin)),
            parameter("CHANNEL", 3, 2, (channels, 1), words(range(1, channels + 1))),
            extra,
        ]
    )
    section = struct.pack("BBBB", 1, 80, 3, 84) + fill
    section += b"\0" * (3 * 512 - len(section))
    header = bytearray(512)
    header[0:2] = bytes([2, 80])
    struct.pack_into("<HHHHH", header, 2, 1, 2 * channels, 1, 2, 0)
    struct.pack_into("<f", header, 12, -1.0)
    struct.pack_into("<HHf", header, 16, 5, 2, 100.0)
    frame = floats([1, 2, 3, 0]) + floats(np.tile(signals, 2))
    path = tmp_path / name
    path.write_bytes(bytes(header) + section + frame * 2)
    return path


def in_plate_axes():
    """The load as the plate feels it (what the person does); axes x, −y, down; about its middle."""
    turn = np.diag([1.0, -1.0, -1.0])
    arm = AT - CORNERS.mean(axis=0) / 1000
    moment = np.cross(arm, FORCE) + np.array([0, 0, TORSION])
    return -turn @ FORCE, -turn @ moment, turn @ arm


def signals_of(kind):
    force, moment, arm = in_plate_axes()
    if kind == 1:
        return [*force, *(1e3 * arm[:2]), 1e3 * (moment - np.cross(arm, force))[2]], [0, 0, 0], b""
    if kind == 3:
        a, b, depth = 0.12, 0.2, -0.04
        below = moment + np.cross([0, 0, depth], force)  # about the sensors
        x12 = 0.5 * (force[0] - below[2] / b)
        x34 = force[0] - x12
        z = np.linalg.lstsq(
            np.array([[1, 1, 1, 1], [b, b, -b, -b], [-a, a, a, -a]]), [force[2], *below[:2]], rcond=None
        )[0]
        return [x12, x34, force[1] / 2, force[1] / 2, *z], [120, 200, -40], b""
    origin = np.array([1.0, -2.0, -40.0])
    below = 1e3 * moment + np.cross(origin, force)
    loads = np.concatenate([force, below])
    if kind == 2:
        return loads, origin, b""
    matrix = np.diag([2.0, 2.0, 4.0, 300.0, 300.0, 200.0])
    matrix[0, 2] = 0.05
    stored = np.asarray(matrix.T.ravel(), "<f4").tobytes()  # first index runs fastest
    return np.linalg.solve(matrix, loads), origin, parameter("CAL_MATRIX", 3, 4, (6, 6, 1), stored)


@pytest.mark.parametrize("kind", [1, 2, 3, 4])
def test_a_known_load_comes_back(tmp_path, kind):
    signals, origin, extra = signals_of(kind)
    plates = read_force_plates(c3d_of(tmp_path, kind, signals, origin, extra))
    assert plates.rate_hz == 200.0
    (plate,) = plates.plates
    assert plate.force.shape == (4, 3)
    assert plate.force[2] == pytest.approx(FORCE, rel=1e-4)
    assert plate.centre_of_pressure()[2] == pytest.approx(AT, abs=1e-5)
    free = plate.moment[2] - np.cross(plate.centre_of_pressure()[2] - plate.centre, plate.force[2])
    assert free == pytest.approx([0, 0, TORSION], abs=1e-3)


def test_an_origin_told_upside_down_is_taken_as_below(tmp_path):
    signals, origin, _ = signals_of(2)
    right, wrong = (
        read_force_plates(c3d_of(tmp_path, 2, signals, sign * origin, name=f"{sign}.c3d")).plates[0]
        for sign in (1, -1)
    )
    assert np.array_equal(right.moment, wrong.moment)


@pytest.mark.parametrize("sign", [1, -1])
def test_corners_listed_the_other_way_round_mean_a_plate_whose_z_points_up(tmp_path, sign):
    """Of either sign: what the person does, or what the floor answers."""
    corners = np.array([[600, 400, 0], [0, 400, 0], [0, 0, 0], [600, 0, 0]])
    origin = np.array([1.0, -2.0, 40.0])
    moment = np.cross(AT - CORNERS.mean(axis=0) / 1000, FORCE) + np.array([0, 0, TORSION])
    loads = sign * np.concatenate([FORCE, 1e3 * moment + np.cross(origin, FORCE)])
    told = parameter("CORNERS", 3, 4, (3, 4, 1), np.asarray(corners, "<f4").tobytes())
    (plate,) = read_force_plates(c3d_of(tmp_path, 2, loads, origin, told)).plates
    assert plate.force[2] == pytest.approx(FORCE, rel=1e-4)
    assert plate.centre_of_pressure()[2] == pytest.approx(AT, abs=1e-5)


def test_corners_that_make_no_surface_are_told(tmp_path):
    signals, origin, _ = signals_of(2)
    told = parameter("CORNERS", 3, 4, (3, 4, 1), np.zeros(12, "<f4").tobytes())
    with pytest.raises(FormatError, match=r"plate 1: FORCE_PLATFORM:CORNERS make no rectangle \(0 0 0; "):
        read_force_plates(c3d_of(tmp_path, 2, signals, origin, told))


def test_an_unknown_type_is_named(tmp_path):
    signals, origin, _ = signals_of(2)
    with pytest.raises(FormatError, match=r"plate 1 is of type 7: types 1, 2, 3, 4 are read .*--forces none"):
        read_force_plates(c3d_of(tmp_path, 7, signals, origin))


def test_channels_that_are_not_there_are_told(tmp_path):
    signals, origin, _ = signals_of(2)
    with pytest.raises(FormatError, match="6 of the 5 analog channels"):
        read_force_plates(c3d_of(tmp_path, 2, signals[:5], origin))


@pytest.mark.parametrize(
    "name", ["c3d_btk_pig/PiG_Motion-FlatFoot-Full.c3d", "c3d_btk_pig/PiG_Calibration-FlatFoot-Full.c3d"]
)
def test_plates_read_as_another_library_reads_them(name):
    ezc3d = pytest.importorskip("ezc3d")
    if not (DATA / name).is_file():
        pytest.skip(f"{DATA / name} is not there")
    theirs = ezc3d.c3d(str(DATA / name), extract_forceplat_data=True)["data"]["platform"]
    for ours, other in zip(read_force_plates(DATA / name).plates, theirs, strict=True):
        assert np.abs(ours.force - other["force"].T).max() < 1e-3
        assert np.abs(ours.moment - other["moment"].T / 1e3).max() < 1e-4
        pressed = np.abs(ours.force[:, 2]) > 50
        difference = ours.centre_of_pressure()[pressed] - other["center_of_pressure"].T[pressed] / 1e3
        assert np.abs(difference).max(initial=0.0) < 1e-5


def test_all_byte_orders_tell_the_same():
    files = sorted((DATA / "c3d_formats").glob("Eb015*.c3d"))
    if not files:
        pytest.skip("c3d_formats is not there")
    read = [read_force_plates(path).plates for path in files]
    for plates in read[1:]:
        for first, other in zip(read[0], plates, strict=True):
            assert np.abs(first.force - other.force).max() < 0.05
