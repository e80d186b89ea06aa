"""Several people at once: each tracked by continuity in maps from which the others are taken out.

Step 9 of JP2020-042476A: people are told apart at the start, by whoever gives their first positions, and keep
their place in the order from then on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gateway.errors import GatewayError
from gateway.frames import FloatArray, HeatMapFrame
from gateway.reconstruction.video.camera import Camera
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.masking import without_others
from gateway.reconstruction.video.reconstructor import VideoPose, VideoReconstructor
from gateway.reconstruction.video.tracker import VideoOptions


class VideoCrowd:
    """As many reconstructors as people. Sans-I/O and deterministic."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        keypoints: KeypointSet,
        n_people: int,
        options: VideoOptions | None = None,
    ) -> None:
        self.people = [VideoReconstructor(cameras, keypoints, options) for _ in range(n_people)]

    def update(self, frames: Sequence[HeatMapFrame]) -> list[VideoPose]:
        """The poses of one instant: one frame of maps for every person, in the order of the start.

        Raises ``GatewayError`` when their number is not that of the people.
        """
        return [person.update(frame) for person, frame in zip(self.people, self.masked(frames), strict=True)]

    def masked(self, frames: Sequence[HeatMapFrame]) -> list[HeatMapFrame]:
        """The frames of one instant, from each what is another person's taken out, and left and right put
        right; raises as ``update``."""
        if len(frames) != len(self.people):
            raise GatewayError(f"maps of {len(frames)} people for {len(self.people)} who are tracked")
        expected = [person.expected for person in self.people]
        masked = [self._masked(frame, index, expected) for index, frame in enumerate(frames)]
        return [
            replace(frame, cameras=tuple(person.tracker.put_right(frame.cameras)))
            for person, frame in zip(self.people, masked, strict=True)
        ]

    def _masked(self, frame: HeatMapFrame, index: int, expected: Sequence[FloatArray | None]) -> HeatMapFrame:
        """The maps of a person without the others; as they are until all are known."""
        own = expected[index]
        others = [points for i, points in enumerate(expected) if i != index and points is not None]
        if own is None or not others:
            return frame
        cameras = self.people[index].cameras
        maps = tuple(
            seen if seen is None else without_others(camera, seen, own, others)
            for camera, seen in zip(cameras, frame.cameras, strict=True)
        )
        return replace(frame, cameras=maps)
