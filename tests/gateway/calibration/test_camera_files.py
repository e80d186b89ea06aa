"""Calibrations of cameras as other programs write them."""

import os
from pathlib import Path

import numpy as np
import pytest

from gateway.body.camera import Camera, project
from gateway.calibration.cameras_file import cameras_text, load_cameras
from gateway.calibration.cameras_import import import_cameras
from gateway.calibration.picture_size import SizeChange, fitted
from gateway.errors import SettingsError

DATA = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[4] / "shared" / "data")) / "pose2sim_single"
R = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CAMERA = Camera(
    "side",
    1280,
    720,
    np.array([[900.0, 0.0, 640.0], [0.0, 905.0, 355.0], [0.0, 0.0, 1.0]]),
    np.array([-0.1, 0.02, 0.001, -0.002, 0.003]),
    R,
    np.array([0.1, 1.2, 4.0]),
)
POINTS = np.array([[0.0, 0.0, 0.0], [0.3, -0.2, 1.1], [-0.4, 0.5, 1.7]])


def written(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_our_file_keeps_every_bit(tmp_path):
    found = load_cameras(written(tmp_path, "c.yaml", cameras_text([CAMERA], [0.3])))[0]
    assert (found.rotation == CAMERA.rotation).all()
    assert (found.matrix == CAMERA.matrix).all()
    assert (found.distortion == CAMERA.distortion).all()
    assert found.name == "side"


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_axis_that_points_up_becomes_z_and_pictures_stay(tmp_path, up):
    path = written(tmp_path, "c.yaml", cameras_text([CAMERA]))
    found = load_cameras(path, up)[0]
    axis, sign = "xyz".index(up[-1]), -1.0 if up[0] == "-" else 1.0
    turn = found.rotation.T @ CAMERA.rotation  # given world to upright
    assert turn @ (sign * np.eye(3)[axis]) == pytest.approx([0, 0, 1])
    assert np.linalg.det(turn) == pytest.approx(1)
    assert project(found, POINTS @ turn.T) == pytest.approx(project(CAMERA, POINTS))


QUALISYS = """<calibration><cameras><camera serial="c">
  <fov_video_max left="0" top="0" right="639" bottom="479"/>
  <transform x="0" y="-2000" z="1000" r11="1" r12="0" r13="0" r21="0" r22="0" r23="1"
   r31="0" r32="-1" r33="0"/>
  <intrinsic focalLengthU="32000" focalLengthV="32000" centerPointU="20480" centerPointV="15360"
   radialDistortion1="0" radialDistortion2="0" radialDistortion3="0" tangentalDistortion1="0"
   tangentalDistortion2="0"/></camera></cameras></calibration>"""


def test_qualisys_looks_where_it_says(tmp_path):
    """2 m from the origin along -y, upright, looking along +y: its rows are right, up, backwards."""
    camera = load_cameras(written(tmp_path, "c.qca.txt", QUALISYS))[0]
    assert (camera.width, camera.height) == (640, 480)
    assert camera.position == pytest.approx([0, -2, 1])
    pixels = project(camera, np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [0.0, 0.0, 1.5]]))
    assert pixels == pytest.approx(np.array([[320, 240], [445, 240], [320, 115]]))


TOML = """[cam_01]
name = "left"
size = [1280.0, 720.0]
matrix = [[900.0, 0.0, 640.0], [0.0, 905.0, 355.0], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.02, 0.001, -0.002]
rotation = [0.0, 0.0, 1.5707963267948966]
translation = [100.0, 1200.0, 4000.0]
fisheye = false
[metadata]
adjusted = false
error = 0.0
"""


def test_toml_in_millimetres(tmp_path):
    camera = load_cameras(written(tmp_path, "c.toml", TOML), unit="mm")[0]
    assert camera.name == "left"
    assert camera.translation == pytest.approx([0.1, 1.2, 4.0])
    assert camera.distortion == pytest.approx([-0.1, 0.02, 0.001, -0.002, 0.0])
    assert camera.rotation @ [1, 0, 0] == pytest.approx([0, 1, 0])


def test_toml_below_cameras_with_a_matrix_and_one_to_be_ignored(tmp_path):
    """As Caliscope writes it."""
    table = TOML[: TOML.index("[metadata]")].replace('name = "left"\n', "")
    table = table.replace(
        "[0.0, 0.0, 1.5707963267948966]", "[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]"
    )
    ignored = '[cameras.1]\nignore = true\nmatrix = "null"\n'
    text = table.replace("[cam_01]", "[cameras.0]") + ignored
    (camera,) = load_cameras(written(tmp_path, "camera_array.toml", text))
    assert camera.name == "cam_0"
    assert camera.rotation @ [1, 0, 0] == pytest.approx([0, 1, 0])


def test_cameras_kilometres_apart_are_of_another_unit(tmp_path):
    second = TOML[: TOML.index("[metadata]")].replace("[cam_01]", "[cam_02]").replace("left", "right")
    path = written(tmp_path, "c.toml", second.replace("4000.0", "-2000.0") + TOML)
    assert len(load_cameras(path, unit="mm")) == 2
    with pytest.raises(SettingsError, match=r"cameras stand within 6e\+03 m: .*--unit mm"):
        load_cameras(path)


def write_opencv(path):
    cv2 = pytest.importorskip("cv2")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in {"image_width": 1280, "image_height": 720, "camera_matrix": CAMERA.matrix,
                       "distortion_coefficients": CAMERA.distortion, "R": CAMERA.rotation,
                       "T": CAMERA.translation}.items():  # fmt: skip
        storage.write(key, value)
    storage.release()


@pytest.mark.parametrize("ending", ["yml", "yaml", "xml"])
def test_opencv_one_camera_a_file_or_a_folder_of_them(tmp_path, ending):
    for name in ("side", "front"):
        write_opencv(tmp_path / f"{name}.{ending}")
    (tmp_path / "notes.yaml").write_text("of: something else\n")
    (camera,) = load_cameras(tmp_path / f"side.{ending}")
    assert camera.name == "side"
    assert project(camera, POINTS) == pytest.approx(project(CAMERA, POINTS))
    with pytest.raises(SettingsError, match="stand within 0 m"):  # both are at one place
        load_cameras(tmp_path)
    assert [each.name for each in import_cameras(tmp_path)] == ["front", "side"]


def test_a_folder_without_calibrations_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="has no file of OpenCV's"):
        load_cameras(tmp_path)


def test_opencv_inner_and_outer_halves(tmp_path):
    cv2 = pytest.importorskip("cv2")
    turn, _ = cv2.Rodrigues(CAMERA.rotation)
    inner = {"K_1": CAMERA.matrix, "dist_1": CAMERA.distortion, "H_1": 720, "W_1": 1280}
    for name, content in {"intri.yml": inner, "extri.yml": {"R_1": turn, "T_1": CAMERA.translation}}.items():
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        storage.write("", "1")
        storage.endWriteStruct()
        for key, value in content.items():
            storage.write(key, value)
        storage.release()
    for place in (tmp_path / "intri.yml", tmp_path):
        (camera,) = load_cameras(place)
        assert project(camera, POINTS) == pytest.approx(project(CAMERA, POINTS))
    (tmp_path / "extri.yml").unlink()
    with pytest.raises(SettingsError, match=r"no matrix .*nor has extri.yml beside it"):
        load_cameras(tmp_path / "intri.yml")


def test_qualisys_under_another_name(tmp_path):
    assert load_cameras(written(tmp_path, "cameras.xml", QUALISYS))[0].name == "c"


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("c.toml", TOML.replace("fisheye = false", "fisheye = true"), "fisheye"),
        ("c.toml", TOML.replace("[900.0, 0.0, 640.0]", "[900.0, 640.0]"), "'matrix'"),
        ("c.toml", TOML.replace("900.0", "-900.0"), "focal lengths"),
        ("c.toml", "[cam_01", "is not TOML"),
        ("c.toml", TOML.replace("-0.002]", "-0.002, 0.0, 0.5]"), "6 distortion"),
        ("c.qca.txt", QUALISYS.replace('r22="0"', 'r22="0.3"'), "rotation of camera 'c'"),
        ("c.qca.txt", QUALISYS.replace('r22="0"', 'r22="x"'), "not a number"),
        ("c.qca.txt", "nothing", "no Qualisys calibration"),
        ("c.yml", "nothing", "OpenCV"),
        ("c.yaml", "cameras: []", "cameras"),
        ("c.json", "{}", "no calibration of cameras"),
    ],
)
def test_a_file_that_is_wrong_is_told_in_one_line(tmp_path, name, text, told):
    with pytest.raises(SettingsError, match=told) as error:
        load_cameras(written(tmp_path, name, text))
    assert "\n" not in str(error.value)
    assert str(tmp_path / name) in str(error.value)


def test_two_cameras_of_one_name_are_refused(tmp_path):
    with pytest.raises(SettingsError, match="two cameras are named 'side'"):
        load_cameras(written(tmp_path, "c.yaml", cameras_text([CAMERA, CAMERA])))


@pytest.mark.parametrize("change", [SizeChange.SCALED, SizeChange.CROPPED])
def test_pictures_of_another_size_see_the_middle_in_the_middle(change):
    found = fitted(CAMERA, 640, 400, change)
    scale = 0.5 if change is SizeChange.SCALED else 1.0
    before, after = project(CAMERA, POINTS), project(found, POINTS)
    # the pixel that was in the middle stays there
    assert after == pytest.approx(scale * (before - [639.5, 359.5]) + [319.5, 199.5])


def test_another_size_without_a_word_is_refused():
    with pytest.raises(SettingsError, match="1280×720 pixels, these are 640×400"):
        fitted(CAMERA, 640, 400)


@pytest.mark.skipif(not DATA.is_dir(), reason="the recordings of shared/data are not here")
def test_a_real_qualisys_calibration_stands_around_the_walker():
    cameras = load_cameras(DATA / "calibration" / "Calib.qca.txt")
    assert [camera.name for camera in cameras] == ["cam01", "cam02", "cam03", "cam04"]
    middle = np.array([[-0.2, 0.0, 1.0]])
    for camera in cameras:
        assert 1 < camera.position[2] < 3
        pixel = project(camera, middle)[0]
        assert (pixel > 0).all()
        assert (pixel < (camera.width, camera.height)).all()
