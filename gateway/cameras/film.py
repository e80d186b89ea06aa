"""A recording of cameras drawn back onto its pictures, instant by instant, into a film or single images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from devices.cameras.heat_map_messages import HeatMapMessage, HeatMapReceiver
from devices.cameras.opencv import cv2
from devices.cameras.pictures import CameraError, Picture
from gateway.body.skeleton import Skeleton, VideoSetUp
from gateway.cameras.overlay import draw_heat_maps, draw_skeleton, side_by_side
from gateway.frames import SkeletonFrame
from gateway.recording.reading import Recording
from gateway.sources.heat_maps import heat_maps_of

FILM = ".mp4"


def drawn_instants(
    recording: Recording,
    video: VideoSetUp,
    pictures: Iterable[Sequence[Picture]],
    *,
    height: int,
    every: int = 1,
    has_maps: bool = True,
) -> Iterator[Picture]:
    """Yield the pictures of all cameras in a row, ``height`` pixels high, with what the recording has of
    them, its name, which tells the person, and the number of the picture.

    pictures: of every instant, in the order of the cameras.
    """
    frames = {frame.sequence: frame for frame in recording.skeleton_frames()}
    messages = _messages(recording) if has_maps else {}
    names = [camera.name for camera in video.cameras]
    for sequence, row in enumerate(pictures):
        if sequence % every:
            continue
        drawn = [
            _drawn(
                picture,
                video,
                c,
                recording.meta.skeleton,
                frames.get(sequence),
                messages.get((names[c], sequence)),
            )
            for c, picture in enumerate(row)
        ]
        yield side_by_side(drawn, names, height, f"{recording.meta.path.stem}  picture {sequence}")


def _drawn(
    picture: Picture,
    video: VideoSetUp,
    row: int,
    skeleton: Skeleton,
    frame: SkeletonFrame | None,
    message: HeatMapMessage | None,
) -> Picture:
    maps = heat_maps_of(message)
    drawn = picture.copy() if maps is None else draw_heat_maps(picture, maps)
    if frame is not None:
        draw_skeleton(drawn, video.cameras[row], skeleton, frame)
    return drawn


def _messages(recording: Recording) -> dict[tuple[str, int], HeatMapMessage]:
    receiver = HeatMapReceiver()
    return {
        (message.camera, message.sequence): message
        for chunk in recording.chunks()
        for message in receiver.receive(chunk.data)
    }


def write_film(
    pictures: Iterable[Picture], target: Path, rate_hz: float, progress: Callable[[int], None]
) -> int:
    """Write pictures as an .mp4, or as numbered images into a folder; return how many there were.

    Raises ``CameraError``, OSError as ``mkdir`` does.
    """
    done = 0
    if target.suffix.lower() != FILM:
        target.mkdir(parents=True, exist_ok=True)
        for done, picture in enumerate(pictures, start=1):
            file = target / f"{done:05}.png"
            if not cv2.imwrite(str(file), picture):
                raise CameraError(f"{file} cannot be written")
            progress(done)
        return done
    writer: cv2.VideoWriter | None = None
    try:
        for done, picture in enumerate(pictures, start=1):
            if writer is None:
                writer = _film(target, rate_hz, picture)
            writer.write(picture)
            progress(done)
    finally:
        if writer is not None:
            writer.release()
    return done


def _film(target: Path, rate_hz: float, picture: Picture) -> cv2.VideoWriter:
    size = picture.shape[1], picture.shape[0]
    writer = cv2.VideoWriter(str(target), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, size)
    if not writer.isOpened():
        raise CameraError(f"{target} cannot be written as a film of {size[0]}×{size[1]} pixels")
    return writer
