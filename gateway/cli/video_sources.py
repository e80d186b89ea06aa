"""Files, folders and devices on the command line, matched to calibrated cameras."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from devices.cameras.pictures import open_pictures
from gateway.body.camera import Camera
from gateway.calibration.cameras_file import AXES, axis_of, load_cameras
from gateway.calibration.picture_size import SizeChange, fitted
from gateway.cameras.camera_process import MOST_PEOPLE, CameraTask
from gateway.errors import GatewayError
from gateway.reconstruction.video.networks.weights import DETECTOR, weights_of

Places = Annotated[
    list[str],
    typer.Argument(
        metavar="FILES…",
        help="One a camera: video, folder of images, or v4l:///dev/video0; NAME=… says which camera it is.",
    ),
]
Cameras = Annotated[
    Path,
    typer.Option("--cameras", help="Calibration: of `calibrate cameras`, .qca.txt, .toml, .yml or .xml."),
]
Network = Annotated[str, typer.Option(help="Pose network: full, lite, heavy or openpose.")]
Offset = Annotated[
    list[str] | None,
    typer.Option(metavar="CAMERA=PICTURES", help="Pictures at the start of a camera that are left out."),
]
Sizes = Annotated[
    SizeChange, typer.Option(help="What was done to pictures that are not of the calibrated size.")
]
Up = Annotated[str | None, typer.Option(help=f"Axis of the calibration that points up: {', '.join(AXES)}.")]
Unit = Annotated[str, typer.Option(help="Unit of lengths in .toml, .yml and .xml calibrations: m, cm or mm.")]
People = Annotated[
    str,
    typer.Option(metavar="N|all", help="People to follow, one recording each; all: whom two cameras see."),
]
Join = Annotated[
    list[str] | None,
    typer.Option(
        metavar="CAMERA+CAMERA",
        help="Two cameras side by side, put together where somebody is partly in either picture.",
    ),
]
Rate = Annotated[float | None, typer.Option(min=1, help="Pictures a second of folders of images.")]


def matched(
    places: Sequence[str],
    calibration: Path,
    network: str,
    *,
    offsets: Sequence[str] = (),
    sizes: SizeChange = SizeChange.NONE,
    up: str | None = None,
    unit: str = "m",
    rate_hz: float | None = None,
) -> tuple[tuple[Camera, ...], tuple[CameraTask, ...]]:
    """The cameras of the places, made to fit their pictures, and what their processes are to do.

    A place belongs to the camera that is named before its ``=``, else to the one whose name stands in the
    file's own, else to the next in order. Raises ``GatewayError`` and ``CameraError``.
    """
    axis = None if up is None else axis_of(up)
    known = {camera.name: camera for camera in load_cameras(calibration, axis, unit)}
    for weights in (weights_of(network), DETECTOR):
        weights.verified_path()
    by_name = named(places, list(known), calibration)
    skipped = offsets_of(offsets, list(known))
    cameras, tasks = [], []
    for name, place in by_name.items():
        source = open_pictures(place, rate_hz)
        source.close()
        try:
            cameras.append(fitted(known[name], source.info.width, source.info.height, sizes))
        except GatewayError as error:
            raise GatewayError(f"{place}: {error}") from error
        tasks.append(CameraTask(name, place, network, rate_hz, skipped.get(name, 0)))
    return tuple(cameras), tuple(tasks)


def named(places: Sequence[str], known: list[str], calibration: Path) -> dict[str, str]:
    """Place by camera, in the order of ``known``; raises as ``matched`` does."""
    if len(places) > len(known):
        raise GatewayError(f"{len(places)} cameras are given, and {calibration} holds {len(known)}")
    told: dict[str, str] = {}
    for place in places:
        name, separator, rest = place.partition("=")
        if separator and name in known:
            found, path = [name], rest
        else:
            path = place
            found = [each for each in known if _speaks_of(Path(path), each)]
        if len(found) != 1 or found[0] in told:
            return _in_order(places, known, calibration)
        told[found[0]] = path
    return {name: told[name] for name in known if name in told}


def _in_order(places: Sequence[str], known: list[str], calibration: Path) -> dict[str, str]:
    if len(places) != len(known):
        raise GatewayError(
            f"the names of the files do not tell which cameras of {calibration} they are "
            f"({', '.join(known)}): write NAME=FILE"
        )
    return dict(zip(known, places, strict=True))


def _speaks_of(path: Path, name: str) -> bool:
    """Whether the camera's name stands in the file's as a word of its own."""
    return re.search(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", path.stem) is not None


def offsets_of(texts: Sequence[str], known: list[str]) -> dict[str, int]:
    """Pictures to leave out by camera. Raises ``GatewayError``."""
    offsets = {}
    for text in texts:
        name, _, number = text.partition("=")
        if name not in known or not number.isdigit():
            raise GatewayError(
                f"--offset {text}: CAMERA=PICTURES is wanted, such as {known[0]}=3 "
                f"(cameras: {', '.join(known)})"
            )
        offsets[name] = int(number)
    return offsets


def people_of(text: str) -> int | None:
    """How many people; None: all. Raises ``GatewayError``."""
    if text == "all":
        return None
    if not text.isdigit() or not 0 < int(text) <= MOST_PEOPLE:
        raise GatewayError(f"--people {text}: a number from 1 to {MOST_PEOPLE} is wanted, or all")
    return int(text)


def joined_of(texts: Sequence[str], cameras: Sequence[Camera]) -> tuple[tuple[int, int], ...]:
    """Pairs of cameras by their place in the order. Raises ``GatewayError``."""
    names = [camera.name for camera in cameras]
    pairs = []
    for text in texts:
        first, _, second = text.partition("+")
        if first not in names or second not in names or first == second:
            raise GatewayError(
                f"--join {text}: CAMERA+CAMERA is wanted, such as {names[0]}+{names[-1]} (cameras: "
                f"{', '.join(names)})"
            )
        pairs.append((names.index(first), names.index(second)))
    rows = [row for pair in pairs for row in pair]
    if len(set(rows)) < len(rows):
        raise GatewayError(f"--join {' --join '.join(texts)}: a camera has one neighbour at the most")
    return tuple(pairs)
