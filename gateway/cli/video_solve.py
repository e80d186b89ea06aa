"""``mocap-gateway video solve``: synchronised videos to a skeleton in a recording."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from devices.cameras.keypoint_files import is_keypoints
from devices.recording_writer import refuse_other_name
from gateway.body.camera import Camera
from gateway.body.skeleton import VideoSetUp, WornSuit
from gateway.calibration.cameras_file import axis_of, load_cameras
from gateway.calibration.picture_size import SizeChange
from gateway.cameras.camera_process import CameraTask
from gateway.cli.export import export
from gateway.cli.options import AsJson, ReplaceFiles, refuse_existing, with_options
from gateway.cli.terminal import progress_bar
from gateway.cli.video import (
    Cameras,
    Pictures,
    Places,
    joined_of,
    matched,
    named,
    offsets_of,
    people_of,
)
from gateway.errors import GatewayError
from gateway.reconstruction.video.networks.person_detector import MOST_PEOPLE
from gateway.recording.exporters.formats import FORMATS, check_formats
from gateway.support.extras import require_video_extra
from gateway.support.whole_files import writing

if TYPE_CHECKING:
    from gateway.cameras.consistency import Consistency
    from gateway.cameras.filmed_people import Instants
    from gateway.cameras.rig_of_cameras import RigOptions
    from gateway.recording.video import SolvedVideo


_TABLES = (".csv", ".h5", ".slp", ".pkl", ".npz")
"""What DeepLabCut, SLEAP and others write keypoints into, under names of the user's own."""


class Capture(NamedTuple):
    """What the cameras saw."""

    video: VideoSetUp
    """The cameras, and which keypoints there are: those of a network, or the set of another program."""
    people: list[Instants]
    rate_hz: float


_ENDS_DIFFER = 2
"""Pictures by which cameras may end earlier than others without a word."""


@dataclass(frozen=True)
class Choice:
    """The options that say who and what of the pictures is taken."""

    people: Annotated[
        str,
        typer.Option(
            metavar="N|all", help="People to follow, one recording each; all: whom two cameras see."
        ),
    ] = "1"
    join: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CAMERA+CAMERA",
            help="Two cameras side by side, put together where somebody is partly in either picture.",
        ),
    ] = None
    synchronise: Annotated[
        bool, typer.Option("--synchronise", help="Shift cameras that are out of step by what is found.")
    ] = False
    frames: Annotated[int | None, typer.Option(min=1, help="Instants to take; a live camera needs it.")] = (
        None
    )
    unequal: Annotated[
        bool, typer.Option("--unequal", help="Take the common pictures of files that differ in length.")
    ] = False


@with_options(Choice, Pictures)
def solve(
    choice: Choice,
    pictures: Pictures,
    files: Places,
    cameras: Cameras,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The recording; default: after the first file, .mcap."),
    ] = None,
    to: Annotated[
        list[str] | None, typer.Option(metavar="FORMAT", help=f"Export too: {', '.join(FORMATS)}.")
    ] = None,
    offline: Annotated[
        bool,
        typer.Option(
            "--offline", help="Track forwards and backwards: what was hidden comes from later ones."
        ),
    ] = False,
    subject: Annotated[
        Path | None,
        typer.Option("--subject", "-s", help="The person's lengths from a file of --fit-subject."),
    ] = None,
    fit_subject: Annotated[
        Path | None,
        typer.Option(help="Write the person and the cameras into a file: a gateway's rig, or --subject."),
    ] = None,
    force: ReplaceFiles = False,
    as_json: AsJson = False,
) -> None:
    """Solve synchronised videos of calibrated cameras, into a recording that replays, exports and reports
    like any other.

    In the place of videos, keypoints that another program found: a folder of JSON a camera (OpenPose,
    RTMPose of Pose2Sim), or one file a camera of AlphaPose, MMPose or COCO's results; with --rate.
    """
    from gateway.body.rig import load_rig
    from gateway.recording.video import video_suit

    wanted = people_of(choice.people)
    _refuse_several(subject, wanted)
    target = _target(files, output, to or [])
    _places(target, wanted or 1, force=force)
    capture = _captured(files, cameras, pictures, choice, is_shown=not as_json)
    people_seen, checks = _sorted_out(capture, choice, cameras)
    known = None if subject is None else load_rig(str(subject))
    outcomes = []
    places = _people(people_seen, target, fit_subject, force=force)
    for (messages, place, person), checked in zip(places, checks, strict=True):
        suit = video_suit(capture.video.cameras, capture.video.network, messages, known)
        suit = replace(suit, video=capture.video)
        if person is not None:
            _write_subject(person, suit, force=force)
        done = _written(messages, capture.rate_hz, suit, place, offline=offline, is_shown=not as_json)
        outcomes.append(_outcome(done, checked, len(capture.video.cameras)))
        if not as_json:
            _print_outcome(outcomes[-1])
        if to:
            export(place, to=to, force=force)  # type: ignore[arg-type]  # names of formats, checked above
    if as_json:
        typer.echo(json.dumps(outcomes if wanted != 1 else outcomes[0], indent=2))


def _refuse_several(subject: Path | None, wanted: int | None) -> None:
    """Raise ``GatewayError`` for one person's lengths and several people. wanted: None: all."""
    if subject is not None and wanted != 1:
        raise GatewayError(
            "--subject is one person's, --people of more measures everybody: leave one of them out"
        )


def _captured(
    files: Sequence[str], calibration: Path, pictures: Pictures, choice: Choice, *, is_shown: bool
) -> Capture:
    """Return what the cameras saw, by our own network or by another program."""
    from gateway.cameras.rig_of_cameras import RigOptions

    wanted = people_of(choice.people)
    if _are_keypoints(files):
        if choice.join:
            raise GatewayError("--join puts pictures together: keypoints of other programs have none")
        return _imported(files, calibration, pictures, wanted, choice.frames)
    require_video_extra()
    cameras, tasks = matched(files, calibration, pictures)
    video = VideoSetUp(cameras, pictures.network, joined_of(choice.join or [], cameras))
    options = RigOptions(not choice.unequal, wanted or MOST_PEOPLE)
    return Capture(video, *looked_at(video, tasks, choice.frames, options, is_shown=is_shown))


def _sorted_out(
    capture: Capture, choice: Choice, calibration: Path
) -> tuple[Sequence[Instants], list[Consistency]]:
    """Return the people of a capture, with the cameras brought into step where that is asked, and how well
    the cameras agree upon each.

    Whoever is seen the most tells whether the calibration is right and the cameras are in step, for all:
    somebody who is half hidden may seem to tell otherwise. Raises ``GatewayError`` where they are not.
    """
    from gateway.cameras.consistency import consistency_of, views

    people, cameras = capture.people, capture.video.cameras
    _report_how_many(len(people), people_of(choice.people))
    if len(cameras) < 2:
        typer.echo("note: one camera tells no depth: it follows from the floor (height 0), roughly", err=True)
    clearest = max(range(len(people)), key=lambda k: views(people[k]))
    if choice.synchronise:
        people = _in_step(cameras, people, clearest)
    checks = [consistency_of(cameras, messages) for messages in people]
    checks[clearest].refuse_wrong(calibration)
    for doubt in checks[clearest].doubts():
        typer.echo(f"note: {doubt}", err=True)
    return people, checks


def _are_keypoints(files: Sequence[str]) -> bool:
    """Return whether keypoints of another program are given in the place of pictures. Raises
    ``GatewayError`` where some are and some are not."""
    places = [each.rpartition("=")[2] for each in files]
    for place in places:
        if Path(place).suffix.lower() in _TABLES:
            raise GatewayError(
                f"{place}: keypoints are read as JSON of OpenPose's, COCO's or MMPose's kind: convert them "
                "(Pose2Sim's DLC_H5_to_OpenPose does DeepLabCut's), or give the films"
            )
    others = [place for place in places if not is_keypoints(place)]
    if others and len(others) < len(places):
        raise GatewayError(
            f"{others[0]}: has no keypoints (a .json, or a folder with such files), the other cameras have"
        )
    return not others


def _in_step(cameras: Sequence[Camera], captured: Sequence[Instants], clearest: int) -> list[Instants]:
    """Leave pictures out at the start of cameras that began earlier, as one person tells, for all."""
    from gateway.cameras.consistency import consistency_of, in_step

    checked = consistency_of(cameras, captured[clearest])
    if not checked.offsets:
        return list(captured)
    listed = ", ".join(f"{name} {late}" for name, late in zip(checked.names, checked.skipped, strict=True))
    typer.echo(f"note: pictures left out so that the cameras are in step: {listed}", err=True)
    return [in_step(messages, checked.skipped) for messages in captured]


def _imported(
    files: Sequence[str], calibration: Path, pictures: Pictures, wanted: int | None, frames: int | None
) -> Capture:
    """Return keypoints that another program found."""
    from devices.cameras.keypoint_files import read_keypoints
    from gateway.cameras.imported_keypoints import keypoint_messages

    if pictures.rate is None:
        raise GatewayError(
            "keypoints do not tell when pictures were taken: say how many a second with --rate"
        )
    if pictures.sizes is not SizeChange.NONE:
        raise GatewayError(
            f"--sizes {pictures.sizes}: keypoints do not tell the size of their pictures: give a calibration "
            "for pictures of that size"
        )
    axis = None if pictures.up is None else axis_of(pictures.up)
    known = {camera.name: camera for camera in load_cameras(calibration, axis, pictures.unit)}
    places = named(files, list(known), calibration)
    cameras = tuple(known[name] for name in places)
    read = [read_keypoints(Path(place)) for place in places.values()]
    _report_ends({name: each.first + len(each.people) for name, each in zip(places, read, strict=True)})
    skipped = offsets_of(pictures.offset or [], list(known))
    network, captured = keypoint_messages(cameras, read, skipped, pictures.rate, wanted or MOST_PEOPLE)
    return Capture(VideoSetUp(cameras, network), [each[:frames] for each in captured], pictures.rate)


def _report_ends(ends: dict[str, int]) -> None:
    """Say which cameras' last pictures are missing; ends: by camera the number after the last one's."""
    early = [f"{name} at {end}" for name, end in ends.items() if end < max(ends.values()) - _ENDS_DIFFER]
    if early:
        typer.echo(
            f"note: pictures end earlier than the others' at {max(ends.values())}: {', '.join(early)}; from "
            "there on nobody is taken to be in them",
            err=True,
        )


def _report_how_many(found: int, wanted: int | None) -> None:
    """Say where fewer people were found than asked for. Raises ``GatewayError`` where nobody was."""
    if not found:
        raise GatewayError(
            "nobody was found by rays of two cameras that meet, for 20 pictures: does the calibration belong "
            "to these cameras, in this order, and are they synchronised?"
        )
    if wanted is not None and found != wanted:
        typer.echo(f"note: {found} recordings: so many came before the cameras, not {wanted}", err=True)


def _people(
    captured: Sequence[Instants], target: Path, subject: Path | None, *, force: bool
) -> Iterator[tuple[Instants, Path, Path | None]]:
    """Yield what is seen of each, and where recording and person go. Raises ``GatewayError`` where they may
    not."""
    places = _places(target, len(captured), force=force)
    people = [None] * len(captured) if subject is None else _named(subject, len(captured))
    yield from zip(captured, places, people, strict=True)


def _places(target: Path, n: int, *, force: bool) -> list[Path]:
    """Return the places of n recordings. Raises ``GatewayError`` where one stands in the way."""
    places = _named(target, n)
    for place in places:
        refuse_existing(place, force)
    return places


def _named(path: Path, n: int) -> list[Path]:
    """Return n files beside ``path``, numbered; the path itself for one."""
    return [path] if n == 1 else [path.with_stem(f"{path.stem}_{k + 1}") for k in range(n)]


def _target(files: Sequence[str], output: Path | None, to: Sequence[str]) -> Path:
    """Return where the recording goes. Raises ``GatewayError`` when a format is unknown, and as
    ``refuse_other_name``."""
    check_formats(to)
    first = Path(files[0].rpartition("=")[2])
    if not first.name:
        raise GatewayError(f"'{files[0]}' names no film: write FILE or CAMERA=FILE")
    target = output or first.with_suffix(".mcap")
    refuse_other_name(target)
    return target


def _written(
    messages: Sequence[Sequence[bytes]],
    rate_hz: float,
    suit: WornSuit,
    target: Path,
    *,
    offline: bool,
    is_shown: bool,
) -> SolvedVideo:
    """Return the recording, in the place of an older one."""
    from gateway.recording.video import write_offline_video, write_solved_video

    target.unlink(missing_ok=True)
    write = write_offline_video if offline else write_solved_video
    with progress_bar("solving", is_shown=is_shown) as progress, writing(target):
        return write(messages, rate_hz, suit, target.stem, target, progress)


def _write_subject(path: Path, suit: WornSuit, *, force: bool) -> None:
    from gateway.body.subject_file import write_subject
    from gateway.recording.video import video_subject

    refuse_existing(path, force, "--fit-subject")
    with writing(path):
        write_subject(path, video_subject(path.stem, suit))


def looked_at(
    video: VideoSetUp,
    tasks: Sequence[CameraTask],
    frames: int | None,
    options: RigOptions,
    *,
    is_shown: bool = True,
) -> tuple[list[Instants], float]:
    """Return by person the heat maps of every instant, a message a camera; and the rate in Hz."""
    from gateway.cameras.filmed_people import FilmedPeople
    from gateway.cameras.rig_of_cameras import CameraRig

    with (
        progress_bar("looking at pictures", is_shown=is_shown) as progress,
        CameraRig(video, tasks, options) as rig,
    ):
        if rig.count is None and frames is None:
            raise GatewayError("a live camera has no end: say with --frames how many pictures to take")
        total = min(each for each in (rig.count, frames) if each is not None)
        filmed = FilmedPeople(video, rig.rate_hz)
        for done, instant in enumerate(itertools.islice(rig, total), start=1):
            filmed.add(instant)
            progress(done, total)
        return filmed.people, rig.rate_hz


def _outcome(done: SolvedVideo, checked: Consistency, n_cameras: int) -> dict[str, Any]:
    return {
        "file": str(done.path),
        "frames": done.frames,
        "ms_per_frame": round(done.ms_per_frame, 2),
        "counts": done.counts,
        "rays_apart_mm": {name: round(1e3 * value, 1) for name, value in checked.apart.items()},
        "keypoints": _keypoint_figures(done, n_cameras),
    }


def _print_outcome(outcome: dict[str, Any]) -> None:
    if outcome["keypoints"]:
        table = Table("keypoint", "tracked %", "mean likelihood a camera")
        for name, each in outcome["keypoints"].items():
            table.add_row(name, f"{each['tracked_percent']:.0f}", f"{each['likelihood']:.2f}")
        Console().print(table)
    apart = ", ".join(f"{name} {mm:.0f}" for name, mm in outcome["rays_apart_mm"].items())
    if apart:
        typer.echo(f"rays of a camera pass those of the others at (median, mm): {apart}")
    typer.echo(
        f"{outcome['file']}: {outcome['frames']} frames, {outcome['ms_per_frame']:.1f} ms a frame after the "
        "heat maps"
    )


def _keypoint_figures(done: SolvedVideo, n_cameras: int) -> dict[str, dict[str, float]]:
    """Return figures by keypoint, of the instants in which the person was there; none of an offline solution,
    whose poses are not followed one by one."""
    poses = [pose for pose in done.poses if np.isfinite(pose.keypoints).all()]
    if not poses:
        return {}
    lost = np.array([pose.tracking != 0 for pose in poses])
    likelihood = np.array([pose.likelihood for pose in poses]) / n_cameras
    return {
        name: {
            "tracked_percent": round(100 * float(1 - lost[:, k].mean()), 1),
            "likelihood": round(float(likelihood[:, k].mean()), 2),
        }
        for k, name in enumerate(done.keypoints)
    }
