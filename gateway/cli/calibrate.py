"""``mocap-gateway calibrate``: cameras and clocks; body and sensors have files of their own."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from devices.link import SUIT, Chunk, Link, gateway_time_ns
from devices.link_decoder import LinkDecoder
from devices.links.reconnect import kept_open
from devices.replay_link import framings_of
from gateway.body.camera import Camera
from gateway.calibration.cameras_file import AXES, Axis, axis_of, cameras_text, load_cameras
from gateway.cli.calibrate_body import body, put_back, versions
from gateway.cli.calibrate_sensors import sensors
from gateway.cli.options import AsJson, ReplaceFiles, refuse_absent_folder, refuse_existing
from gateway.cli.terminal import progress_bar
from gateway.clocks import ClockCalibration, ClockTable, LinkBatching, save_clock_table, warm_up
from gateway.clocks.table import MINUTE_S
from gateway.errors import GatewayError
from gateway.settings import GatewaySettings, load_gateway_settings
from gateway.support.extras import require_video_extra
from gateway.support.whole_files import write_whole, writing

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
        typer.Option(
            "--import", help="Instead of all that: a calibration of Qualisys, Pose2Sim, anipose or OpenCV."
        ),
    ] = None,
    up: Annotated[str, typer.Option(help=f"Axis of the world that points up: {', '.join(AXES)}.")] = "z",
    unit: Annotated[str, typer.Option(help="Unit of lengths in TOML and of OpenCV: m, cm or mm.")] = "m",
    output: Annotated[Path, typer.Option("--output", "-o", help="The calibration file.")] = Path(
        "cameras.yaml"
    ),
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for pictures of the board as found; default: beside the file.")
    ] = None,
    force: ReplaceFiles = False,
    as_json: AsJson = False,
) -> None:
    """Calibrate cameras with a checkerboard or ChArUco board, or take over another program's calibration."""
    _check_cameras(output, import_file, force=force)
    axis = axis_of(up)
    if import_file is not None:
        _take_over(import_file, axis, unit, output, as_json)
        return
    if board is None or not lenses:
        raise GatewayError("pictures (NAME=FOLDER for every camera) and --board are wanted, or --import FILE")
    result = _calibrated((board, scene_board or board), lenses, scene or [], every, is_shown=not as_json)
    folder = pictures or output.with_name(f"{output.stem}_boards")
    written = _draw_boards(board, result, folder)
    text = cameras_text(result.cameras, result.placement.rms.tolist())
    _write_cameras(output, text.replace("up: z", f"up: {axis}", 1))
    _print_cameras(output, _camera_rows(result), as_json)
    if not as_json:
        typer.echo(f"{folder}: {written} pictures with the corners found (green) and expected (red)")


def _take_over(file: Path, axis: Axis, unit: str, output: Path, as_json: bool) -> None:
    """Write another program's calibration as ours, and print its cameras."""
    found = load_cameras(file, axis, unit)
    _write_cameras(output, cameras_text(found))
    _print_cameras(output, [_camera_row(camera) for camera in found], as_json)


def _check_cameras(output: Path, import_file: Path | None, *, force: bool) -> None:
    """Raise ``GatewayError`` for what can be found before any picture is read."""
    require_video_extra()
    refuse_absent_folder(output)
    refuse_existing(output, force, source=import_file)


def _calibrated(
    boards: tuple[str, str], lenses: Sequence[str], scene: Sequence[str], every: int, *, is_shown: bool
) -> CamerasResult:
    """Return calibrated cameras.

    boards: of the lens pictures and of the scene, as the command line has them.
    scene: empty where the lens pictures are of common instants.
    """
    from gateway.calibration.boards import board_of
    from gateway.calibration.cameras_session import calibrate_cameras

    board, scene_board = map(board_of, boards)
    lens_pictures = _looked_for(board, lenses, every, "lenses", is_shown=is_shown)
    # Without pictures of a scene those of the lenses place the cameras, too.
    scene_pictures = lens_pictures
    if scene:
        scene_pictures = _looked_for(scene_board, scene, every, "scene", is_shown=is_shown)
    return calibrate_cameras(board, lens_pictures, scene_board, scene_pictures)


def _draw_boards(board: str, result: CamerasResult, folder: Path) -> int:
    from gateway.calibration.boards import board_of
    from gateway.calibration.cameras_session import write_board_pictures

    with writing(folder):
        return write_board_pictures(board_of(board), result, folder)


def _looked_for(
    board: Board, texts: Sequence[str], every: int, what: str, *, is_shown: bool
) -> dict[str, list[BoardPicture]]:
    from gateway.calibration.cameras_session import board_pictures

    found = {}
    for text in texts:
        name, separator, place = text.partition("=")
        if not separator or not name or not place:
            raise GatewayError(f"'{text}': NAME=PICTURES is wanted, such as cam01=pictures/cam01")
        if name in found:
            raise GatewayError(f"camera '{name}' is given twice")
        with progress_bar(f"{what}: {name}", is_shown=is_shown) as progress:
            found[name] = board_pictures(board, place, every, progress)
    return found


def _camera_rows(result: CamerasResult) -> list[dict[str, Any]]:
    rows = []
    for c, (camera, lens) in enumerate(zip(result.cameras, result.lenses, strict=True)):
        looked = result.lens_pictures[c]
        rows.append(
            {
                **_camera_row(camera),
                "board_found": sum(each.view is not None for each in looked),
                "pictures": len(looked),
                "lens_rms_px": round(lens.rms, 3),
                "scene_rms_px": round(float(result.placement.rms[c]), 3),
                "warning": lens.warning,
            }
        )
    return rows


def _camera_row(camera: Camera) -> dict[str, Any]:
    return {
        "camera": camera.name,
        "size": [camera.width, camera.height],
        "focal_px": round(float(camera.matrix[0, 0]), 1),
        "position_m": [round(float(each), 3) for each in camera.position],
    }


def _write_cameras(output: Path, text: str) -> None:
    with writing(output):
        write_whole(output, text.encode())


def _print_cameras(output: Path, rows: list[dict[str, Any]], as_json: bool) -> None:
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


_SILENT_S = 10.0


def clocks(
    config: Annotated[
        Path, typer.Option("--config", "-c", help="Configuration file: its links and rig.")
    ] = Path("config/gateway.yaml"),
    minutes: Annotated[int, typer.Option(min=1, max=240, help="Minutes in the table: k = 1 to this.")] = 60,
    repetitions: Annotated[int, typer.Option(min=1, max=100, help="Measure so often, and average.")] = 1,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="File to write [<rig>.clocks.yaml beside the config]"),
    ] = None,
    force: ReplaceFiles = False,
    minute_s: Annotated[float, typer.Option(min=0.5, max=60, hidden=True)] = MINUTE_S,
    settling_s: Annotated[float, typer.Option(min=0, hidden=True)] = 15.0,
) -> None:
    """Rank the modules by their crystals and measure their rates against the slowest one's, minute by minute.

    Switch all modules of the rig on, let them lie as warm as they will be worn, and wait. The table is then
    used by `clock: {mode: table, table: <file>}`.
    """
    from gateway.body.rig import load_rig

    settings = load_gateway_settings(config)
    suit = load_rig(settings.rig, config)
    target = output or config.parent / f"{Path(settings.rig).stem}.clocks.yaml"
    refuse_absent_folder(target)
    refuse_existing(target, force)
    # Compiled beforehand: a kernel compiled while samples wait would delay their arrival times.
    warm_up()
    calibration = ClockCalibration(suit.module_ids, minutes, repetitions, minute_s, settling_s)
    with contextlib.suppress(asyncio.CancelledError):
        asyncio.run(_measure_clocks(settings, calibration))
    table = calibration.table()
    save_clock_table(table, target)
    console = Console()
    console.print(_clock_table(table))
    console.print(f"written to {target}", soft_wrap=True, markup=False)


async def _measure_clocks(settings: GatewaySettings, calibration: ClockCalibration) -> None:
    """Listen on all links until the calibration has had its time, or until every link has come to its end."""
    from devices.endpoints import link_from_url

    links = [link_from_url(link.url, name=link.name) for link in settings.links if link.carries == SUIT]
    if not links:
        raise GatewayError(
            "no link carries modules of our own, which alone have clock tables: rates of others "
            "are estimated while the gateway runs"
        )
    tasks = [asyncio.create_task(_listen(kept_open(link), calibration)) for link in links]

    begin_ns = gateway_time_ns()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    try:
        with Progress(*columns, transient=True) as progress:
            bar = progress.add_task("measuring clocks", total=calibration.duration_s)
            while not calibration.is_complete and not all(task.done() for task in tasks):
                await asyncio.wait(tasks, timeout=0.2, return_when=asyncio.ALL_COMPLETED)
                progress.update(bar, completed=calibration.elapsed_s)
                if not calibration.received and gateway_time_ns() - begin_ns > _SILENT_S * 1e9:
                    raise GatewayError(
                        f"no module of the rig was heard for {_SILENT_S:.0f} s: are they switched on, "
                        "and is the link right?"
                    )
    # Links must be closed before the result is looked at, also after an error.
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, Exception):
            raise result


async def _listen(link: Link, calibration: ClockCalibration) -> None:
    await link.open()
    decoders = {name: LinkDecoder(framing) for name, framing in framings_of(link).items()}
    batchings = {name: LinkBatching() for name in decoders}
    try:
        async for chunk in link:
            if not isinstance(chunk, Chunk) or chunk.link not in decoders:
                continue
            batching, decoder = batchings[chunk.link], decoders[chunk.link]
            # Strangers' bytes say nothing of how the link hands its chunks over.
            packets = decoder.feed(chunk)
            if decoder.is_trusted:
                batching.observe(chunk.arrived_ns)
            for packet in packets:
                calibration.observe(packet.module, packet.module_time_us, chunk.arrived_ns, batching)
            if calibration.is_complete:
                break
    finally:
        await link.close()


def _clock_table(table: ClockTable) -> Table:
    shown = Table("rank", "module", "ppm against the slowest", "α of the first minute", "α of the last")
    for rank, module in enumerate(table.ranking, start=1):
        alpha = table.alpha[module]
        shown.add_row(
            str(rank), str(module), f"{table.skew_ppm(module):+.2f}", f"{alpha[0]:.9f}", f"{alpha[-1]:.9f}"
        )
    return shown


calibrate_app = typer.Typer(
    help="Measure what has to be known before a capture.",
    epilog="Examples: mocap-gateway calibrate sensors -c my.yaml; mocap-gateway calibrate body -c my.yaml",
    no_args_is_help=True,
)
calibrate_app.command(epilog="Example: mocap-gateway calibrate clocks -c config/gateway.yaml --minutes 60")(
    clocks
)
calibrate_app.command(
    epilog="Example: mocap-gateway calibrate sensors --link /dev/ttyUSB0 --rig suit_17 -o mine.yaml"
)(sensors)
calibrate_app.command(
    epilog="Examples: mocap-gateway calibrate body -c my.yaml; "
    "mocap-gateway calibrate body --link /tmp/suit --rig suit_17 --emulated -o mine.yaml"
)(body)
calibrate_app.command(
    epilog="Examples: mocap-gateway calibrate cameras --import Calib.qca.txt -o cameras.yaml; "
    "mocap-gateway calibrate cameras left=lens/left right=lens/right --scene left=floor_left.png "
    "--scene right=floor_right.png --board checkerboard:7x4:0.06"
)(cameras)
calibrate_app.command("history", epilog="Example: mocap-gateway calibrate history mine.yaml")(versions)
calibrate_app.command("restore", epilog="Example: mocap-gateway calibrate restore mine.yaml")(put_back)
