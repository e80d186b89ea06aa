"""Pictures of one camera: a video file, a folder of images, or a live capture device.

walk.mp4             a file that OpenCV (FFmpeg) reads
pictures/cam01       a folder of images, in the order of the numbers in their names
v4l:///dev/video0    a capture device of Linux (Video4Linux); v4l:///dev/video0?width=1280&height=720&fps=30
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from urllib.parse import parse_qsl, urlsplit

import numpy as np
from numpy.typing import NDArray

from devices.cameras.opencv import cv2
from devices.commands.device_errors import DeviceError
from devices.link import gateway_time_ns

Picture = NDArray[np.uint8]
"""(rows, columns, 3) blue, green, red."""
IMAGES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"})
LIVE = "v4l://"
_FOLDER_RATE_HZ = 60.0
_MAY_LACK = 2
"""Pictures by which a whole file may be shorter than it says: some formats only estimate their number."""
_MAY_BE_OFF = 1.5
"""Intervals by which a picture's own time may be off from its place in the file."""
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # FFmpeg's own complaints; ours are one line each


class CameraError(DeviceError):
    """A camera, or a file of one, gives no pictures; ``str(error)`` says what would help."""


@dataclass(frozen=True, slots=True)
class PictureInfo:
    """What a source says of itself before its first picture."""

    name: str
    width: int
    height: int
    rate_hz: float
    count: int | None
    """None: a live device, which has no end."""


class PictureSource(Protocol):
    """An opened camera."""

    info: PictureInfo

    def __iter__(self) -> Iterator[tuple[int, Picture]]:
        """Yield instants in ns since the first picture (live: gateway time), and pictures."""

    def close(self) -> None:
        """Let go of the file or device."""


def open_pictures(place: str, rate_hz: float | None = None) -> PictureSource:
    """Return the source at a place; ``rate_hz`` is for a folder of images. Raises ``CameraError``."""
    if place.startswith(LIVE):
        return LiveCamera(place)
    path = Path(place)
    if path.is_dir():
        return PictureFolder(path, rate_hz or _FOLDER_RATE_HZ)
    if not path.is_file():
        raise CameraError(f"{place}: no such video, folder of images or device (v4l:///dev/video0)")
    return VideoFile(path)


class VideoFile:
    """A video file. Raises ``CameraError`` for one that ends early or cannot be decoded."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._capture = cv2.VideoCapture(str(path))
        width, height = _size(self._capture)
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if not self._capture.isOpened() or width <= 0 or height <= 0:
            raise CameraError(f"{path}: {_why_unreadable(path)}")
        if not 0 < rate < 10_000 or count <= 0:
            raise CameraError(
                f"{path}: says {rate:g} pictures a second and {count} in all: copy it into a file with an "
                "index (MP4, MKV), or into a folder of images"
            )
        self.info = PictureInfo(path.stem, width, height, float(rate), count)

    def __iter__(self) -> Iterator[tuple[int, Picture]]:
        assert self.info.count is not None
        done, first_ms = 0, 0.0
        while True:
            is_read, picture = self._capture.read()
            if not is_read:
                break
            ms = float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
            # A video's time may begin anywhere: only what has passed since its first picture counts.
            first_ms = first_ms if done else ms
            self._check_time(done, 1e-3 * (ms - first_ms))
            yield round(done * 1e9 / self.info.rate_hz), picture.astype(np.uint8, copy=False)
            done += 1
        if done < self.info.count - _MAY_LACK:
            raise CameraError(
                f"{self._path}: picture {done + 1} of {self.info.count} cannot be decoded: the file is "
                "damaged or was cut off"
            )

    def _check_time(self, index: int, time_s: float) -> None:
        """Raise ``CameraError`` if a picture is not where its own time says; files without times give 0."""
        off = time_s * self.info.rate_hz - index
        if time_s > 0.0 and abs(off) > _MAY_BE_OFF:
            raise CameraError(
                f"{self._path}: picture {index + 1} is dated {abs(off):.1f} pictures too "
                f"{'late' if off > 0 else 'early'}: pictures before it are damaged, or the rate varies; "
                "convert the file to a constant rate"
            )

    def close(self) -> None:
        """Let go of the file."""
        self._capture.release()


class PictureFolder:
    """Images of one size, one a picture."""

    def __init__(self, folder: Path, rate_hz: float) -> None:
        self._files = image_files(folder)
        if not self._files:
            raise CameraError(f"{folder}: has no images ({', '.join(sorted(IMAGES))})")
        height, width = read_image(self._files[0]).shape[:2]
        self.info = PictureInfo(folder.name, width, height, rate_hz, len(self._files))

    def __iter__(self) -> Iterator[tuple[int, Picture]]:
        for index, file in enumerate(self._files):
            picture = read_image(file)
            if picture.shape[:2] != (self.info.height, self.info.width):
                raise CameraError(
                    f"{file}: is {picture.shape[1]}×{picture.shape[0]} pixels, "
                    f"the images before it {self.info.width}×{self.info.height}"
                )
            yield round(index * 1e9 / self.info.rate_hz), picture

    def close(self) -> None:
        """Do nothing: no file is held open."""


class LiveCamera:
    """A capture device; its pictures are stamped when they come."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        wanted = dict(parse_qsl(parts.query))
        unknown = sorted(set(wanted) - set(_LIVE_PROPERTIES))
        if unknown:
            raise CameraError(f"{url}: unknown parameter '{unknown[0]}' ({', '.join(_LIVE_PROPERTIES)})")
        self._url = url
        self._capture = cv2.VideoCapture(parts.path)
        if not self._capture.isOpened():
            raise CameraError(f"{parts.path}: is no camera that can be opened: is it there, free, permitted?")
        for key, text in wanted.items():
            if not text.isdigit():
                raise CameraError(f"{url}: {key}={text} is no whole number")
            self._capture.set(getattr(cv2, _LIVE_PROPERTIES[key]), int(text))
        # One picture at most may wait, as only the newest is of use.
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        width, height = _size(self._capture)
        rate = float(self._capture.get(cv2.CAP_PROP_FPS)) or 30.0
        self.info = PictureInfo(Path(parts.path).name, width, height, rate, None)

    def __iter__(self) -> Iterator[tuple[int, Picture]]:
        while True:
            is_read, picture = self._capture.read()
            if not is_read:
                raise CameraError(f"{self._url}: gives no more pictures: was it unplugged?")
            yield gateway_time_ns(), picture.astype(np.uint8, copy=False)

    def close(self) -> None:
        """Let go of the device."""
        self._capture.release()


_LIVE_PROPERTIES = {
    "width": "CAP_PROP_FRAME_WIDTH",
    "height": "CAP_PROP_FRAME_HEIGHT",
    "fps": "CAP_PROP_FPS",
}
"""By the name of OpenCV's constant."""


def _why_unreadable(path: Path) -> str:
    """Return what is wrong with an unreadable file, as far as can be seen."""
    boxes = _mp4_boxes(path)
    if not path.stat().st_size:
        return "is empty"
    if boxes[:1] == ["ftyp"] and "moov" not in boxes:
        return (
            "has no index (MP4 writes it at the end): the file was cut off, or its camera stopped before "
            "it was closed; copy it again, or repair it with the camera's own software"
        )
    return "is no video that can be read: is it whole, and a video at all?"


def _mp4_boxes(path: Path) -> list[str]:
    """Return the outermost boxes of an MP4 file, as far as they can be followed (ISO/IEC 14496-12, 4.2)."""
    names: list[str] = []
    with path.open("rb") as file:
        while len(head := file.read(8)) == 8:
            size, begun = int.from_bytes(head[:4], "big"), file.tell() - 8
            # A size of 1 says that the real one follows as 64 bits.
            if size == 1:
                size = int.from_bytes(file.read(8), "big")
            names.append(head[4:].decode("latin-1"))
            # 0 stands for all the rest of the file; any other below a head's size is damage.
            if size < 8:
                break
            file.seek(begun + size)
    return names


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder in the order of the numbers in their names."""
    found = [file for file in folder.iterdir() if file.suffix.lower() in IMAGES]
    return sorted(found, key=lambda file: [int(n) for n in re.findall(r"\d+", file.stem)] or [0])


def read_image(file: Path) -> Picture:
    """Return an image in colour. Raises ``CameraError``."""
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if picture is None:
        raise CameraError(f"{file}: is no image that can be read")
    return picture.astype(np.uint8, copy=False)


def _size(capture: cv2.VideoCapture) -> tuple[int, int]:
    return int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
