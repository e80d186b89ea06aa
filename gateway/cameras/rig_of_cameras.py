"""All cameras of a film, in step: processes started and checked against each other, people found and
followed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, Self, TypeVar

from devices.cameras.orders import encode_orders
from devices.cameras.pictures import CameraError, PictureInfo
from gateway.body.skeleton import VideoSetUp
from gateway.cameras.camera_process import CameraProcess, CameraTask
from gateway.cameras.live_crowd import AHEAD, CrowdInstant, LiveCrowd
from gateway.cameras.people_matching import person_in_common
from gateway.cameras.steering import Steering
from gateway.reconstruction.video.region import square_of

T = TypeVar("T")
_RATES_DIFFER = 0.002
_COUNTS_DIFFER = 2
"""Pictures by which synchronised files may differ in length."""


class Follows(Protocol):
    """Who the people are, and where the cameras are to look for them."""

    def take(self, messages: Sequence[bytes]) -> CrowdInstant:
        """Return what one instant brings: of every camera all that it tells of one picture."""


@dataclass(frozen=True)
class RigOptions:
    """What a capture is of."""

    must_agree: bool = True
    """Raise ``CameraError`` for files of different rates and lengths."""
    people: int = 1
    """To be followed at once. One is chosen in the first pictures, and kept to the end; several come and
    go."""


class CameraRig:
    """``with CameraRig(video, tasks) as rig: for instant in rig: …``"""

    def __init__(
        self, video: VideoSetUp, tasks: Sequence[CameraTask], options: RigOptions | None = None
    ) -> None:
        """Start a process for each camera, one for two whose pictures may be put together. video: with
        cameras calibrated for the pictures as they are; tasks: in the same order."""
        self._video, self._tasks = video, tasks
        self._options = options or RigOptions()
        paired = {row for pair in video.pairs for row in pair}
        alone = [(row,) for row in range(len(tasks)) if row not in paired]
        self._rows: list[tuple[int, ...]] = [*video.pairs, *alone]
        most = self._options.people
        self._processes = [CameraProcess([tasks[row] for row in rows], most) for rows in self._rows]
        self.people: Follows = (
            Steering(video) if self._options.people == 1 else LiveCrowd(video, self._options.people)
        )
        self._first = b""
        self.rate_hz = 0.0
        self.count: int | None = None
        """Pictures that every camera has; None: live."""

    def __enter__(self) -> Self:
        try:
            self._begin()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[CrowdInstant]:
        """Yield what every instant brings, until the first camera ends."""
        self._order(self._first)
        for _ in range(1, AHEAD):
            self._order(b"")
        while (messages := self._messages()) is not None:
            instant = self.people.take(messages)
            self._order(instant.orders)
            yield instant

    def close(self) -> None:
        """End all processes."""
        for process in self._processes:
            process.close()

    def _begin(self) -> None:
        infos = self._by_camera([process.infos() for process in self._processes])
        if self._options.must_agree:
            check_agreement(infos, self._tasks)
        self.rate_hz = infos[0].rate_hz
        counts = [info.count - task.skip for info, task in zip(infos, self._tasks, strict=True) if info.count]
        self.count = min(counts) if counts else None
        if self._options.people == 1:
            self._first = self._chosen()

    def _chosen(self) -> bytes:
        """Return orders for the first pictures: the one person whom most cameras agree upon."""
        seen = self._by_camera([process.people() for process in self._processes])
        regions = person_in_common(self._video.cameras, seen)
        squares = {
            camera.name: {} if region is None else {0: square_of(region)}
            for camera, region in zip(self._video.cameras, regions, strict=True)
        }
        return encode_orders(0, squares)

    def _order(self, orders: bytes) -> None:
        for process in self._processes:
            process.order(orders)

    def _messages(self) -> list[bytes] | None:
        """Return the next messages, by camera; None at the end."""
        answers = [process.messages() for process in self._processes]
        whole = [answer for answer in answers if answer is not None]
        if len(whole) < len(answers):
            return None
        return self._by_camera(whole)

    def _by_camera(self, answers: Sequence[Sequence[T]]) -> list[T]:
        """Return answers of processes as one list in the order of the cameras."""
        found = {
            row: each
            for rows, answer in zip(self._rows, answers, strict=True)
            for row, each in zip(rows, answer, strict=True)
        }
        return [found[row] for row in range(len(self._tasks))]


def check_agreement(infos: Sequence[PictureInfo], tasks: Sequence[CameraTask]) -> None:
    """Raise ``CameraError`` where rates or lengths show that the sources were not taken together."""
    first = infos[0]
    for info, task in zip(infos, tasks, strict=True):
        if abs(info.rate_hz - first.rate_hz) > _RATES_DIFFER * first.rate_hz:
            raise CameraError(
                f"camera '{tasks[0].name}' has {first.rate_hz:g} pictures a second and camera '{task.name}' "
                f"{info.rate_hz:g}: the cameras must be synchronised; convert the files to one rate"
            )
    lengths = [None if i.count is None else i.count - t.skip for i, t in zip(infos, tasks, strict=True)]
    counted = [length for length in lengths if length is not None]
    if counted and max(counted) - min(counted) > _COUNTS_DIFFER:
        listed = ", ".join(f"{task.name} {length}" for task, length in zip(tasks, lengths, strict=True))
        raise CameraError(
            f"the cameras have different numbers of pictures ({listed}): cut the files to the same instants, "
            "give --offset CAMERA=PICTURES, or take the common ones with --unequal"
        )
