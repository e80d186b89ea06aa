"""The people in the pictures of one camera: found by the detector, followed by their heat maps, and led by
where the poses of all cameras will have them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np

from devices.cameras.heat_map_messages import FOUND_BY_CAMERA
from devices.cameras.orders import CameraOrders, Joined, Square, read_orders
from gateway.cameras.stitching import joined_heat_maps
from gateway.frames import CameraHeatMaps, FloatArray
from gateway.reconstruction.video.networks.network import Picture, PoseNetwork
from gateway.reconstruction.video.networks.person_detector import Person
from gateway.reconstruction.video.region import PersonRegion, region_of_maps

_LOOK_EVERY = 4
"""Pictures between two looks for people who have come; while nobody is followed, there is one a picture."""
_NEAR = 0.2
"""Distance of the hips, in sides of a region, under which somebody is who is followed there."""
_SILENT = 60
"""Pictures without orders after which the gateway is taken to be gone."""
_UNTOLD = 150
"""Pictures after which somebody is left whom no gateway took for a person."""


Picture_contra = TypeVar("Picture_contra", contravariant=True)
"""A picture, or what stands for one."""


class Network(Protocol[Picture_contra]):
    """What makes heat maps of one person."""

    @property
    def keypoints(self) -> tuple[str, ...]:
        """Names of the maps."""

    def heat_maps(self, picture: Picture_contra, region: PersonRegion) -> CameraHeatMaps:
        """Return the maps of the one person that ``region`` shows."""


class Detector(Protocol[Picture_contra]):
    """What finds people."""

    def people(self, picture: Picture_contra) -> list[Person]:
        """Return the people of a picture, the likeliest first."""

    def everybody(self, picture: Picture_contra, most: int) -> list[Person]:
        """Return as ``people`` does, and those whom somebody nearer outshines in the whole; it takes long."""

    def newcomers(self, picture: Picture_contra, known: Sequence[PersonRegion], look: int) -> list[Person]:
        """Return people beside the ``known`` ones; look: counts the looks, which may each be at another part
        of the picture."""


class RegionFollower(ABC, Generic[Picture_contra]):
    """Keeps a region for each person from picture to picture."""

    def __init__(self, network: Network[Picture_contra], detector: Detector[Picture_contra]) -> None:
        """Follow nobody yet."""
        self._network, self._detector = network, detector
        self._regions: dict[int, PersonRegion | None] = {}
        """By number; None: in no picture, until told otherwise."""
        self._joined: dict[int, Joined] = {}
        self._last: FloatArray | None = None
        """(2,) pixels: where somebody was looked for last."""
        self._pictures = self._ordered_at = 0

    @abstractmethod
    def _is_own(self, number: int) -> bool:
        """Return whether somebody of that number is found and lost without the gateway's word."""

    @abstractmethod
    def _ordered(self, ordered: Mapping[int, PersonRegion | None]) -> dict[int, PersonRegion | None]:
        """Return who is followed where, once the gateway has named people and their regions."""

    @abstractmethod
    def _find(self, picture: Picture_contra) -> None:
        """Begin to follow whom the detector finds beside those who are followed."""

    def take(self, orders: CameraOrders) -> None:
        """Follow whom the gateway names where it says, and nobody else by a number of the gateway's."""
        self._ordered_at = self._pictures
        self._joined = dict(orders.joined)
        self._regions = self._ordered(
            {number: _region_of(square) for number, square in orders.squares.items()}
        )

    def heat_maps(self, picture: Picture_contra) -> dict[int, CameraHeatMaps | None]:
        """Return the maps of everybody who is followed, by number; None of one who is not seen any more."""
        if self._pictures - self._ordered_at > _SILENT:
            self._joined = {}
            self._regions = {
                number: region
                for number, region in self._regions.items()
                if region is not None and self._is_own(number)
            }
        self._find(picture)
        self._pictures += 1
        seen: dict[int, CameraHeatMaps | None] = {}
        for number, region in list(self._regions.items()):
            if region is None or number in self._joined:
                continue
            maps = self._network.heat_maps(picture, region)
            after = region_of_maps(maps, self._network.keypoints)
            seen[number] = None if after is None else maps
            self._last = region.centre
            self._regions[number] = after
            if after is None and self._is_own(number):
                del self._regions[number]
        return seen

    def joined(self) -> list[tuple[int, PersonRegion, Joined]]:
        """Return of everybody for whom a neighbour's picture is needed, too, number, region and neighbour."""
        return [
            (number, region, neighbour)
            for number, neighbour in self._joined.items()
            if (region := self._regions.get(number)) is not None
        ]


class PersonFollower(RegionFollower[Picture_contra]):
    """Follows one person, who has the number 0, whoever tells."""

    def _is_own(self, number: int) -> bool:
        return True

    def _ordered(self, ordered: Mapping[int, PersonRegion | None]) -> dict[int, PersonRegion | None]:
        """Return the person where the gateway says; where it does not name them, where they were."""
        region = ordered.get(0, self._regions.get(0))
        return {0: region} if 0 in ordered or region is not None else {}

    def _find(self, picture: Picture_contra) -> None:
        """Begin to follow the one nearest to where the person was lost, else the likeliest."""
        if self._regions:
            return
        people, last = self._detector.people(picture), self._last
        if people and last is not None:
            people = [min(people, key=lambda person: float(np.linalg.norm(person.hips - last)))]
        if people:
            self._regions = {0: people[0].region}


class PeopleFollower(RegionFollower[Picture_contra]):
    """Follows several people: those whom the gateway names, and others by numbers of the camera's own."""

    def __init__(
        self, network: Network[Picture_contra], detector: Detector[Picture_contra], most: int
    ) -> None:
        """Follow nobody yet. most: people at once."""
        super().__init__(network, detector)
        self._most = most
        self._since: dict[int, int] = {}  # by number of our own, the picture in which the person was found
        self._looks = self._found = 0

    def _is_own(self, number: int) -> bool:
        return number >= FOUND_BY_CAMERA

    def _ordered(self, ordered: Mapping[int, PersonRegion | None]) -> dict[int, PersonRegion | None]:
        """Return those whom the gateway names, and of our own those who are none of them."""
        kept: dict[int, PersonRegion | None] = {
            number: region
            for number, region in self._regions.items()
            if self._is_own(number) and region is not None and not _is_among(region.centre, ordered)
        }
        return {**ordered, **kept}

    def _find(self, picture: Picture_contra) -> None:
        """Begin to follow newcomers, and leave whom no gateway took for a person."""
        for number, since in list(self._since.items()):
            if number not in self._regions or self._pictures - since > _UNTOLD:
                self._regions.pop(number, None)
                del self._since[number]
        if len(self._regions) >= self._most:
            return
        if any(self._regions.values()) and self._pictures % _LOOK_EVERY:
            return
        for person in self._newcomers(picture):
            if len(self._regions) < self._most and not _is_among(person.hips, self._regions):
                number = FOUND_BY_CAMERA + self._found
                self._found += 1
                self._regions[number] = person.region
                self._since[number] = self._pictures

    def _newcomers(self, picture: Picture_contra) -> list[Person]:
        """Return whom the detector finds: at first everybody at once, which takes long."""
        self._looks += 1
        if self._looks == 1:
            return self._detector.everybody(picture, self._most)
        known = [region for region in self._regions.values() if region is not None]
        return self._detector.newcomers(picture, known, self._looks)


def follower_of(
    network: Network[Picture_contra], detector: Detector[Picture_contra], most: int
) -> RegionFollower[Picture_contra]:
    """Return what follows so many people at the most."""
    return PersonFollower(network, detector) if most == 1 else PeopleFollower(network, detector, most)


class FollowingCameras:
    """The cameras of one process: each follows by itself, and two side by side see somebody who is partly in
    either picture together."""

    def __init__(
        self, names: Sequence[str], network: PoseNetwork, detector: Detector[Picture], most: int
    ) -> None:
        """Follow nobody yet. names: of the cameras, one or two. most: people at once."""
        self._network = network
        self._followers = {name: follower_of(network, detector, most) for name in names}

    def take(self, line: bytes) -> None:
        """Follow as a line of orders says; what is none changes nothing."""
        for name, follower in self._followers.items():
            if orders := read_orders(line, name):
                follower.take(orders)

    def heat_maps(self, pictures: Sequence[Picture]) -> list[dict[int, CameraHeatMaps | None]]:
        """Return by camera the maps of everybody, by number; None of one who is not seen any more."""
        names = list(self._followers)
        seen = [
            follower.heat_maps(picture)
            for follower, picture in zip(self._followers.values(), pictures, strict=True)
        ]
        for row, follower in enumerate(self._followers.values()):
            for number, region, neighbour in follower.joined():
                if neighbour.camera in names:
                    other = names.index(neighbour.camera)
                    affine = np.reshape(neighbour.affine, (2, 3))
                    seen[row][number], seen[other][number] = joined_heat_maps(
                        self._network, pictures[row], pictures[other], region, affine
                    )
        return seen


def _region_of(square: Square | None) -> PersonRegion | None:
    if square is None:
        return None
    x, y, side, turn = square
    return PersonRegion(np.array([x, y]), side, turn)


def _is_among(hips: FloatArray, regions: Mapping[int, PersonRegion | None]) -> bool:
    """Return whether somebody with these hips, (2,) pixels, is one of those in the regions."""
    return any(
        region is not None and float(np.linalg.norm(hips - region.centre)) < _NEAR * region.size
        for region in regions.values()
    )
