"""Keypoints of other programs to heat-map messages: people are told apart and followed as in films."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from devices.cameras.keypoint_files import People, PictureKeypoints
from devices.cameras.orders import encode_orders, read_orders
from gateway.body.camera import Camera
from gateway.body.skeleton import VideoSetUp
from gateway.cameras.camera_process import CameraTask, messages_of
from gateway.cameras.filmed_people import FilmedPeople, Instants
from gateway.cameras.live_crowd import AHEAD, CrowdInstant, LiveCrowd
from gateway.cameras.people_follower import follower_of
from gateway.cameras.people_matching import person_in_common
from gateway.cameras.rig_of_cameras import Follows
from gateway.cameras.steering import Steering
from gateway.errors import GatewayError
from gateway.frames import CameraHeatMaps, FloatArray
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.networks.imported import (
    LEAST_LIKELIHOOD,
    in_order,
    layout_of,
    maps_of,
    person_of,
)
from gateway.reconstruction.video.networks.person_detector import Person
from gateway.reconstruction.video.region import PersonRegion, square_of

_FARTHEST = 0.15
"""That somebody's hips may be from where they are looked for, in sides of the region."""
_LARGEST_SHARE = 2.0
"""Up to which places are no pixels: programs may count from -1 to 1, or a little beyond."""
_BORDER = 0.1
"""Of the picture's sides: so far beyond them a network may guess a keypoint."""
_MOST_BEYOND = 0.3
"""Of all keypoints, that may be farther."""
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
    wanted: int,
) -> tuple[str, list[Instants]]:
    """Return the keypoints' set, and by person, of every instant, a message a camera.

    skipped: pictures left out at the start, by camera. wanted: how many people at once. Raises
    ``GatewayError``.
    """
    counts = {each.n_keypoints for each in pictures}
    if len(counts) > 1:
        listed = ", ".join(f"{each.path} {each.n_keypoints}" for each in pictures)
        raise GatewayError(f"the cameras' keypoints are of different networks: {listed}")
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
    seen = [of_camera[:count] for of_camera in seen]
    filmed = FilmedPeople(VideoSetUp(tuple(cameras), keypoint_set), rate_hz)
    people, first, begun = _people(filmed.video, seen, wanted)
    filmed.taken = begun
    for instant in _followed(filmed, [of_camera[begun:] for of_camera in seen], people, first, most=wanted):
        filmed.add(instant)
    return keypoint_set, filmed.people


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


def _people(video: VideoSetUp, seen: Sequence[Sequence[Seen]], most: int) -> tuple[Follows, bytes, int]:
    """Return what tells the people, the first orders for the cameras, and the picture from which on.

    Raises ``GatewayError`` where no two cameras see the same person.
    """
    for index in range(min(len(seen[0]), _FIRST_PICTURES)):
        people = [[person for person, _ in of_camera[index]] for of_camera in seen]
        if sum(map(bool, people)) < min(2, len(seen)):
            continue
        regions = person_in_common(video.cameras, people)
        if not any(regions):
            continue
        if most > 1:
            return LiveCrowd(video, most), b"", 0
        squares = zip(video.cameras, map(square_of, regions), strict=True)
        return (
            Steering(video),
            encode_orders(0, {camera.name: {0: square} for camera, square in squares}),
            index,
        )
    looked_at = min(len(seen[0]), _FIRST_PICTURES)
    raise GatewayError(f"in the first {looked_at} pictures no two cameras see somebody's hips and shoulders")


def _followed(
    filmed: FilmedPeople, seen: Sequence[Sequence[Seen]], people: Follows, first: bytes, most: int
) -> Iterator[CrowdInstant]:
    """Yield what every instant brings; each camera is led by the orders of ``AHEAD`` instants before."""
    video, begun = filmed.video, filmed.taken
    listed = ListedPeople(load_keypoint_set(video.network).names)
    followers = [follower_of(listed, listed, most) for _ in video.cameras]
    waiting = deque([first, *[b""] * (AHEAD - 1)])
    for index, shown in enumerate(zip(*seen, strict=True), start=begun):
        line, messages = waiting.popleft(), []
        for camera, follower, picture in zip(video.cameras, followers, shown, strict=True):
            if orders := read_orders(line, camera.name):
                follower.take(orders)
            task = CameraTask(camera.name, "", video.network)
            messages.append(messages_of(follower.heat_maps(picture), task, index, filmed.time_ns(index)))
        instant = people.take(messages)
        waiting.append(instant.orders)
        yield instant


class ListedPeople:
    """What another program found in a picture, in the place of a network and a detector."""

    def __init__(self, keypoints: tuple[str, ...]) -> None:
        self.keypoints = keypoints

    def heat_maps(self, picture: Seen, region: PersonRegion) -> CameraHeatMaps:
        """Return the maps of whoever is nearest to a region's middle; empty ones where nobody is near."""
        near = [
            (float(np.linalg.norm(person.hips - region.centre)), row)
            for row, (person, _) in enumerate(picture)
        ]
        away, row = min(near, default=(np.inf, 0))
        maps = maps_of(picture[row][1], self.keypoints) if away <= _FARTHEST * region.size else None
        if maps is None:
            return CameraHeatMaps(np.zeros((len(self.keypoints), 2, 2), np.float32), region.affine(2))
        return maps

    def people(self, picture: Seen) -> list[Person]:
        """Return everybody in the picture, the likeliest first."""
        return [person for person, _ in picture]

    def everybody(self, picture: Seen, most: int) -> list[Person]:
        """Return the likeliest people in the picture."""
        return self.people(picture)[:most]

    def newcomers(self, picture: Seen, known: Sequence[PersonRegion], look: int) -> list[Person]:
        """Return everybody in the picture: who is known is told by where they are."""
        return self.people(picture)
