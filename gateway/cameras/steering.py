"""Where every person will be in the pictures to come: the pose of all cameras told to each of them.

Step 7 of JP2020-042476A. A camera that follows by itself leaves a person for whoever passes in front; one
that is told where the pose goes does not. Regions are for two pictures later: while the pose of one instant
is found, the cameras look at the next one, and what comes out does not depend on who is faster.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from devices.cameras.heat_map_messages import HeatMapReceiver, encode_heat_maps, quantised
from gateway.body.camera import Camera
from gateway.cameras.person_follower import Order
from gateway.cameras.stitching import joining
from gateway.frames import FloatArray, HeatMapFrame
from gateway.reconstruction.video.crowd import VideoCrowd
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.regions import person_region
from gateway.sources.heat_maps import heat_map_frame

AHEAD = 2
"""Pictures from a pose to those that its regions are for."""
Orders = list[list[Order]]
"""By camera, by person."""


class Steering:
    """The people of a capture tracked while it is looked at. Sans-I/O and deterministic."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        keypoints: KeypointSet,
        n_people: int,
        joined: Sequence[tuple[int, int]] = (),
    ) -> None:
        """Begin at the first picture. joined: pairs of cameras whose pictures may be put together where a
        person is in both."""
        self._cameras = cameras
        self._names = keypoints.names
        self._crowd = VideoCrowd(cameras, keypoints, n_people)
        self._partner = dict(joined) | {b: a for a, b in joined}
        self._taken = 0

    def take(self, messages: Sequence[Sequence[bytes]]) -> list[list[bytes]]:
        """Return one instant of messages, by person and camera, with the other people masked, and left and
        right as the body has them."""
        frames = [heat_map_frame(self._taken, each) for each in messages]
        masked = self._crowd.masked(frames)
        self._crowd.follow(masked)
        self._taken += 1
        return [_encoded(*each) for each in zip(messages, frames, masked, strict=True)]

    @property
    def same_as(self) -> Mapping[int, int]:
        """People who turned out to be another one, with that one; no camera looks for them any more."""
        return self._crowd.same_as

    def orders(self) -> Orders:
        """Return orders for the picture ``AHEAD`` of the last instant taken."""
        by_person = [
            [Order(True, None) for _ in self._cameras]
            if index in self.same_as
            else self._orders_of(points)
            for index, points in enumerate(self._crowd.expected_after(AHEAD))
        ]
        return [list(each) for each in zip(*by_person, strict=True)]

    def _orders_of(self, points: FloatArray | None) -> list[Order]:
        if points is None:
            return [Order() for _ in self._cameras]
        regions = [person_region(camera, points, self._names) for camera in self._cameras]
        orders = [Order(True, region) for region in regions]
        for camera, partner in self._partner.items():
            if orders[partner].joined is not None:
                continue
            joined = joining(self._cameras[camera], self._cameras[partner], points)
            region = person_region(self._cameras[camera], points, self._names, must_see=False)
            if joined is not None and region is not None:
                orders[camera] = Order(True, region, joined)
                orders[partner] = Order(True, None)
        return orders


def _encoded(messages: Sequence[bytes], before: HeatMapFrame, after: HeatMapFrame) -> list[bytes]:
    """Return the messages, where the maps are others than before with these in the place of their own."""
    encoded = []
    for message, was, maps in zip(messages, before.cameras, after.cameras, strict=True):
        if maps is None or maps is was:
            encoded.append(message)
            continue
        read = HeatMapReceiver().receive(message)[0]
        encoded.append(encode_heat_maps(replace(read, likelihood=quantised(maps.likelihood))))
    return encoded
