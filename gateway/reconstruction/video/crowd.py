"""Several people at once: each tracked by continuity in maps from which the others are taken out.

Step 9 of JP2020-042476A: people are told apart when they come, by whoever gives their first positions, and
keep their order from then on.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from gateway.errors import GatewayError
from gateway.frames import FloatArray, HeatMapFrame
from gateway.reconstruction.video.camera import Camera
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.masking import without_others
from gateway.reconstruction.video.reconstructor import Tracking, VideoPose, VideoReconstructor
from gateway.reconstruction.video.tracker import VideoOptions

_SAME_PERSON_M = 0.2
"""Median distance of two people's keypoints of one name below which they are one person: the bodies of two
would stand within each other."""
_SAME_INSTANTS = 5
"""In a row, before two are taken for one."""
_MEMORY = 30
"""Instants over which the share of keypoints that were lost is averaged."""
_SURER = 0.1
"""By which that share must be smaller for a person to be kept in the place of an earlier one."""


class VideoCrowd:
    """As many reconstructors as people. Sans-I/O and deterministic.

    Somebody who was found twice, or something else that was taken for a person and led to one, ends on the
    same body as another, as does one whom the cameras no longer see; the one whose keypoints were lost more
    often is then given up, else the later, so that they do not mask each other for long.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        keypoints: KeypointSet,
        n_people: int,
        options: VideoOptions | None = None,
    ) -> None:
        self._make = partial(VideoReconstructor, cameras, keypoints, options)
        self.people = [self._make() for _ in range(n_people)]
        self.same_as: dict[int, int] = {}
        """People who turned out to be another one, with that one."""
        self._lost = [0.0] * n_people
        self._instants_together: Counter[tuple[int, int]] = Counter()

    def enter(self) -> VideoReconstructor:
        """Add one more person, behind the others in the order."""
        self.people.append(self._make())
        self._lost.append(0.0)
        return self.people[-1]

    def leave(self, index: int) -> None:
        """Forget a person; those behind move up, and who is the same as whom is looked at anew."""
        del self.people[index], self._lost[index]
        self.same_as.clear()
        self._instants_together.clear()

    def update(self, frames: Sequence[HeatMapFrame]) -> list[VideoPose]:
        """Return the poses of one instant: one frame of maps for every person, in the order of the start.

        Raises ``GatewayError`` when their number is not that of the people.
        """
        return self.follow(self.masked(frames))

    def follow(self, masked: Sequence[HeatMapFrame]) -> list[VideoPose]:
        """Return the poses of one instant by frames that ``masked`` gave."""
        poses = [person.update(frame) for person, frame in zip(self.people, masked, strict=True)]
        for index, pose in enumerate(poses):
            share = float((pose.tracking == Tracking.LOST).mean())
            self._lost[index] += (share - self._lost[index]) / _MEMORY
        self._give_up_doubles()
        return poses

    def _give_up_doubles(self) -> None:
        places = {i: p for i, each in enumerate(self.people) if (p := each.expected) is not None}
        left = [index for index in places if index not in self.same_as]
        for first, second in itertools.combinations(left, 2):
            apart = float(np.median(np.linalg.norm(places[first] - places[second], axis=1)))
            pair = first, second
            self._instants_together[pair] = self._instants_together[pair] + 1 if apart < _SAME_PERSON_M else 0
            if self._instants_together[pair] >= _SAME_INSTANTS and not self.same_as.keys() & pair:
                is_second_surer = self._lost[second] + _SURER < self._lost[first]
                kept, given_up = (second, first) if is_second_surer else (first, second)
                self.same_as[given_up] = kept

    def masked(self, frames: Sequence[HeatMapFrame]) -> list[HeatMapFrame]:
        """Return the frames of one instant, from each what is another person's taken out, and left and right
        put right; raises as ``update``."""
        if len(frames) != len(self.people):
            raise GatewayError(f"maps of {len(frames)} people for {len(self.people)} who are tracked")
        expected = [None if i in self.same_as else each.expected for i, each in enumerate(self.people)]
        masked = [self._masked(frame, index, expected) for index, frame in enumerate(frames)]
        return [
            replace(frame, cameras=tuple(person.tracker.put_right(frame.cameras)))
            for person, frame in zip(self.people, masked, strict=True)
        ]

    def _masked(self, frame: HeatMapFrame, index: int, expected: Sequence[FloatArray | None]) -> HeatMapFrame:
        """Return the maps of a person without the others; as they are until all are known; none of one who is
        given up."""
        if index in self.same_as:
            return replace(frame, cameras=(None,) * len(frame.cameras))
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
