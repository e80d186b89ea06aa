"""All cameras of a capture, in step: processes started, checked against each other, one person chosen."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Self

import numpy as np

from devices.cameras.pictures import CameraError, PictureInfo
from gateway.body.camera import Camera, project
from gateway.cameras.camera_process import CameraProcess, CameraTask
from gateway.frames import FloatArray
from gateway.reconstruction.video.initial import nearest_to_rays
from gateway.reconstruction.video.networks.person_detector import Person
from gateway.reconstruction.video.projection import camera_model, ray
from gateway.reconstruction.video.region import PersonRegion

_RATES_DIFFER = 0.002
_COUNTS_DIFFER = 2
"""Pictures by which synchronised files may differ in length."""
_MOST_PEOPLE = 4
"""Of one picture that are considered."""
_ABSENT_COST = 0.15
"""Of a camera that is taken not to show the person, as a share of the person's size in pictures."""


class CameraRig:
    """``with CameraRig(cameras, tasks) as rig: for messages in rig: …``"""

    def __init__(
        self, cameras: Sequence[Camera], tasks: Sequence[CameraTask], *, must_agree: bool = True
    ) -> None:
        """cameras: calibrated, for the pictures as they are; tasks: in the same order.

        must_agree: raise ``CameraError`` for files of different rates and lengths.
        """
        self._cameras = cameras
        self._processes = [CameraProcess(task) for task in tasks]
        self._must_agree = must_agree
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

    def __iter__(self) -> Iterator[list[bytes]]:
        """The messages of every instant, in the order of the cameras, until the first camera ends."""
        while True:
            messages = [process.message() for process in self._processes]
            whole = [message for message in messages if message is not None]
            if len(whole) < len(messages):
                return
            yield whole

    def close(self) -> None:
        """End all processes."""
        for process in self._processes:
            process.close()

    def _begin(self) -> None:
        infos = [process.info() for process in self._processes]
        tasks = [process.task for process in self._processes]
        if self._must_agree:
            check_agreement(infos, tasks)
        self.rate_hz = infos[0].rate_hz
        counts = [info.count - task.skip for info, task in zip(infos, tasks, strict=True) if info.count]
        self.count = min(counts) if counts else None
        people = [process.people() for process in self._processes]
        for process, region in zip(self._processes, same_person(self._cameras, people), strict=True):
            process.follow(region)


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


def same_person(cameras: Sequence[Camera], people: Sequence[Sequence[Person]]) -> list[PersonRegion | None]:
    """Of the people in each camera's picture those that are one person in the world: hips and shoulders meet.

    None for a camera that does not show the person; of several people, the one that most cameras agree upon.
    """
    options: list[list[Person | None]] = [[*each[:_MOST_PEOPLE], None] for each in people]
    best: tuple[float, tuple[Person | None, ...]] | None = None
    for chosen in itertools.product(*options):
        if sum(person is not None for person in chosen) < min(2, len(cameras)):
            continue
        cost = _disagreement(cameras, chosen)
        if best is None or cost < best[0]:
            best = cost, chosen
    if best is None:
        return [None] * len(cameras)
    return [None if person is None else person.region for person in best[1]]


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
