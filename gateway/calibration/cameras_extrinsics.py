"""Where cameras stand, from boards that several of them see at the same instants.

Chained from camera to camera through instants that both see, then all cameras and boards are found
together (bundle adjustment of poses; lenses stay as they are). The world is the first board: origin in
its first corner, Z up out of the face that the cameras see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from devices.deferred import least_squares
from gateway.body.camera import Camera
from gateway.calibration.boards import Board, BoardView
from gateway.calibration.cameras_intrinsics import Lens
from gateway.errors import GatewayError
from gateway.frames import FloatArray

Views = Mapping[int, BoardView]
"""By camera, of one instant."""
_INTO_TO_OUT = np.diag([1.0, -1.0, -1.0])
"""The board's axes have z into it; the world's Z points out of it."""


@dataclass(frozen=True)
class Placement:
    """Where the cameras stand."""

    turns: FloatArray  # (n_cameras, 3, 3) world to camera axes
    places: FloatArray  # (n_cameras, 3) m, world origin in camera axes
    rms: FloatArray  # (n_cameras,) reprojection error, pixels
    expected: tuple[Mapping[int, FloatArray], ...]
    """Of every instant and camera: pixels (n, 2) of the corners by the result."""


def place_cameras(
    board: Board, lenses: Sequence[Lens], instants: Sequence[Views], names: Sequence[str]
) -> Placement:
    """Return where the cameras stand.

    Raises ``GatewayError`` for a camera that shares no instant with others.
    """
    # Turned by half a turn it is the same board, and each camera may count its corners from another end.
    if not board.has_direction and len(lenses) > 1:
        raise GatewayError(
            f"a checkerboard of {board.columns}×{board.rows} inner corners looks the same upside down, and "
            "cameras cannot tell its corners apart: take one with an odd and an even number, or ChArUco"
        )
    seen = [_board_poses(board, lenses, views) for views in instants]
    cameras, boards = _chained(seen, len(lenses))
    lost = [name for name, pose in zip(names, cameras, strict=True) if pose is None]
    if lost:
        raise GatewayError(
            f"camera '{lost[0]}' never sees the board at the same instant as the others: show it to both at "
            "once"
        )
    poses = np.concatenate(
        [_vector(pose) for pose in cameras if pose is not None]
        + [_vector(pose) for pose in boards if pose is not None]
    )
    # Instants that no chain reaches have no first estimate, and are left out.
    used = [views for views, pose in zip(instants, boards, strict=True) if pose is not None]
    return _result(board, lenses, used, _adjusted(board, lenses, used, poses))


Pose = FloatArray
"""(4, 4)."""


def _board_poses(board: Board, lenses: Sequence[Lens], views: Views) -> dict[int, Pose]:
    """Return poses of the board by camera: board axes to camera axes."""
    found = {}
    for c, view in views.items():
        is_found, turn, place = cv2.solvePnP(
            board.points[view.corners],
            view.pixels,
            lenses[c].matrix,
            lenses[c].distortion,
            flags=cv2.SOLVEPNP_IPPE,
        )
        if is_found:
            found[c] = _pose(np.concatenate([turn.ravel(), place.ravel()]))
    return found


def _chained(seen: Sequence[Mapping[int, Pose]], n: int) -> tuple[list[Pose | None], list[Pose | None]]:
    """Return first estimates of the poses of cameras and boards.

    Cameras: the first board's axes to the camera's; boards: the board's axes to the first board's.
    """
    cameras: list[Pose | None] = [None] * n
    boards: list[Pose | None] = [None] * len(seen)
    if seen:
        boards[0] = np.eye(4)
    # Every round reaches at least one more camera or board, so that so many rounds reach all that can be.
    for _ in range(n + len(seen)):
        for b, by_camera in enumerate(seen):
            for c, pose in by_camera.items():
                known_board, known_camera = boards[b], cameras[c]
                if known_camera is None and known_board is not None:
                    cameras[c] = pose @ np.linalg.inv(known_board)
                elif known_camera is not None and known_board is None:
                    boards[b] = np.linalg.inv(known_camera) @ pose
    return cameras, boards


def _adjusted(
    board: Board, lenses: Sequence[Lens], instants: Sequence[Views], start: FloatArray
) -> FloatArray:
    """Return camera and board poses (n, 6) that bring all corners nearest to where they were seen; the first
    board stays."""
    n = len(lenses)
    free = np.ones(len(start), dtype=bool)
    # The first board is the world: moving everything together changes no picture.
    free[6 * n : 6 * n + 6] = False
    whole = start.copy()

    def residuals(values: FloatArray) -> FloatArray:
        whole[free] = values
        rest = [
            (_projected(board, lenses[c], whole, c, n + b, view) - view.pixels).ravel()
            for b, views in enumerate(instants)
            for c, view in views.items()
        ]
        return np.concatenate(rest)

    # Softened, because a corner found wrongly would pull everything.
    done = least_squares(residuals, start[free], method="trf", x_scale="jac", loss="soft_l1")
    whole[free] = done.x
    return whole


def _projected(
    board: Board, lens: Lens, poses: FloatArray, camera: int, item: int, view: BoardView
) -> FloatArray:
    both = _pose(poses[6 * camera : 6 * camera + 6]) @ _pose(poses[6 * item : 6 * item + 6])
    turn, _ = cv2.Rodrigues(both[:3, :3])
    pixels, _ = cv2.projectPoints(board.points[view.corners], turn, both[:3, 3], lens.matrix, lens.distortion)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def _result(board: Board, lenses: Sequence[Lens], instants: Sequence[Views], poses: FloatArray) -> Placement:
    n = len(lenses)
    expected: list[dict[int, FloatArray]] = []
    squares: list[list[float]] = [[] for _ in range(n)]
    for b, views in enumerate(instants):
        expected.append({c: _projected(board, lenses[c], poses, c, n + b, view) for c, view in views.items()})
        for c, view in views.items():
            squares[c] += np.square(expected[-1][c] - view.pixels).sum(axis=1).tolist()
    cameras = [_pose(poses[6 * c : 6 * c + 6]) for c in range(n)]
    return Placement(
        np.stack([pose[:3, :3] @ _INTO_TO_OUT for pose in cameras]),
        np.stack([pose[:3, 3] for pose in cameras]),
        np.sqrt([float(np.mean(each)) for each in squares]),
        tuple(expected),
    )


def placed_cameras(
    names: Sequence[str], sizes: Sequence[tuple[int, int]], lenses: Sequence[Lens], placement: Placement
) -> tuple[Camera, ...]:
    """Return the calibrated cameras; ``sizes`` are width and height of their pictures."""
    return tuple(
        Camera(name, *size, lens.matrix, lens.distortion, turn, place)
        for name, size, lens, turn, place in zip(
            names, sizes, lenses, placement.turns, placement.places, strict=True
        )
    )


def _pose(vector: FloatArray) -> Pose:
    pose = np.eye(4)
    pose[:3, :3], _ = cv2.Rodrigues(vector[:3])
    pose[:3, 3] = vector[3:]
    return pose


def _vector(pose: Pose) -> FloatArray:
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    return np.concatenate([turn.ravel(), pose[:3, 3]])
