"""One person through the pictures of one camera: found by the detector, then followed by the heat maps, or
wherever the pose that all cameras together give says that the person is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gateway.frames import CameraHeatMaps, FloatArray
from gateway.reconstruction.video.networks.network import Picture, PoseNetwork
from gateway.reconstruction.video.networks.person_detector import PersonDetector
from gateway.reconstruction.video.region import PersonRegion, region_of_maps


@dataclass(frozen=True, slots=True)
class Order:
    """Where one person will be in one picture of one camera, as far as the pose tells."""

    is_ordered: bool = False
    """False: no pose is known, the camera follows by itself."""
    region: PersonRegion | None = None
    """Told None: the camera does not see the person."""
    joined: FloatArray | None = None
    """(2, 3) pixel of the neighbouring camera's picture to pixel of this one's, about the person, who is
    in both: see ``stitching``. None: this picture alone."""


class PersonFollower:
    """Keeps the region of its person from picture to picture."""

    def __init__(self, network: PoseNetwork, detector: PersonDetector) -> None:
        self._network = network
        self._detector = detector
        self._region: PersonRegion | None = None
        self._last: PersonRegion | None = None

    def heat_maps(self, picture: Picture, order: Order | None = None) -> CameraHeatMaps | None:
        """Return the maps of the person; None when nobody is seen. One who was lost is looked for where they
        were last."""
        if order is not None and order.is_ordered:
            self._region = order.region
            if order.region is None:
                return None
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
