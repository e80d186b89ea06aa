"""Heat maps of all cameras to the skeleton of one person, frame by frame: steps 3 to 7 of JP2020-042476A."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from gateway.body.body_file import WorldSettings, worn_without_modules
from gateway.body.camera import Camera
from gateway.body.skeleton import Skeleton, VideoSetUp, WornSuit
from gateway.frames import FloatArray, HeatMapFrame, SkeletonFrame, unknown_pose
from gateway.reconstruction.video.keypoint_set import KeypointSet, load_keypoint_set
from gateway.reconstruction.video.networks.weights import keypoint_set_of
from gateway.reconstruction.video.posing import PoseSmoother, skeleton_frame, statuses
from gateway.reconstruction.video.region import PersonRegion, person_region
from gateway.reconstruction.video.tracker import KeypointTracker, VideoOptions

__all__ = [
    "Tracking",
    "VideoOptions",
    "VideoPose",
    "VideoReconstructor",
    "video_reconstructor",
    "worn_person",
]


class Tracking(IntEnum):
    """How a keypoint is known."""

    TRACKED = 0
    LOST = 1
    """Too unlikely wherever it was looked for: where it is follows from the rest of the body."""
    RECOVERED = 2
    """Tracked again, for the first frame after it was lost."""


@dataclass(frozen=True)
class VideoPose:
    """A person at one instant."""

    sequence: int
    time_ns: int
    newest: SkeletonFrame
    """The pose of this instant, not smoothed; NaN while no person is known."""
    skeleton: SkeletonFrame | None
    """The smoothed pose of three frames before (``low_pass.DELAY``), dated then; None until there is one."""
    candidates: FloatArray
    """(n_keypoints, 3) m, what the cameras say; NaN: lost."""
    keypoints: FloatArray
    """(n_keypoints, 3) m, where the body has them; NaN while no person is known."""
    likelihood: FloatArray
    """(n_keypoints,) summed PCM at the candidates, 0 to the number of cameras."""
    tracking: NDArray[np.uint8]
    """(n_keypoints,) ``Tracking``."""
    regions: tuple[PersonRegion | None, ...]
    """For each camera where the person will be in the next picture; None: it does not see the person."""


class VideoReconstructor:
    """One person from synchronised heat maps. Sans-I/O and deterministic.

    The lengths of the body settle over the first frames (``tracker.SIZING_FRAMES``); to have them constant
    from the first frame on, give a first run's ``person`` as the keypoints, with ``is_measured``.
    """

    def __init__(
        self, cameras: Sequence[Camera], keypoints: KeypointSet, options: VideoOptions | None = None
    ) -> None:
        self.cameras = tuple(cameras)
        self.keypoints = keypoints
        self.tracker = KeypointTracker(cameras, keypoints, options or VideoOptions())
        self.sequence = -1
        """Of the last instant; -1: there was none."""
        self._smoothed = PoseSmoother()
        self._lost = np.zeros(len(keypoints.names), dtype=bool)

    def reset(self) -> None:
        """Forget the person's pose; the lengths stay."""
        self.tracker.reset()
        self._smoothed.reset()
        self._lost[:] = False

    @property
    def skeleton(self) -> Skeleton:
        """The body with this person's lengths, as far as they are known."""
        return self.person.skeleton

    @property
    def person(self) -> KeypointSet:
        """The keypoints on this person's body, as far as its lengths are known."""
        return self.tracker.person

    def update(self, frame: HeatMapFrame) -> VideoPose:
        """Return the pose of one instant. Without any maps the last pose is held; before the first, NaN."""
        sighting = self.tracker.track(frame.cameras)
        self.sequence = frame.sequence
        pose = self.tracker.pose
        if pose is None:
            self._smoothed.reset()
            return self._nobody(frame)
        newest = skeleton_frame(
            frame.sequence, frame.time_ns, self.tracker.body, pose, self.tracker.orientation_sigmas(sighting),
            statuses(self.keypoints.shows, sighting.lost),
        )  # fmt: skip
        tracking = np.where(sighting.lost, Tracking.LOST, np.where(self._lost, Tracking.RECOVERED, 0))
        self._lost = sighting.lost
        expected = self.tracker.expected_after(1)
        assert expected is not None  # there is a pose
        return VideoPose(
            sequence=frame.sequence,
            time_ns=frame.time_ns,
            newest=newest,
            skeleton=self._smoothed.add(newest, self.tracker.body, pose, self.tracker.floor),
            candidates=sighting.candidates,
            keypoints=self.tracker.places,
            likelihood=sighting.likelihood,
            tracking=tracking.astype(np.uint8),
            regions=tuple(person_region(camera, expected, self.keypoints.names) for camera in self.cameras),
        )

    def finish(self) -> list[SkeletonFrame]:
        """Return the smoothed frames that were still to come when the last pictures had been seen."""
        return self._smoothed.rest(self.tracker.body, self.tracker.floor)

    def _nobody(self, frame: HeatMapFrame) -> VideoPose:
        n = len(self.keypoints.names)
        unknown = np.full((n, 3), np.nan)
        self._lost = np.zeros(n, dtype=bool)
        return VideoPose(
            sequence=frame.sequence,
            time_ns=frame.time_ns,
            newest=unknown_pose(self.skeleton.n_segments, frame.sequence, frame.time_ns),
            skeleton=None,
            candidates=unknown,
            keypoints=unknown.copy(),
            likelihood=np.zeros(n),
            tracking=np.full(n, Tracking.LOST, dtype=np.uint8),
            regions=tuple(None for _ in self.cameras),
        )


def worn_person(person: KeypointSet, video: VideoSetUp) -> WornSuit:
    """Return what a gateway needs of a person whose lengths are known, before those cameras."""
    return replace(worn_without_modules(person.skeleton, person.markers, WorldSettings()), video=video)


def video_reconstructor(suit: WornSuit) -> VideoReconstructor:
    """Return a reconstructor of the person that a suit with cameras tells of, whose lengths are known."""
    assert suit.video is not None
    assert suit.markers is not None
    keypoints = load_keypoint_set(keypoint_set_of(suit.video.network))
    person = replace(keypoints, skeleton=suit.skeleton, markers=suit.markers)
    return VideoReconstructor(suit.video.cameras, person, VideoOptions(is_measured=True))
