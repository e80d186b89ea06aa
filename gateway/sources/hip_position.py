"""Cameras as a local measuring device: the middle of the hips is a position of the root."""

from __future__ import annotations

from typing import Self

import numpy as np

from devices.link import Chunk
from gateway.assembly.heat_map_frames import HeatMapFrames
from gateway.body.skeleton import CameraPosition, WornSuit
from gateway.frames import LocalReading, Quantity
from gateway.geometry import rotation_matrix
from gateway.reconstruction.video.reconstructor import VideoPose

HIPS = ("left_hip", "right_hip")


class HipPosition:
    """Heat maps in, position readings out. Sans-I/O and deterministic."""

    def __init__(self, cameras: CameraPosition, frames: HeatMapFrames) -> None:
        """frames: of the cameras' person."""
        assert cameras.person.markers is not None  # a subject has its keypoints
        self._cameras = cameras
        self._frames = frames
        self.readings = 0
        """Given so far."""
        self._rows = [cameras.person.markers.labels.index(label) for label in HIPS]
        self._turn = rotation_matrix.from_rotation_vector(np.array([0.0, 0.0, cameras.turn_rad]))

    @classmethod
    def of(cls, suit: WornSuit, frames: HeatMapFrames | None) -> Self | None:
        """That of a suit; None: it has no cameras for a local device."""
        cameras = suit.camera_position
        return None if cameras is None or frames is None else cls(cameras, frames)

    def receive(self, chunk: Chunk) -> list[LocalReading]:
        """A reading for every instant of the chunk in which both hips are seen."""
        found = map(self._reading, self._frames.poses(chunk))
        readings = [reading for reading in found if reading is not None]
        self.readings += len(readings)
        return readings

    def _reading(self, pose: VideoPose) -> LocalReading | None:
        """Not smoothed: what follows weighs readings by their sigma, and knows nothing of a delay.

        None: a hip is lost, and its place would be the body's guess.
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
