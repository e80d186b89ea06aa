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
from gateway.calibration.cameras_file import AXES, cameras_text, load_cameras
from gateway.cli.progress import progress_bar
from gateway.errors import GatewayError
from gateway.video_extra import require_video_extra

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
    require_video_extra()
    if output.exists() and not force:
        raise GatewayError(f"{output} exists: name another file with --output, or replace it with --force")
    if up not in AXES:
        raise GatewayError(f"--up {up}: one of {', '.join(AXES)} is wanted")
    if import_file is not None:
        found = load_cameras(import_file, up, unit)
        _write(output, cameras_text(found))
        _tell(output, [_row(camera) for camera in found], as_json)
        return
    if board is None or not lenses:
        raise GatewayError("pictures (NAME=FOLDER for every camera) and --board are wanted, or --import FILE")
    from gateway.calibration.boards import board_of  # noqa: PLC0415 - OpenCV is an extra
    from gateway.calibration.cameras_session import (  # noqa: PLC0415
        calibrate_cameras,
        write_board_pictures,
    )

    chosen = board_of(board)
    on_scene = chosen if scene_board is None else board_of(scene_board)
    lens_pictures = _looked_for(chosen, lenses, every, "lenses", is_shown=not as_json)
    scene_pictures = lens_pictures
    if scene:
        scene_pictures = _looked_for(on_scene, scene, every, "scene", is_shown=not as_json)
    result = calibrate_cameras(chosen, lens_pictures, on_scene, scene_pictures)
    folder = pictures or output.with_name(f"{output.stem}_boards")
    try:
        written = write_board_pictures(chosen, result, folder)
    except OSError as error:
        raise GatewayError(f"{folder} cannot be written: {error.strerror}") from error
    upright_text = cameras_text(result.cameras, result.placement.rms.tolist()).replace(
        "up: z", f"up: {up}", 1
    )
    _write(output, upright_text)
    _tell(output, _rows(result), as_json)
    if not as_json:
        typer.echo(f"{folder}: {written} pictures with the corners found (green) and expected (red)")


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
