"""Focal lengths, principal point and distortion of one camera from pictures of a board (Zhang 2000)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from gateway.calibration.boards import Board, BoardView
from gateway.errors import GatewayError
from gateway.frames import FloatArray

FEWEST_VIEWS = 4
_VIEWS_FOR_K3 = 15
"""Fewer do not determine the third radial coefficient: it then only fits noise."""
_NARROW = 0.5
"""Share of the picture's width and height that the corners of all views should span at least."""


@dataclass(frozen=True)
class Lens:
    """What a camera's pictures of the board show."""

    matrix: FloatArray  # (3, 3) pixels
    distortion: FloatArray  # (5,)
    rms: float
    """Reprojection error, pixels."""
    poses: tuple[tuple[FloatArray, FloatArray], ...]
    """Of the board in every view: rotation vector (3,) and translation (3,) m, board to camera axes."""
    span: tuple[float, float]
    """Shares of the picture's width and height that corners were seen in."""

    @property
    def warning(self) -> str:
        """What the pictures leave open; empty: nothing."""
        if min(self.span) < _NARROW:
            return (
                f"corners span {100 * self.span[0]:.0f} % of the width and {100 * self.span[1]:.0f} % of the "
                "height only: distortion beyond is guessed; show the board in the picture's corners too"
            )
        return ""


def calibrate_lens(board: Board, views: Sequence[BoardView], width: int, height: int, name: str) -> Lens:
    """Return the lens of a camera.

    Raises ``GatewayError`` with too few views, or views of one direction only.
    """
    if len(views) < FEWEST_VIEWS:
        raise GatewayError(
            f"camera '{name}': the board was found in {len(views)} pictures, {FEWEST_VIEWS} are the least "
            f"and 15 are good: is it {board.columns}×{board.rows} inner corners, whole and sharp?"
        )
    points = [board.points[view.corners].astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    # With few views k3 follows noise at the picture's edge.
    flags = 0 if len(views) >= _VIEWS_FOR_K3 else cv2.CALIB_FIX_K3
    try:
        rms, matrix, distortion, turns, places = cv2.calibrateCamera(
            points, pixels, (width, height), np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise GatewayError(
            f"camera '{name}' cannot be calibrated from these pictures: {error.err}"
        ) from error
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0):
        raise GatewayError(
            f"camera '{name}': pictures of the board from one side tell no focal length: tilt it"
        )
    every = np.concatenate(pixels)
    span = np.ptp(every, axis=0) / (width, height)
    poses = tuple(
        (r.ravel().astype(float), t.ravel().astype(float)) for r, t in zip(turns, places, strict=True)
    )
    return Lens(
        np.asarray(matrix, dtype=np.float64), np.asarray(distortion, dtype=np.float64).ravel()[:5],
        float(rms), poses, (float(span[0]), float(span[1])),
    )  # fmt: skip
