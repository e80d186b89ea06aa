"""``mocap-gateway calibrate cameras``: lenses and places, from a board or another program's file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from gateway.body.camera import Camera
from gateway.calibration.cameras_file import AXES, axis_of, cameras_text, load_cameras
from gateway.cli.progress import progress_bar
from gateway.errors import GatewayError
from gateway.support.video_extra import require_video_extra

if TYPE_CHECKING:
    from gateway.calibration.boards import Board
    from gateway.calibration.cameras_session import BoardPicture, CamerasResult


def cameras(
    lenses: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="NAME=PICTURES…",
            help="By camera: folder of images or video in which the board is moved about before the lens.",
        ),
    ] = None,
    scene: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=PICTURES",
            help="By camera: image, folder or video with the board where several cameras see it; the n-th "
            "pictures are of one instant. The first one's board, lying on the floor, is the world.",
        ),
    ] = None,
    board: Annotated[
        str | None,
        typer.Option(
            help="checkerboard:7x4:0.06 (inner corners, square in m), or charuco:8x5:0.06:0.045:4X4_50 "
            "(squares, square and marker in m, dictionary)."
        ),
    ] = None,
    scene_board: Annotated[
        str | None, typer.Option(help="Board of the scene, when it is another one.")
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Take every so many pictures.")] = 1,
    import_file: Annotated[
        Path | None,
        typer.Option("--import", help="Instead of all that: a .qca.txt, .toml, .yml or .xml calibration."),
    ] = None,
    up: Annotated[str, typer.Option(help=f"Axis of the world that points up: {', '.join(AXES)}.")] = "z",
    unit: Annotated[str, typer.Option(help="Unit of lengths in .toml, .yml and .xml: m, cm or mm.")] = "m",
    output: Annotated[Path, typer.Option("--output", "-o", help="The calibration file.")] = Path(
        "cameras.yaml"
    ),
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for pictures of the board as found; default: beside the file.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the outcome as JSON.")] = False,
) -> None:
    """Calibrate cameras with a checkerboard or ChArUco board, or take over another program's calibration."""
    _check(output, force=force)
    axis = axis_of(up)
    if import_file is not None:
        found = load_cameras(import_file, axis, unit)
        _write(output, cameras_text(found))
        _tell(output, [_row(camera) for camera in found], as_json)
        return
    if board is None or not lenses:
        raise GatewayError("pictures (NAME=FOLDER for every camera) and --board are wanted, or --import FILE")
    result = _calibrated((board, scene_board or board), lenses, scene or [], every, is_shown=not as_json)
    folder = pictures or output.with_name(f"{output.stem}_boards")
    written = _draw(board, result, folder)
    text = cameras_text(result.cameras, result.placement.rms.tolist())
    _write(output, text.replace("up: z", f"up: {axis}", 1))
    _tell(output, _rows(result), as_json)
    if not as_json:
        typer.echo(f"{folder}: {written} pictures with the corners found (green) and expected (red)")


def _check(output: Path, *, force: bool) -> None:
    """Raises ``GatewayError`` for what can be told before any picture is read."""
    require_video_extra()
    if output.exists() and not force:
        raise GatewayError(f"{output} exists: name another file with --output, or replace it with --force")


def _calibrated(
    boards: tuple[str, str], lenses: Sequence[str], scene: Sequence[str], every: int, *, is_shown: bool
) -> CamerasResult:
    """boards: of the lens pictures and of the scene, as the command line has them; without a scene, the
    lens pictures are of common instants."""
    from gateway.calibration.boards import board_of  # noqa: PLC0415 - OpenCV is an extra
    from gateway.calibration.cameras_session import calibrate_cameras  # noqa: PLC0415

    board, scene_board = map(board_of, boards)
    lens_pictures = _looked_for(board, lenses, every, "lenses", is_shown=is_shown)
    scene_pictures = lens_pictures
    if scene:
        scene_pictures = _looked_for(scene_board, scene, every, "scene", is_shown=is_shown)
    return calibrate_cameras(board, lens_pictures, scene_board, scene_pictures)


def _draw(board: str, result: CamerasResult, folder: Path) -> int:
    from gateway.calibration.boards import board_of  # noqa: PLC0415 - OpenCV is an extra
    from gateway.calibration.cameras_session import write_board_pictures  # noqa: PLC0415

    try:
        return write_board_pictures(board_of(board), result, folder)
    except OSError as error:
        raise GatewayError(f"{folder} cannot be written: {error.strerror}") from error


def _looked_for(
    board: Board, texts: Sequence[str], every: int, what: str, *, is_shown: bool
) -> dict[str, list[BoardPicture]]:
    from gateway.calibration.cameras_session import board_pictures  # noqa: PLC0415 - OpenCV is an extra

    found = {}
    for text in texts:
        name, separator, place = text.partition("=")
        if not separator or not name or not place:
            raise GatewayError(f"'{text}': NAME=PICTURES is wanted, such as cam01=pictures/cam01")
        if name in found:
            raise GatewayError(f"camera '{name}' is given twice")
        with progress_bar(f"{what}: {name}", is_shown=is_shown) as tell:
            found[name] = board_pictures(board, place, every, tell)
    return found


def _rows(result: CamerasResult) -> list[dict[str, Any]]:
    rows = []
    for c, (camera, lens) in enumerate(zip(result.cameras, result.lenses, strict=True)):
        looked = result.lens_pictures[c]
        rows.append(
            {
                **_row(camera),
                "board_found": sum(each.view is not None for each in looked),
                "pictures": len(looked),
                "lens_rms_px": round(lens.rms, 3),
                "scene_rms_px": round(float(result.placement.rms[c]), 3),
                "warning": lens.warning,
            }
        )
    return rows


def _row(camera: Camera) -> dict[str, Any]:
    return {
        "camera": camera.name,
        "size": [camera.width, camera.height],
        "focal_px": round(float(camera.matrix[0, 0]), 1),
        "position_m": [round(float(each), 3) for each in camera.position],
    }


def _write(output: Path, text: str) -> None:
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise GatewayError(f"{output} cannot be written: {error.strerror}") from error


def _tell(output: Path, rows: list[dict[str, Any]], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"file": str(output), "cameras": rows}, indent=2))
        return
    keys = [key for key in rows[0] if key != "warning"]
    table = Table(*(key.replace("_", " ") for key in keys))
    for row in rows:
        table.add_row(*(str(row[key]) for key in keys))
    Console().print(table)
    for row in rows:
        if row.get("warning"):
            typer.echo(f"note: camera '{row['camera']}': {row['warning']}", err=True)
    typer.echo(f"{output}: {len(rows)} cameras")
