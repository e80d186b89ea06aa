"""Keypoints of other programs to heat-map messages: people are told apart, and followed, camera by camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from devices.cameras.heat_map_messages import HeatMapMessage, encode_heat_maps, quantised
from devices.cameras.keypoint_files import PictureKeypoints
from gateway.body.camera import Camera
from gateway.cameras.people_matching import people_in_common
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.imported import in_order, layout_of, maps_of, person_of
from gateway.reconstruction.video.networks.person_detector import Person

_FARTHEST = 0.25
"""That somebody's hips may move from one picture to the next, in sizes of the person."""
_NOWHERE = np.zeros((2, 3))
_FIRST_PICTURES = 60
"""In which the people are looked for: the first that shows somebody to two cameras counts."""

Seen = list[tuple[Person, FloatArray]]
"""Everybody in one picture, with keypoints (n, 3)."""


def keypoint_messages(
    cameras: Sequence[Camera],
    pictures: Sequence[PictureKeypoints],
    skipped: Mapping[str, int],
    rate_hz: float,
    wanted: int | None,
) -> tuple[str, list[list[list[bytes]]]]:
    """Return the keypoints' set, and by person, of every instant, a message a camera.

    skipped: pictures left out at the start, by camera. wanted: how many people; None: all that two cameras
    see. Raises ``GatewayError``, and ``CameraError`` for fewer than are wanted.
    """
    counts = {each.n_keypoints for each in pictures}
    if len(counts) > 1:
        told = ", ".join(f"{each.path} {each.n_keypoints}" for each in pictures)
        raise GatewayError(f"the cameras' keypoints are of different networks: {told}")
    keypoint_set, layout = layout_of(counts.pop(), str(pictures[0].path))
    names = load_keypoint_set(keypoint_set).names
    seen = [
        [_everybody(people, layout, names) for people in each.people[skipped.get(camera.name, 0) :]]
        for camera, each in zip(cameras, pictures, strict=True)
    ]
    count = min(map(len, seen))
    if count == 0:
        raise GatewayError("after --offset no picture is left that all cameras have")
    first, begun = _beginning(cameras, seen, count, wanted)
    by_camera = [
        _followed(of_camera[:count], first, [hips[c] for hips in begun]) for c, of_camera in enumerate(seen)
    ]
    followed = [[of_camera[k] for of_camera in by_camera] for k in range(len(begun))]
    messages = [
        [
            [
                _message(camera.name, keypoint_set, names, points[index], index, rate_hz)
                for camera, points in zip(cameras, person, strict=True)
            ]
            for index in range(count)
        ]
        for person in followed
    ]
    return keypoint_set, messages


def _everybody(people: Sequence[FloatArray], layout: tuple[str, ...], names: tuple[str, ...]) -> Seen:
    found = []
    for person in people:
        points = in_order(person, layout, names)
        if (at := person_of(points, names)) is not None:
            found.append((at, points))
    return sorted(found, key=lambda each: -each[0].score)


def _beginning(
    cameras: Sequence[Camera], seen: Sequence[Sequence[Seen]], count: int, wanted: int | None
) -> tuple[int, list[list[FloatArray | None]]]:
    """Return the picture in which people are first seen, and by person their hips in every camera; None:
    unseen."""
    for index in range(min(count, _FIRST_PICTURES)):
        people = [[person for person, _ in of_camera[index]] for of_camera in seen]
        if sum(map(bool, people)) < min(2, len(cameras)):
            continue
        regions = people_in_common(cameras, people, wanted)
        if any(region is not None for person in regions for region in person):
            return index, [[None if r is None else r.centre for r in person] for person in regions]
    looked_at = min(count, _FIRST_PICTURES)
    raise GatewayError(f"in the first {looked_at} pictures no two cameras see somebody's hips and shoulders")


def _followed(
    of_camera: Sequence[Seen], first: int, hips: Sequence[FloatArray | None]
) -> list[list[FloatArray | None]]:
    """Return by person the keypoints in every picture of a camera, from where the hips are in picture
    ``first``; None where nobody is near, or somebody else is nearer to who is."""
    last = list(hips)
    found: list[list[FloatArray | None]] = [[None] * len(of_camera) for _ in hips]
    for index, people in enumerate(of_camera):
        if index < first:
            continue
        pairs = sorted(
            (float(np.linalg.norm(person.hips - at)) / max(person.radius, 1.0), k, n)
            for k, at in enumerate(last)
            if at is not None
            for n, (person, _) in enumerate(people)
        )
        taken: set[int] = set()
        for away, k, n in pairs:
            if away <= _FARTHEST and n not in taken and found[k][index] is None:
                taken.add(n)
                last[k], found[k][index] = people[n][0].hips, people[n][1]
    return found


def _message(
    camera: str, network: str, names: tuple[str, ...], points: FloatArray | None, index: int, rate_hz: float
) -> bytes:
    maps = None if points is None else maps_of(points, names)
    return encode_heat_maps(
        HeatMapMessage(
            camera, network, index, round(index * 1e9 / rate_hz),
            None if maps is None else quantised(maps.likelihood),
            _NOWHERE if maps is None else maps.map_from_pixel,
        )
    )  # fmt: skip
