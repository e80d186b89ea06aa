"""Cameras that serve the heat maps of several simulated people, as `video serve-camera --people` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from devices.cameras.orders import read_orders
from gateway.body.camera import Camera, project
from gateway.cameras.camera_process import CameraTask, messages_of
from gateway.cameras.people_follower import follower_of
from gateway.emulation.video_truth import RATE_HZ, rendered, true_regions
from gateway.frames import CameraHeatMaps, FloatArray
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.networks.person_detector import Person
from gateway.reconstruction.video.region import PersonRegion

_BESIDE = 0.5
"""Of the likelihood, that keypoints have of people beside the one in the middle."""


class Scene:
    """A camera, network and detector before people whose keypoints (n, n_keypoints, 3) m are known."""

    def __init__(self, camera: Camera, keypoints: KeypointSet) -> None:
        self._camera, self._set = camera, keypoints
        self.keypoints = keypoints.names
        self._hips = [k for k, name in enumerate(keypoints.names) if name.endswith("_hip")]

    def heat_maps(self, people: FloatArray, region: PersonRegion) -> CameraHeatMaps:
        """Return everybody's keypoints in a part of the picture; those of whoever is in its middle are the
        likeliest, for networks such as BlazePose look for one person there."""
        if not len(people):
            return self._maps(np.full((1, len(self.keypoints), 3), np.nan), region)
        hips = [project(self._camera, points[self._hips]).mean(axis=0) for points in people]
        nearest = int(np.argmin(np.linalg.norm(np.array(hips) - region.centre, axis=1)))
        maps = self._maps(people[nearest : nearest + 1], region)
        beside = self._maps(people, region).likelihood * np.float32(_BESIDE)
        return CameraHeatMaps(np.maximum(maps.likelihood, beside), maps.map_from_pixel)

    def _maps(self, people: FloatArray, region: PersonRegion) -> CameraHeatMaps:
        (maps,) = rendered([self._camera], [region], people, 0).cameras
        assert maps is not None
        return maps

    def people(self, people: FloatArray) -> list[Person]:
        """Return whoever is in the picture."""
        found = []
        for points in people:
            (region,) = true_regions([self._camera], self._set, points)
            if region is not None:
                pixels = project(self._camera, points)
                hips, shoulders = (
                    pixels[[k for k, name in enumerate(self.keypoints) if name.endswith(part)]].mean(axis=0)
                    for part in ("_hip", "_shoulder")
                )
                found.append(Person(0.9, hips, shoulders, region.size / 2.5))
        return found

    def everybody(self, people: FloatArray, most: int) -> list[Person]:
        """Return whoever is in the picture."""
        return self.people(people)[:most]

    def newcomers(self, people: FloatArray, known: Sequence[PersonRegion], look: int) -> list[Person]:
        """Return whoever is in the picture."""
        return self.people(people)


class TwiceScene(Scene):
    """The same with a detector that finds everybody twice, a hand's breadth apart."""

    def people(self, people: FloatArray) -> list[Person]:
        """Return whoever is in the picture, and each once more beside."""
        found = super().people(people)
        return [
            replace(person, hips=person.hips + beside, shoulders=person.shoulders + beside)
            for person in found
            for beside in ([0.0, 0.0], [0.55 * person.radius, 0.0])
        ]


class ServedCameras:
    """All cameras of a scene, each of which keeps the orders that it is given."""

    def __init__(
        self, cameras: Sequence[Camera], keypoints: KeypointSet, most: int = 4, scene: type[Scene] = Scene
    ) -> None:
        scenes = [scene(camera, keypoints) for camera in cameras]
        self._tasks = [CameraTask(camera.name, "", "full") for camera in cameras]
        self.followers = [follower_of(scene, scene, most) for scene in scenes]  # type: ignore[arg-type]

    def take(self, line: bytes) -> None:
        """Hand orders to all of them."""
        for task, follower in zip(self._tasks, self.followers, strict=True):
            if orders := read_orders(line, task.name):
                follower.take(orders)

    def messages(self, people: FloatArray, sequence: int) -> list[bytes]:
        """Return what each tells of one instant."""
        time_ns = round(sequence * 1e9 / RATE_HZ)
        return [
            messages_of(follower.heat_maps(people), task, sequence, time_ns)  # type: ignore[arg-type]
            for task, follower in zip(self._tasks, self.followers, strict=True)
        ]
