"""One person through the pictures of one camera: found by the detector, then followed by the heat maps."""

from __future__ import annotations

import numpy as np

from gateway.reconstruction.video.heat_maps import CameraHeatMaps
from gateway.reconstruction.video.networks.network import Picture, PoseNetwork
from gateway.reconstruction.video.networks.person_detector import Person, PersonDetector
from gateway.reconstruction.video.region import PersonRegion, region_of_maps


class PersonFollower:
    """Keeps the region of its person from picture to picture."""

    def __init__(self, network: PoseNetwork, detector: PersonDetector) -> None:
        self._network = network
        self._detector = detector
        self._region: PersonRegion | None = None
        self._last: PersonRegion | None = None

    def people(self, picture: Picture) -> list[Person]:
        """Everybody in a picture, the likeliest first."""
        return self._detector.people(picture)

    def follow(self, region: PersonRegion) -> None:
        """Take the person of that region from now on."""
        self._region = region

    def heat_maps(self, picture: Picture) -> CameraHeatMaps | None:
        """Of the person; None when nobody is seen. One who was lost is looked for where they were last."""
        if self._region is None:
            self._region = self._found(picture)
        if self._region is None:
            return None
        maps = self._network.heat_maps(picture, self._region)
        self._last = self._region
        self._region = region_of_maps(maps, self._network.keypoints)
        return None if self._region is None else maps

    def _found(self, picture: Picture) -> PersonRegion | None:
        people = self._detector.people(picture)
        if not people:
            return None
        last = self._last
        if last is None:
            return people[0].region
        nearest = min(people, key=lambda person: float(np.linalg.norm(person.hips - last.centre)))
        return nearest.region
