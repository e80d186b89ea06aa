"""Keypoints of other programs to heat-map messages: people are told apart, and followed, camera by camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from devices.cameras.heat_map_messages import HeatMapMessage, encode_heat_maps, quantised
from devices.cameras.keypoint_files import People, PictureKeypoints
from gateway.body.camera import Camera, project
from gateway.cameras.people_matching import meeting_point, people_in_common
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.imported import (
    LEAST_LIKELIHOOD,
    in_order,
    layout_of,
    maps_of,
    person_of,
)
from gateway.reconstruction.video.networks.person_detector import Person

_FARTHEST = 0.25
"""That somebody's hips may move from one picture to the next, in sizes of the person."""
_LARGEST_SHARE = 2.0
"""Up to which places are no pixels: programs may count from -1 to 1, or a little beyond."""
_BORDER = 0.1
"""Of the picture's sides: so far beyond them a network may guess a keypoint."""
_MOST_BEYOND = 0.3
"""Of all keypoints, that may be farther."""
_NOWHERE = np.zeros((2, 3))
_FIRST_PICTURES = 60
"""In which the people are looked for: the first that shows somebody to two cameras counts."""

Shown = tuple[Person, FloatArray]
"""Somebody in one picture, with keypoints (n, 3)."""
Seen = list[Shown]
"""Everybody in one picture."""


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
    for camera, each in zip(cameras, pictures, strict=True):
        _check_pixels(camera, each)
    keypoint_set, layout = layout_of(counts.pop(), str(pictures[0].path))
    names = load_keypoint_set(keypoint_set).names
    seen = [
        [_everybody(people, layout, names) for people in each[skipped.get(camera.name, 0) :]]
        for camera, each in zip(cameras, _in_step(pictures), strict=True)
    ]
    count = min(map(len, seen))
    if count == 0:
        raise GatewayError("after --offset no picture is left that all cameras have")
    first, begun = _beginning(cameras, seen, count, wanted)
    followed = _followed(cameras, [of_camera[:count] for of_camera in seen], first, begun)
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


def _check_pixels(camera: Camera, pictures: PictureKeypoints) -> None:
    """Raise ``GatewayError`` for keypoints that cannot be pixels of the calibrated pictures."""
    points = np.concatenate([person for people in pictures.people for person in people])
    pixels = points[points[:, 2] >= LEAST_LIKELIHOOD, :2]
    if not len(pixels):
        return
    if np.abs(pixels).max() <= _LARGEST_SHARE:
        raise GatewayError(
            f"{pictures.path}: places are shares of the picture, {pixels.min():.2g} to {pixels.max():.2g}: "
            "pixels are wanted"
        )
    size = np.array([camera.width, camera.height])
    beyond = ((pixels < -_BORDER * size) | (pixels > (1.0 + _BORDER) * size)).any(axis=1)
    if beyond.mean() > _MOST_BEYOND:
        x, y = pixels.max(axis=0)
        raise GatewayError(
            f"{pictures.path}: keypoints at up to {x:.0f}, {y:.0f}, in pictures of {camera.width}×"
            f"{camera.height} pixels by the calibration of camera '{camera.name}': are the pictures larger, "
            "or another camera's?"
        )


def _in_step(pictures: Sequence[PictureKeypoints]) -> list[tuple[People, ...]]:
    """Return who is in the pictures of all cameras from the same number to the same, where their numbers
    overlap: a camera that sees nobody in the first or the last ones may have no file of these."""
    first, last = (
        min(each.first for each in pictures),
        max(each.first + len(each.people) for each in pictures),
    )
    if max(each.first for each in pictures) >= min(each.first + len(each.people) for each in pictures):
        return [each.people for each in pictures]
    return [
        ((),) * (each.first - first) + each.people + ((),) * (last - each.first - len(each.people))
        for each in pictures
    ]


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
    cameras: Sequence[Camera],
    seen: Sequence[Sequence[Seen]],
    first: int,
    begun: Sequence[Sequence[FloatArray | None]],
) -> list[list[list[FloatArray | None]]]:
    """Return by person and camera the keypoints in every picture, from where the hips are in picture
    ``first`` (begun: by person and camera); None where nobody is near, or somebody else is nearer to who is.

    Into a camera that has lost somebody, or has never seen them, those lead who see them.
    """
    last = [list(each) for each in begun]
    found: list[list[list[FloatArray | None]]] = [
        [[None] * len(of_camera) for of_camera in seen] for _ in begun
    ]
    for index in range(first, len(seen[0])):
        shown = [of_camera[index] for of_camera in seen]
        now = _seen_near(shown, last, {})
        hips = [
            [now[k, c][0].hips if (k, c) in now else None for c in range(len(seen))] for k in range(len(last))
        ]
        now |= _seen_near(shown, [_led(cameras, each) for each in hips], now)
        for (k, c), (person, points) in now.items():
            last[k][c], found[k][c][index] = person.hips, points
    return found


def _seen_near(
    shown: Sequence[Seen], hips: Sequence[Sequence[FloatArray | None]], known: Mapping[tuple[int, int], Shown]
) -> dict[tuple[int, int], Shown]:
    """Return by person and camera who is where hips are expected (by person and camera).

    shown: everybody in the picture of each camera; known: who is found already.
    """
    found = {}
    for c, people in enumerate(shown):
        taken = [id(each) for (_, camera), (each, _) in known.items() if camera == c]
        left = [each for each in people if id(each[0]) not in taken]
        expected = [None if (k, c) in known else at[c] for k, at in enumerate(hips)]
        found.update({(k, c): left[n] for k, n in _nearest(left, expected)})
    return found


def _nearest(people: Seen, hips: Sequence[FloatArray | None]) -> Iterator[tuple[int, int]]:
    """Yield who is where hips are expected, and the row of the one in the picture: the nearest first, each
    once."""
    pairs = sorted(
        (float(np.linalg.norm(person.hips - at)) / max(person.radius, 1.0), k, n)
        for k, at in enumerate(hips)
        if at is not None
        for n, (person, _) in enumerate(people)
    )
    done: set[int] = set()
    used: set[int] = set()
    for away, k, n in pairs:
        if away <= _FARTHEST and k not in done and n not in used:
            done.add(k)
            used.add(n)
            yield k, n


def _led(cameras: Sequence[Camera], hips: Sequence[FloatArray | None]) -> list[FloatArray | None]:
    """Return where each camera should see hips that two or more of them see at those pixels."""
    seeing = [(camera, at) for camera, at in zip(cameras, hips, strict=True) if at is not None]
    if len(seeing) < 2:
        return [None] * len(cameras)
    point = meeting_point([camera for camera, _ in seeing], [at for _, at in seeing])
    pixels = [project(camera, point) for camera in cameras]
    return [pixel if np.isfinite(pixel).all() else None for pixel in pixels]


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
