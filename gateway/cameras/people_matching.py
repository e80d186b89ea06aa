"""Who is one person in the pictures of several cameras: whose hips and shoulders meet in the world."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from gateway.body.camera import Camera, project
from gateway.frames import FloatArray
from gateway.reconstruction.video.initial import nearest_to_rays
from gateway.reconstruction.video.networks.person_detector import MOST_PEOPLE, Person
from gateway.reconstruction.video.projection import camera_model, ray
from gateway.reconstruction.video.region import PersonRegion

_ABSENT_COST = 0.15
"""Of a camera that is taken not to show the person, as a share of the person's size in pictures."""
_MOST_UNEQUAL = 1.6
"""Largest over smallest of the sizes that cameras show one person in: 1.0 to 1.35 where it is one."""


def person_in_common(
    cameras: Sequence[Camera], people: Sequence[Sequence[Person]]
) -> list[PersonRegion | None]:
    """Return by camera the region of the one person whose hips and shoulders meet in the world and whom most
    cameras agree upon; None: the camera does not show them."""
    chosen = _closest_person(cameras, people, must_agree=False) or (None,) * len(cameras)
    return [None if person is None else person.region for person in chosen]


def matched_people(
    cameras: Sequence[Camera], people: Sequence[Sequence[Person]]
) -> Iterator[tuple[Person | None, ...]]:
    """Yield who is one person in several cameras, by camera, those whom most of them agree upon first."""
    left = [list(each) for each in people]
    while (chosen := _closest_person(cameras, left, must_agree=True)) is not None:
        yield chosen
        left = [
            [person for person in each if person is not taken]
            for each, taken in zip(left, chosen, strict=True)
        ]


def _closest_person(
    cameras: Sequence[Camera], people: Sequence[Sequence[Person]], *, must_agree: bool
) -> tuple[Person | None, ...] | None:
    """Return those of each camera's people that are one person; None where two cameras show nobody.

    must_agree: whether it is None, too, where the rays pass each other like those of two people.
    """
    options: list[list[Person | None]] = [[*each[:MOST_PEOPLE], None] for each in people]
    best: tuple[float, tuple[Person | None, ...]] | None = None
    for chosen in itertools.product(*options):
        n_seeing = sum(person is not None for person in chosen)
        if n_seeing < min(2, len(cameras)):
            continue
        cost = _disagreement(cameras, chosen)
        agreed = cost - _ABSENT_COST * (len(chosen) - n_seeing) < _ABSENT_COST * n_seeing
        if must_agree and not (agreed and _is_of_one_size(cameras, chosen)):
            continue
        if best is None or cost < best[0]:
            best = cost, chosen
    return None if best is None else best[1]


def _is_of_one_size(cameras: Sequence[Camera], chosen: Sequence[Person | None]) -> bool:
    """Return whether what each camera shows is as large as what the others do, where their rays meet."""
    seeing = [(c, p) for c, p in zip(cameras, chosen, strict=True) if p is not None]
    hips = meeting_point([camera for camera, _ in seeing], [person.hips for _, person in seeing])
    sizes = [
        person.radius * float(camera.rotation[2] @ hips + camera.translation[2]) / float(camera.matrix[0, 0])
        for camera, person in seeing
    ]
    return min(sizes) > 0 and max(sizes) <= _MOST_UNEQUAL * min(sizes)


def _disagreement(cameras: Sequence[Camera], chosen: Sequence[Person | None]) -> float:
    """Return how far hips and shoulders are from where all rays together put them, in sizes of the person.

    Summed over the cameras; one without the person has a set cost.
    """
    seeing = [(c, p) for c, p in zip(cameras, chosen, strict=True) if p is not None]
    cost = _ABSENT_COST * (len(chosen) - len(seeing))
    if len(seeing) < 2:
        return cost
    for part in ("hips", "shoulders"):
        pixels = [getattr(person, part) for _, person in seeing]
        point = meeting_point([camera for camera, _ in seeing], pixels)
        for (camera, person), pixel in zip(seeing, pixels, strict=True):
            off = float(np.linalg.norm(project(camera, point) - pixel)) / person.radius
            cost += 0.5 * (off if np.isfinite(off) else 10.0)
    return cost


def meeting_point(cameras: Sequence[Camera], pixels: Sequence[FloatArray]) -> FloatArray:
    """Return the point (3,) m, nearest to the rays through one pixel a camera."""
    models = [camera_model(camera) for camera in cameras]
    directions = np.stack([ray(model, *pixel) for model, pixel in zip(models, pixels, strict=True)])
    positions = np.stack([model.position for model in models])
    return nearest_to_rays(positions, directions, np.ones(len(models)))
