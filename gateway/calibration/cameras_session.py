"""Cameras calibrated from pictures of a board: lenses one by one, then where they stand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from devices.cameras.pictures import IMAGES, Picture, open_pictures, read_image
from gateway.body.camera import Camera
from gateway.calibration.boards import Board, BoardView, draw_board, find_board
from gateway.calibration.cameras_extrinsics import Placement, place_cameras, placed_cameras
from gateway.calibration.cameras_intrinsics import Lens, calibrate_lens
from gateway.errors import GatewayError
from gateway.frames import FloatArray

_SCENE_DOES_NOT_FIT = 10.0
"""Pixels of reprojection error; a board that cameras see at once leaves less than one."""
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class BoardPicture:
    """A picture in which a board was looked for."""

    name: str
    picture: Picture
    view: BoardView | None


@dataclass(frozen=True)
class CamerasResult:
    """What the pictures show."""

    cameras: tuple[Camera, ...]
    lenses: tuple[Lens, ...]
    placement: Placement
    lens_pictures: tuple[tuple[BoardPicture, ...], ...]
    scene_pictures: tuple[tuple[BoardPicture, ...], ...]


def board_pictures(board: Board, place: str, every: int, progress: Progress) -> list[BoardPicture]:
    """Return every n-th picture of an image, folder or video, with the board where it is found."""
    found = []
    for name, picture, total in _pictures(place, every):
        found.append(BoardPicture(name, picture, find_board(board, picture)))
        progress(len(found), total)
    return found


def _pictures(place: str, every: int) -> Iterator[tuple[str, Picture, int]]:
    if Path(place).suffix.lower() in IMAGES:
        yield Path(place).stem, read_image(Path(place)), 1
        return
    source = open_pictures(place)
    total = (source.info.count or 0) // every
    for index, (_, picture) in enumerate(source):
        if index % every == 0:
            yield f"{source.info.name}_{index:05}", picture, total
    source.close()


def calibrate_cameras(
    board: Board,
    lens_pictures: Mapping[str, Sequence[BoardPicture]],
    scene_board: Board,
    scene_pictures: Mapping[str, Sequence[BoardPicture]],
) -> CamerasResult:
    """Calibrate lenses, then places. Raises ``GatewayError`` naming the camera that lacks something.

    Pictures are by camera; the n-th picture of the scene is of the same instant in all cameras.
    """
    names = list(lens_pictures)
    if set(scene_pictures) != set(names):
        odd = sorted(set(scene_pictures) ^ set(names))[0]
        raise GatewayError(f"camera '{odd}' needs both: pictures of the board for its lens, and --scene")
    sizes = [_size(name, [*lens_pictures[name], *scene_pictures[name]]) for name in names]
    lenses = [
        calibrate_lens(board, [p.view for p in lens_pictures[name] if p.view is not None], *size, name)
        for name, size in zip(names, sizes, strict=True)
    ]
    n_instants = max(len(pictures) for pictures in scene_pictures.values())
    instants = [
        {
            c: view
            for c, name in enumerate(names)
            if t < len(scene_pictures[name]) and (view := scene_pictures[name][t].view) is not None
        }
        for t in range(n_instants)
    ]
    instants = [views for views in instants if len(views) >= min(2, len(names))]
    placement = place_cameras(scene_board, lenses, instants, names)
    worst = int(np.argmax(placement.rms))
    if placement.rms[worst] > _SCENE_DOES_NOT_FIT:
        raise GatewayError(
            f"camera '{names[worst]}': corners in the pictures of the scene are "
            f"{placement.rms[worst]:.0f} pixels off from any place of the cameras: the n-th pictures of all "
            "cameras must be of one instant; give pictures that were taken at once with --scene"
        )
    return CamerasResult(
        placed_cameras(names, sizes, lenses, placement), tuple(lenses), placement,
        tuple(tuple(lens_pictures[name]) for name in names),
        tuple(tuple(scene_pictures[name]) for name in names),
    )  # fmt: skip


def _size(name: str, pictures: Sequence[BoardPicture]) -> tuple[int, int]:
    """Return the width and height, the same of all."""
    sizes = {(each.picture.shape[1], each.picture.shape[0]) for each in pictures}
    if len(sizes) != 1:
        listed = ", ".join(f"{width}×{height}" for width, height in sorted(sizes))
        raise GatewayError(f"camera '{name}': all pictures must be of one size, these are {listed or 'none'}")
    return sizes.pop()


def write_board_pictures(board: Board, result: CamerasResult, folder: Path) -> int:
    """Write every picture with the corners found and, in red, where they should be; return how many.

    Raises ``OSError`` as ``mkdir`` does.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = 0
    for camera, lens, pictures in zip(result.cameras, result.lenses, result.lens_pictures, strict=True):
        poses = iter(lens.poses)
        for each in pictures:
            # Poses exist for views alone, in their order.
            expected = None if each.view is None else _expected(board, lens, each.view, *next(poses))
            _write(
                folder / f"{camera.name}_lens_{each.name}.jpg", draw_board(each.picture, each.view, expected)
            )
            written += 1
    for camera, pictures in zip(result.cameras, result.scene_pictures, strict=True):
        for each in pictures:
            _write(folder / f"{camera.name}_scene_{each.name}.jpg", draw_board(each.picture, each.view))
            written += 1
    return written


def _expected(board: Board, lens: Lens, view: BoardView, turn: FloatArray, place: FloatArray) -> FloatArray:
    pixels, _ = cv2.projectPoints(board.points[view.corners], turn, place, lens.matrix, lens.distortion)
    return np.asarray(pixels, dtype=np.float64).reshape(-1, 2)


def _write(file: Path, picture: Picture) -> None:
    if not cv2.imwrite(str(file), picture):
        raise GatewayError(f"{file} cannot be written")
