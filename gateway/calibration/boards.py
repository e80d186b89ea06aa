"""Calibration boards: checkerboards and ChArUco boards, found in pictures and drawn onto them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import cv2
import numpy as np

from devices.cameras.pictures import Picture
from gateway.errors import GatewayError
from gateway.frames import FloatArray, IntArray

_FEWEST = 6
"""Corners of a ChArUco board that count as seeing it."""
_EXAMPLES = (
    "checkerboard:7x4:0.06 (inner corners, square in m), charuco:8x5:0.06:0.045:4X4_50 (squares, marker in m)"
)


@dataclass(frozen=True)
class Board:
    """A flat board; its axes: x along the columns of corners, y along the rows, z into the board."""

    kind: str
    """checkerboard or charuco."""
    columns: int
    """Of inner corners."""
    rows: int
    square: float  # m
    marker: float = 0.0  # m, of a ChArUco board
    dictionary: str = ""
    """Of ArUco markers, as OpenCV calls it without DICT_."""

    @property
    def points(self) -> FloatArray:
        """(rows · columns, 3) m, all inner corners, in board axes."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        flat = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return np.asarray(self.square * flat, dtype=np.float64)

    @property
    def has_direction(self) -> bool:
        """Whether it looks different turned by half a turn: then two cameras agree which corner is which."""
        return self.kind == "charuco" or (self.columns + self.rows) % 2 == 1

    @property
    def charuco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's own, of a ChArUco board."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        size = (self.columns + 1, self.rows + 1)
        return cv2.aruco.CharucoBoard(size, self.square, self.marker, dictionary)


@dataclass(frozen=True)
class BoardView:
    """A board as one picture shows it."""

    corners: IntArray
    """(n,) which inner corners are seen."""
    pixels: FloatArray
    """(n, 2) where."""


def board_of(text: str) -> Board:
    """Return a board as the command line writes it. Raises ``GatewayError`` with an example."""
    plain = re.fullmatch(r"checkerboard:(\d+)x(\d+):([\d.]+)", text)
    marked = re.fullmatch(r"charuco:(\d+)x(\d+):([\d.]+):([\d.]+):(\w+)", text)
    try:
        if plain is not None:
            board = Board("checkerboard", int(plain[1]), int(plain[2]), float(plain[3]))
        elif marked is not None:
            board = Board(
                "charuco", int(marked[1]) - 1, int(marked[2]) - 1, float(marked[3]), float(marked[4]),
                marked[5].upper().removeprefix("DICT_"),
            )  # fmt: skip
        else:
            raise ValueError
    except ValueError:
        raise GatewayError(f"--board {text}: such as {_EXAMPLES} is wanted") from None
    if min(board.columns, board.rows) < 3 or not 0.001 <= board.square <= 2:
        raise GatewayError(
            f"--board {text}: at least 3×3 inner corners and squares of 1 mm to 2 m are wanted"
        )
    if board.kind == "charuco":
        if not hasattr(cv2.aruco, f"DICT_{board.dictionary}"):
            raise GatewayError(f"--board {text}: there is no ArUco dictionary {board.dictionary} (4X4_50, …)")
        if not 0 < board.marker < board.square:
            raise GatewayError(f"--board {text}: markers are smaller than squares")
    return board


def find_board(board: Board, picture: Picture) -> BoardView | None:
    """Return the board's corners in a picture; None: not seen, or a checkerboard that is not whole."""
    grey = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    if board.kind == "charuco":
        places, corners, _, _ = cv2.aruco.CharucoDetector(board.charuco).detectBoard(grey)
        if corners is None or len(corners) < _FEWEST:
            return None
        return BoardView(
            corners.ravel().astype(np.int64), np.asarray(places, dtype=np.float64).reshape(-1, 2)
        )
    pixels = _checkerboard(grey, (board.columns, board.rows))
    if pixels is None:
        return None
    if board.has_direction and not _begins_dark(board, pixels, grey):
        pixels = pixels[::-1].copy()
    return BoardView(np.arange(len(pixels)), pixels)


def _checkerboard(grey: Picture, size: tuple[int, int]) -> FloatArray | None:
    """Return the inner corners (n, 2), fractions of a pixel. Two detectors: each misses boards that the other
    finds."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    is_found, corners = cv2.findChessboardCorners(grey, size, flags=flags)
    if not is_found:
        is_found, corners = cv2.findChessboardCornersSB(
            grey, size, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
        )
        return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if is_found else None
    rough = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    apart = float(np.linalg.norm(np.diff(rough, axis=0), axis=1).min())
    window = int(np.clip(0.4 * apart, 2, 11))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    fine = cv2.cornerSubPix(grey, rough.astype(np.float32), (window, window), (-1, -1), stop)
    return np.asarray(fine, dtype=np.float64).reshape(-1, 2)


def _begins_dark(board: Board, pixels: FloatArray, grey: Picture) -> bool:
    """Return whether the first square between inner corners is dark: from there corners are counted."""
    grid = pixels.reshape(board.rows, board.columns, 2)
    first, beside = (grid[:2, x : x + 2].reshape(4, 2).mean(axis=0) for x in (0, 1))
    height, width = grey.shape[:2]

    def brightness(place: FloatArray) -> float:
        x, y = np.clip(np.rint(place).astype(int), 1, [width - 2, height - 2])
        return float(grey[y - 1 : y + 2, x - 1 : x + 2].mean())

    return brightness(first) < brightness(beside)


def draw_board(picture: Picture, view: BoardView | None, expected: FloatArray | None = None) -> Picture:
    """Return the picture with the corners found (circles) and those that the calibration expects (red).

    expected: (n, 2) pixels.
    """
    drawn = picture.copy()
    size = max(round(picture.shape[0] / 200), 2)
    if view is None:
        cv2.putText(drawn, "no board", (10, 40), cv2.FONT_HERSHEY_SIMPLEX, 1.2, (0, 0, 255), 3, cv2.LINE_AA)
        return drawn
    for index, (corner, pixel) in enumerate(zip(view.corners, view.pixels, strict=True)):
        place = tuple(round(value) for value in pixel)
        cv2.circle(drawn, place, size, (80, 220, 80), 2, cv2.LINE_AA)
        # First and last corner are numbered: that shows whether the board was taken upside down.
        if index == 0 or corner == view.corners[-1]:
            cv2.putText(
                drawn, str(corner), place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 160, 0), 2, cv2.LINE_AA
            )
    for pixel in () if expected is None else expected:
        place = tuple(round(value) for value in pixel)
        cv2.drawMarker(drawn, place, (0, 0, 255), cv2.MARKER_CROSS, 2 * size, 1, cv2.LINE_AA)
    return drawn
