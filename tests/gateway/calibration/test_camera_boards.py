"""Cameras calibrated from rendered boards, whose truth is known."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2")

import cv2
from typer.testing import CliRunner

from gateway.body.camera import Camera, project
from gateway.calibration.boards import board_of, find_board
from gateway.calibration.cameras_extrinsics import place_cameras
from gateway.calibration.cameras_file import load_cameras
from gateway.calibration.cameras_intrinsics import Lens, calibrate_lens
from gateway.calibration.cameras_session import BoardPicture, calibrate_cameras
from gateway.cli.main import app
from gateway.errors import GatewayError

CHECKERBOARD = board_of("checkerboard:7x4:0.06")
CHARUCO = board_of("charuco:8x5:0.06:0.045:4X4_50")
SIZE = (640, 480)
MATRIX = np.array([[620.0, 0.0, 310.0], [0.0, 615.0, 250.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.12, 0.05, 0.001, -0.0008, 0.0])
PIXELS_A_SQUARE = 60
REAL = Path(os.environ.get("MOCAP_DATA", Path(__file__).parents[4] / "shared/data")) / "pose2sim_single"


def texture(board):
    """The board as a flat picture, and the map from its axes (m) to texture pixels."""
    columns, rows = board.columns + 1, board.rows + 1
    if board.kind == "charuco":
        flat = board.charuco.generateImage((columns * PIXELS_A_SQUARE, rows * PIXELS_A_SQUARE))
    else:
        squares = (np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 1) * 255
        flat = np.kron(squares, np.ones((PIXELS_A_SQUARE, PIXELS_A_SQUARE))).astype(np.uint8)
    return cv2.copyMakeBorder(flat, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)


def rendered(board, camera, board_to_camera):
    """What the camera sees of the board: a ray through every pixel, met with the board's plane."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)[:, None]
    rays = cv2.undistortPoints(pixels, camera.matrix, camera.distortion).reshape(-1, 2)
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    R, t = board_to_camera[:3, :3], board_to_camera[:3, 3]
    depth = (R[:, 2] @ t) / (rays @ R[:, 2])
    on_board = (rays * depth[:, None] - t) @ R
    # corner (0, 0) of the axes is the first inner one: a square in from the edge, with the border around
    places = on_board[:, :2] / board.square * PIXELS_A_SQUARE + PIXELS_A_SQUARE + 60 - 0.5
    places[depth <= 0] = -1000
    shape = (camera.height, camera.width)
    u, v = (places[:, i].reshape(shape).astype(np.float32) for i in (0, 1))
    grey = cv2.remap(texture(board), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128)
    return cv2.cvtColor(cv2.GaussianBlur(grey, (0, 0), 0.6), cv2.COLOR_GRAY2BGR)


def pose(turn, place):
    T = np.eye(4)
    T[:3, :3], _ = cv2.Rodrigues(np.array(turn, dtype=float))
    T[:3, 3] = place
    return T


def looking_at(position, target, matrix=MATRIX, distortion=DISTORTION, name="a"):
    """A camera above the floor, its picture's up the world's."""
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Camera(name, *SIZE, matrix, distortion, R, -R @ np.asarray(position, dtype=float))


LENS_POSES = [
    pose((0.1, 0.2, 0.0), (-0.24, -0.14, 0.66)),
    pose((0.5, -0.3, 0.2), (-0.1, -0.15, 0.6)),
    pose((-0.5, 0.3, -0.1), (-0.2, 0.0, 0.65)),
    pose((0.2, 0.6, 0.3), (-0.15, -0.15, 0.6)),
    pose((-0.4, -0.5, 0.1), (-0.1, -0.05, 0.75)),
    pose((0.3, 0.0, 1.4), (0.1, -0.18, 0.7)),
]


@pytest.fixture(scope="module")
def lens_views():
    camera = Camera("a", *SIZE, MATRIX, DISTORTION, np.eye(3), np.zeros(3))
    return [find_board(CHECKERBOARD, rendered(CHECKERBOARD, camera, each)) for each in LENS_POSES]


def test_corners_are_found_where_the_lens_puts_them(lens_views):
    camera = Camera("a", *SIZE, MATRIX, DISTORTION, np.eye(3), np.zeros(3))
    errors = []
    for view, T in zip(lens_views, LENS_POSES, strict=True):
        assert view is not None
        truth = project(camera, CHECKERBOARD.points @ T[:3, :3].T + T[:3, 3])
        errors.append(np.linalg.norm(view.pixels - truth, axis=1))
    assert np.mean(errors) < 0.1


def test_the_lens_is_that_of_the_rendering(lens_views):
    lens = calibrate_lens(CHECKERBOARD, lens_views, *SIZE, "a")
    assert lens.rms < 0.15
    assert lens.matrix[0, 0] == pytest.approx(620, rel=0.005)
    assert lens.matrix[:2, 2] == pytest.approx([310, 250], abs=3)
    assert lens.distortion[0] == pytest.approx(-0.12, abs=0.02)


def test_a_charuco_board_is_found_half_hidden():
    camera = Camera("a", *SIZE, MATRIX, DISTORTION, np.eye(3), np.zeros(3))
    T = LENS_POSES[1]
    picture = rendered(CHARUCO, camera, T)
    picture[:, :300] = 90
    view = find_board(CHARUCO, picture)
    assert view is not None
    assert len(view.corners) < len(CHARUCO.points)
    truth = project(camera, CHARUCO.points[view.corners] @ T[:3, :3].T + T[:3, 3])
    assert np.linalg.norm(view.pixels - truth, axis=1).mean() < 0.5


def test_cameras_stand_where_they_were_rendered_from():
    """The board on the floor at the origin, its first corner there, seen by three cameras."""
    board_in_world = np.diag([1.0, -1.0, -1.0, 1.0])
    cameras = [
        looking_at((0.9, -0.8, 0.6), (0.2, -0.1, 0), name="a"),
        looking_at((-0.5, -0.9, 0.7), (0.2, -0.1, 0), name="b"),
        looking_at((0.4, 0.9, 0.8), (0.2, -0.1, 0), name="c"),
    ]
    views = {}
    for c, camera in enumerate(cameras):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = camera.rotation, camera.translation
        views[c] = find_board(CHECKERBOARD, rendered(CHECKERBOARD, camera, T @ board_in_world))
    assert None not in views.values()
    lens = Lens(MATRIX, DISTORTION, 0.0, (), (1.0, 1.0))
    placement = place_cameras(CHECKERBOARD, [lens] * 3, [views], ["a", "b", "c"])
    for c, camera in enumerate(cameras):
        position = -placement.turns[c].T @ placement.places[c]
        assert position == pytest.approx(camera.position, abs=0.004)
        assert np.abs(placement.turns[c] - camera.rotation).max() < 0.005
    assert placement.rms.max() < 0.3


def test_a_board_that_looks_the_same_upside_down_is_refused():
    lens = Lens(MATRIX, DISTORTION, 0.0, (), (1.0, 1.0))
    with pytest.raises(GatewayError, match="upside down"):
        place_cameras(board_of("checkerboard:6x4:0.05"), [lens, lens], [], ["a", "b"])


def test_a_camera_that_shares_no_instant_is_named(lens_views):
    lens = Lens(MATRIX, DISTORTION, 0.0, (), (1.0, 1.0))
    with pytest.raises(GatewayError, match="camera 'b' never sees"):
        place_cameras(CHECKERBOARD, [lens, lens], [{0: lens_views[0]}], ["a", "b"])


def test_too_few_views_are_told(lens_views):
    with pytest.raises(GatewayError, match="camera 'a': the board was found in 2 pictures"):
        calibrate_lens(CHECKERBOARD, lens_views[:2], *SIZE, "a")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "checkerboard:7x4",
        "checkerboard:2x4:0.1",
        "checkerboard:7x4:0",
        "charuco:8x5:0.06:0.08:4X4_50",
        "charuco:8x5:0.06:0.04:9X9_50",
    ],
)
def test_a_board_that_is_none_is_refused(text):
    with pytest.raises(GatewayError, match="--board"):
        board_of(text)


def test_the_command_calibrates_from_folders(tmp_path):
    """Two cameras, lens pictures and scene; the pictures of the board are written."""
    cameras = [looking_at((0.9, -0.8, 0.6), (0.2, -0.1, 0)), looking_at((-0.5, -0.9, 0.7), (0.2, -0.1, 0))]
    arguments = ["calibrate", "cameras"]
    for name, camera in zip("ab", cameras, strict=True):
        folder = tmp_path / name
        folder.mkdir()
        for index, each in enumerate(LENS_POSES):
            cv2.imwrite(str(folder / f"{index}.png"), rendered(CHECKERBOARD, camera, each))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = camera.rotation, camera.translation
        scene = rendered(CHECKERBOARD, camera, T @ np.diag([1.0, -1.0, -1.0, 1.0]))
        cv2.imwrite(str(tmp_path / f"scene_{name}.png"), scene)
        arguments += [f"{name}={folder}", "--scene", f"{name}={tmp_path / f'scene_{name}.png'}"]
    target = tmp_path / "cameras.yaml"
    done = CliRunner().invoke(
        app, [*arguments, "--board", "checkerboard:7x4:0.06", "-o", str(target), "--json"]
    )
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert all(camera["board_found"] == len(LENS_POSES) for camera in told["cameras"])
    for found, truth in zip(load_cameras(target), cameras, strict=True):
        assert found.position == pytest.approx(truth.position, abs=0.02)
    assert len(list((tmp_path / "cameras_boards").iterdir())) == 14


def test_pictures_that_were_not_taken_at_once_are_no_scene(lens_views):
    """The n-th ones show the board at different places."""
    blank = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)
    pictures = [BoardPicture(str(n), blank, view) for n, view in enumerate(lens_views)]
    lenses = {"a": pictures, "b": pictures}
    scene = {"a": pictures[:2], "b": pictures[3:5]}
    with pytest.raises(GatewayError, match=r"camera '.': corners .* pixels off .* with --scene"):
        calibrate_cameras(CHECKERBOARD, lenses, CHECKERBOARD, scene)
