"""``camera_boards``: real lenses from pictures of a real checkerboard, beside the shipped calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures import Figure, Report, table
from gateway.body.camera import Camera
from gateway.calibration.boards import Board, BoardView, board_of
from gateway.calibration.cameras_import import import_cameras
from gateway.calibration.cameras_intrinsics import Lens, calibrate_lens
from gateway.calibration.cameras_session import board_pictures

DATA = Path(__file__).parents[2] / "shared/data/pose2sim_single"
BOARD = "checkerboard:7x4:0.06"
_HEADS = ["camera", "pictures", "focal length, px", "shipped", "lens rms, px", "pictures left out, px"]


@dataclass(frozen=True)
class RealLens:
    """One camera's."""

    pictures: int
    """In which the board was found."""
    focal_px: float
    rms_px: float
    """Reprojection error of the pictures that the lens follows from."""
    held_out_px: float
    """Median over pictures that were left out: root mean square of where the board alone was placed anew."""


def real_lens(data: Path, camera: Camera) -> RealLens:
    """Of a camera of ``pose2sim_single``."""
    board = board_of(BOARD)
    folder = data / f"calibration/intrinsics/int_{camera.name}_img"
    pictures = board_pictures(board, str(folder), 1, lambda *_: None)
    views = [each.view for each in pictures if each.view is not None]
    lens = calibrate_lens(board, views, camera.width, camera.height, camera.name)
    held_out = _held_out_errors(board, views, camera.width, camera.height, camera.name)
    return RealLens(len(views), float(lens.matrix[0, 0]), lens.rms, float(np.median(held_out)))


def _held_out_errors(
    board: Board, views: Sequence[BoardView], width: int, height: int, name: str
) -> list[float]:
    """Return each view's reprojection error by the lens of all other views, root mean square, pixels.

    Only the board's place is found anew in the view itself. Raises as ``calibrate_lens``.
    """
    return [
        _rms(board, calibrate_lens(board, [*views[:n], *views[n + 1 :]], width, height, name), view)
        for n, view in enumerate(views)
    ]


def _rms(board: Board, lens: Lens, view: BoardView) -> float:
    points = board.points[view.corners]
    _, turn, place = cv2.solvePnP(points, view.pixels, lens.matrix, lens.distortion)
    pixels, _ = cv2.projectPoints(points, turn, place, lens.matrix, lens.distortion)
    off = pixels.reshape(-1, 2) - view.pixels
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def run() -> Report:
    """Four cameras, seven pictures each; raises ``OSError`` without them."""
    report = Report("camera_boards")
    rows, focal, held_out = [], [], []
    for camera in import_cameras(DATA / "calibration/Calib.qca.txt"):
        lens = real_lens(DATA, camera)
        shipped = float(camera.matrix[0, 0])
        focal.append(100 * abs(lens.focal_px / shipped - 1))
        held_out.append(lens.held_out_px)
        values = f"{lens.focal_px:.1f}", f"{shipped:.1f}", f"{lens.rms_px:.2f}", f"{lens.held_out_px:.2f}"
        rows.append([camera.name, str(lens.pictures), *values])
    report.figures += [
        Figure("focal_off_percent", max(focal), "%", "<=1", "largest, against the shipped calibration"),
        Figure(
            "held_out_px", max(held_out), "px", "<=2", "worst camera, pictures left out of its calibration"
        ),
    ]
    report.tables.append(table(_HEADS, rows))
    return report
