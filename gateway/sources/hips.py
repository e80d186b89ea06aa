"""Cameras as a local measuring device: the middle of the hips is a position of the root."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from devices.link import Chunk
from gateway.body.skeleton import CameraPosition
from gateway.contract.balances import Balance
from gateway.frames import LocalReading, Quantity
from gateway.geometry import rotation_matrix
from gateway.reconstruction.video.reconstructor import VideoPose, video_reconstructor
from gateway.sources.heat_maps import HeatMapSource
from gateway.sources.source import ListeningSource

HIPS = ("left_hip", "right_hip")


class HipSource(ListeningSource):
    """Heat maps in, position readings out: cameras that look on somebody with modules."""

    observes = LocalReading

    def __init__(self, cameras: CameraPosition) -> None:
        assert cameras.person.markers is not None  # a subject has its keypoints
        self._cameras = cameras
        self._frames = HeatMapSource(cameras.person)
        self._reconstructor = video_reconstructor(cameras.person)
        self._readings = 0
        self._rows = [cameras.person.markers.labels.index(label) for label in HIPS]
        self._turn = rotation_matrix.from_rotation_vector(np.array([0.0, 0.0, cameras.turn_rad]))

    def add_link(self, name: str, content: str) -> None:
        """Announce a link."""
        self._frames.add_link(name, content)

    def receive(self, chunk: Chunk) -> list[LocalReading]:
        """Return a reading for every instant of the chunk in which both hips are seen."""
        poses = map(self._reconstructor.update, self._frames.receive(chunk))
        readings = [reading for reading in map(self._reading, poses) if reading is not None]
        self._readings += len(readings)
        return readings

    def dropped(self) -> Mapping[str, Mapping[str, int]]:
        """Return what could not be read or used, by link and reason."""
        return self._frames.dropped()

    def statistics(self) -> Mapping[str, object]:
        """Return what became of the messages."""
        return self._frames.statistics()

    def balances(self) -> Iterator[Balance]:
        """Yield the readings given."""
        yield Balance("readings", self._readings, {})

    def _reading(self, pose: VideoPose) -> LocalReading | None:
        """Return the middle of the hips as a position of the root, m, in world axes; None if one is lost.

        It is not smoothed: the filter that takes it weighs readings by their sigma, and would take
        smoothing for a delay. A lost hip is not filled in: its place would be the body model's guess.
        """
        hips = pose.candidates[self._rows].mean(axis=0)
        if not np.isfinite(hips).all() or not np.isfinite(pose.keypoints).all():
            return None
        return LocalReading(
            self._cameras.device,
            pose.time_ns - self._cameras.latency_ns,
            Quantity.POSITION,
            self._turn @ hips,
            np.full(3, self._cameras.sigma_m),
        )
