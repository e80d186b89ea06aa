"""All cameras of a capture, in step: processes started and checked against each other, people chosen and
followed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Self, TypeVar

import numpy as np

from devices.cameras.pictures import CameraError, PictureInfo
from gateway.body.camera import Camera, project
from gateway.cameras.camera_process import MOST_PEOPLE, CameraProcess, CameraTask
from gateway.cameras.person_follower import Order
from gateway.cameras.steering import AHEAD, Orders, Steering
from gateway.frames import FloatArray
from gateway.reconstruction.video.initial import nearest_to_rays
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.networks.person_detector import Person
from gateway.reconstruction.video.projection import camera_model, ray
from gateway.reconstruction.video.region import PersonRegion

T = TypeVar("T")
_RATES_DIFFER = 0.002
_COUNTS_DIFFER = 2
"""Pictures by which synchronised files may differ in length."""
_ABSENT_COST = 0.15
"""Of a camera that is taken not to show the person, as a share of the person's size in pictures."""


_MOST_UNEQUAL = 1.6
"""Largest over smallest of the sizes that cameras show one person in: 1.0 to 1.35 where it is one."""


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
        """cameras: calibrated, for the pictures as they are; tasks: in the same order; keypoints: of the
        network."""
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
        """The messages of every instant, by person, in the order of the cameras, until the first camera
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
        """People who turned out to be an earlier one, with that one."""
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
        """By person, by camera; None at the end."""
        answers = [process.messages() for process in self._processes]
        whole = [answer for answer in answers if answer is not None]
        if len(whole) < len(answers):
            return None
        return [list(each) for each in zip(*self._by_camera(whole), strict=True)]

    def _by_camera(self, answers: Sequence[Sequence[T]]) -> list[T]:
        """Answers of processes as one list in the order of the cameras."""
        found = {
            row: each
            for rows, answer in zip(self._rows, answers, strict=True)
            for row, each in zip(rows, answer, strict=True)
        }
        return [found[row] for row in range(len(self._tasks))]


def check_agreement(infos: Sequence[PictureInfo], tasks: Sequence[CameraTask]) -> None:
    """Raises ``CameraError`` where rates or lengths show that the sources were not taken together."""
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
        told = ", ".join(f"{task.name} {length}" for task, length in zip(tasks, lengths, strict=True))
        raise CameraError(
            f"the cameras have different numbers of pictures ({told}): cut the files to the same instants, "
            "give --offset CAMERA=PICTURES, or take the common ones with --unequal"
        )


def people_in_common(
    cameras: Sequence[Camera], people: Sequence[Sequence[Person]], wanted: int | None
) -> list[list[PersonRegion | None]]:
    """By person, by camera: the regions of the ``wanted`` people of a first picture whose hips and shoulders
    meet in the world, those whom most cameras agree upon first; None: everybody.

    None in the place of a region: the camera does not show the person. One person is always given, though it
    be nobody. Raises ``CameraError`` when there are fewer than are wanted.
    """
    found = [
        [None if person is None else person.region for person in chosen]
        for chosen in itertools.islice(matched_people(cameras, people, first_surely=False), wanted)
    ]
    if wanted is not None and 1 < wanted != len(found):
        raise CameraError(
            f"--people {wanted}: {len(found)} seen by two cameras or more in the first pictures; begin "
            "where all of them are in sight (--offset), or take --people all"
        )
    return found or [[None] * len(cameras)]


def matched_people(
    cameras: Sequence[Camera], people: Sequence[Sequence[Person]], *, first_surely: bool = True
) -> Iterator[tuple[Person | None, ...]]:
    """Yield who is one person in several cameras, by camera, those whom most of them agree upon first.

    first_surely: whether rays that pass each other like those of two people leave nobody for the first, too.
    """
    left, surely = [list(each) for each in people], first_surely
    while (chosen := _closest_person(cameras, left, surely=surely)) is not None:
        yield chosen
        surely = True
        left = [
            [person for person in each if person is not taken]
            for each, taken in zip(left, chosen, strict=True)
        ]


def _closest_person(
    cameras: Sequence[Camera], people: Sequence[Sequence[Person]], *, surely: bool
) -> tuple[Person | None, ...] | None:
    """Of each camera's people those that are one person; None where two cameras agree upon nobody.

    surely: whether that the rays pass each other like those of two people leaves nobody, too.
    """
    options: list[list[Person | None]] = [[*each[:MOST_PEOPLE], None] for each in people]
    best: tuple[float, tuple[Person | None, ...]] | None = None
    for chosen in itertools.product(*options):
        n_seeing = sum(person is not None for person in chosen)
        if n_seeing < min(2, len(cameras)):
            continue
        cost = _disagreement(cameras, chosen)
        agreed = cost - _ABSENT_COST * (len(chosen) - n_seeing) < _ABSENT_COST * n_seeing
        if surely and not (agreed and _is_of_one_size(cameras, chosen)):
            continue
        if best is None or cost < best[0]:
            best = cost, chosen
    return None if best is None else best[1]


def _is_of_one_size(cameras: Sequence[Camera], chosen: Sequence[Person | None]) -> bool:
    """Whether what each camera shows is as large as what the others do, where their rays meet."""
    seeing = [(c, p) for c, p in zip(cameras, chosen, strict=True) if p is not None]
    hips = _meeting([camera for camera, _ in seeing], [person.hips for _, person in seeing])
    sizes = [
        person.radius * float(camera.rotation[2] @ hips + camera.translation[2]) / float(camera.matrix[0, 0])
        for camera, person in seeing
    ]
    return min(sizes) > 0 and max(sizes) <= _MOST_UNEQUAL * min(sizes)


def _disagreement(cameras: Sequence[Camera], chosen: Sequence[Person | None]) -> float:
    """How far hips and shoulders are from where all rays together put them, in sizes of the person.

    Summed over the cameras; one without the person has a set cost.
    """
    seeing = [(c, p) for c, p in zip(cameras, chosen, strict=True) if p is not None]
    cost = _ABSENT_COST * (len(chosen) - len(seeing))
    if len(seeing) < 2:
        return cost
    for part in ("hips", "shoulders"):
        pixels = [getattr(person, part) for _, person in seeing]
        point = _meeting([camera for camera, _ in seeing], pixels)
        for (camera, person), pixel in zip(seeing, pixels, strict=True):
            off = float(np.linalg.norm(project(camera, point) - pixel)) / person.radius
            cost += 0.5 * (off if np.isfinite(off) else 10.0)
    return cost


def _meeting(cameras: Sequence[Camera], pixels: Sequence[FloatArray]) -> FloatArray:
    """The point (3,) m, nearest to the rays through one pixel a camera."""
    models = [camera_model(camera) for camera in cameras]
    directions = np.stack([ray(model, *pixel) for model, pixel in zip(models, pixels, strict=True)])
    positions = np.stack([model.position for model in models])
    return nearest_to_rays(positions, directions, np.ones(len(models)))
