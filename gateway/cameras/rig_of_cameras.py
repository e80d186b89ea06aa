"""All cameras of a capture, in step: processes started and checked against each other, people chosen and
followed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Self, TypeVar

from devices.cameras.pictures import CameraError, PictureInfo
from gateway.body.camera import Camera
from gateway.cameras.camera_process import CameraProcess, CameraTask
from gateway.cameras.people_matching import people_in_common
from gateway.cameras.person_follower import Order
from gateway.cameras.steering import AHEAD, Orders, Steering
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.networks.person_detector import MOST_PEOPLE

T = TypeVar("T")
_RATES_DIFFER = 0.002
_COUNTS_DIFFER = 2
"""Pictures by which synchronised files may differ in length."""


@dataclass(frozen=True)
class RigOptions:
    """What a capture is of."""

    must_agree: bool = True
    """Raise ``CameraError`` for files of different rates and lengths."""
    people: int | None = 1
    """To be followed; None: everybody whom two cameras or more see in the first picture."""
    joined: tuple[tuple[int, int], ...] = ()
    """Cameras whose pictures are put together where a person is in both, by their place in the order."""


class CameraRig:
    """``with CameraRig(cameras, tasks, keypoints) as rig: for messages in rig: …``"""

    def __init__(
        self,
        cameras: Sequence[Camera],
        tasks: Sequence[CameraTask],
        keypoints: KeypointSet,
        options: RigOptions | None = None,
    ) -> None:
        """Start a process for each camera. cameras: calibrated, for the pictures as they are; tasks: in the
        same order; keypoints: of the network."""
        self._cameras, self._tasks, self._keypoints = cameras, tasks, keypoints
        self._options = options or RigOptions()
        paired = {row for pair in self._options.joined for row in pair}
        alone = [(row,) for row in range(len(tasks)) if row not in paired]
        self._rows: list[tuple[int, ...]] = [*self._options.joined, *alone]
        most = 1 if self._options.people == 1 else MOST_PEOPLE
        self._processes = [CameraProcess([tasks[row] for row in rows], most) for rows in self._rows]
        self._steering: Steering
        self._first: Orders = []
        self.n_people = 0
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

    def __iter__(self) -> Iterator[list[list[bytes]]]:
        """Yield the messages of every instant, by person, in the order of the cameras, until the first camera
        ends."""
        self._order(self._first)
        unknown = [[Order() for _ in range(self.n_people)] for _ in self._cameras]
        for _ in range(1, AHEAD):
            self._order(unknown)
        while (messages := self._messages()) is not None:
            masked = self._steering.take(messages)
            self._order(self._steering.orders())
            yield masked

    @property
    def same_as(self) -> Mapping[int, int]:
        """People who turned out to be another one, with that one."""
        return self._steering.same_as

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
        seen = self._by_camera([process.people() for process in self._processes])
        regions = people_in_common(self._cameras, seen, self._options.people)
        self.n_people = len(regions)
        self._first = [
            [Order(region is not None or self.n_people > 1, region) for region in of_camera]
            for of_camera in zip(*regions, strict=True)
        ]
        self._steering = Steering(self._cameras, self._keypoints, self.n_people, self._options.joined)

    def _order(self, orders: Orders) -> None:
        for process, rows in zip(self._processes, self._rows, strict=True):
            process.order([orders[row] for row in rows])

    def _messages(self) -> list[list[bytes]] | None:
        """Return the next messages, by person and camera; None at the end."""
        answers = [process.messages() for process in self._processes]
        whole = [answer for answer in answers if answer is not None]
        if len(whole) < len(answers):
            return None
        return [list(each) for each in zip(*self._by_camera(whole), strict=True)]

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
