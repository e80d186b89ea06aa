"""Heat maps of all cameras to the skeleton of one person, frame by frame: steps 3 to 7 of JP2020-042476A."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, SkeletonFrame, Status
from gateway.geometry import quaternion
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.pose_solver import HELD_SIGMA
from gateway.reconstruction.optical.rates import Rates
from gateway.reconstruction.optical.tracking import rigid
from gateway.reconstruction.video import initial, lattice
from gateway.reconstruction.video.camera import Camera
from gateway.reconstruction.video.heat_maps import HeatMapFrame
from gateway.reconstruction.video.inverse_kinematics import (
    VideoBody,
    VideoBodyPose,
    keypoint_places,
    solve,
    video_body,
)
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.low_pass import DELAY, LowPass
from gateway.reconstruction.video.projection import camera_model
from gateway.reconstruction.video.proportions import part_lengths, sized
from gateway.reconstruction.video.region import PersonRegion
from gateway.reconstruction.video.regions import person_region

HALF_WIDTH = 5
"""k of the source: a lattice has (2 k + 1)³ points."""
COARSE = 0.020
"""Spacing of the first lattice, m."""
FINE = 0.004
"""Spacing of the second, m."""
LEAST_MEAN = 0.2
"""Summed PCM over the number of cameras, under which a keypoint counts as lost."""
WIDEST = 3
"""Times the coarse spacing, that the lattice of a lost keypoint grows to."""
SIZING_FRAMES = 20
"""First frames from which the lengths of the parts are taken."""
_STEPS = 8
_FIRST_STEPS = 40
_TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")


class Tracking(IntEnum):
    """How a keypoint is known."""

    TRACKED = 0
    LOST = 1
    """Too unlikely wherever it was looked for: where it is follows from the rest of the body."""


@dataclass(frozen=True)
class VideoPose:
    """A person at one instant."""

    sequence: int
    time_ns: int
    newest: SkeletonFrame
    """The pose of this instant, not smoothed."""
    skeleton: SkeletonFrame | None
    """The smoothed pose of ``DELAY`` frames before, with that instant's time; None until there is one."""
    candidates: FloatArray
    """(n_keypoints, 3) m, what the cameras say; NaN: lost."""
    keypoints: FloatArray
    """(n_keypoints, 3) m, where the body has them; NaN before a person was found."""
    likelihood: FloatArray
    """(n_keypoints,) summed PCM at the candidates, 0 to the number of cameras."""
    tracking: NDArray[np.uint8]
    """(n_keypoints,) ``Tracking``."""
    regions: tuple[PersonRegion | None, ...]
    """For each camera where the person will be in the next picture; None: it does not see the person."""


@dataclass(frozen=True)
class VideoOptions:
    """What may be chosen of the method."""

    floor_m: float | None = 0.0
    """Height of the floor; None: there is none."""
    cluster: bool = True
    """Candidates by 7-point clusters, else by single points."""
    weighted: bool = True
    """Inverse kinematics weighted by the summed PCM, else uniformly."""
    use_dlt: bool = False
    """First positions over all cameras, else by the closest pair of rays."""
    is_measured: bool = False
    """Whether the keypoint set's skeleton is this person's already; else its lengths follow from the first
    frames."""


class VideoReconstructor:
    """One person from synchronised heat maps. Sans-I/O and deterministic."""

    def __init__(
        self, cameras: Sequence[Camera], keypoints: KeypointSet, options: VideoOptions | None = None
    ) -> None:
        self.cameras = tuple(cameras)
        self.keypoints = keypoints
        self.options = options or VideoOptions()
        self._models = tuple(camera_model(camera) for camera in cameras)
        self._floor = -np.inf if self.options.floor_m is None else self.options.floor_m
        self._trunk = [keypoints.index(name) for name in _TRUNK]
        self._low_pass = LowPass()
        self._rates = Rates()
        self._set_lengths(np.full(len(part_lengths(keypoints, np.zeros((len(keypoints.names), 3)))), np.nan))
        self._lengths: list[FloatArray] = []
        self.reset()

    def reset(self) -> None:
        """Forget the person's pose; the lengths stay."""
        self._pose: VideoBodyPose | None = None
        self._before: FloatArray | None = None
        self._missed = np.zeros(len(self.keypoints.names), dtype=np.int64)
        self._waiting: deque[tuple[SkeletonFrame, VideoBodyPose]] = deque(maxlen=DELAY + 1)
        self._low_pass.reset()
        self._rates.reset()

    @property
    def skeleton(self) -> Skeleton:
        """The body with this person's lengths, as far as they are known."""
        return self._skeleton

    @property
    def person(self) -> KeypointSet:
        """The keypoints on this person's body, as far as its lengths are known."""
        return replace(self.keypoints, skeleton=self._skeleton, markers=self._markers)

    def _set_lengths(self, lengths: FloatArray) -> None:
        if self.options.is_measured:
            self._skeleton, self._markers = self.keypoints.skeleton, self.keypoints.markers
        else:
            self._skeleton, self._markers = sized(self.keypoints, lengths)
        self._body: VideoBody = video_body(self._skeleton, self._markers)

    def update(self, frame: HeatMapFrame) -> VideoPose:
        """The pose of one instant."""
        n = len(self.keypoints.names)
        if self._pose is None:
            candidates, likelihood = self._first(frame)
        else:
            candidates, likelihood = self._search(frame)
        lost = ~np.isfinite(candidates[:, 0])
        self._missed = np.where(lost, self._missed + 1, 0)
        if self._pose is None:
            return self._nobody(frame, n)
        if len(self._lengths) < SIZING_FRAMES:
            self._lengths.append(part_lengths(self.keypoints, candidates))
            self._set_lengths(np.nanmedian(np.array(self._lengths), axis=0))
            self._solve(candidates, likelihood, _STEPS)
        return self._result(frame, candidates, likelihood, lost)

    def _first(self, frame: HeatMapFrame) -> tuple[FloatArray, FloatArray]:
        points, likelihood = initial.from_rays(self._models, frame.cameras, self.options.use_dlt)
        if len(points) == 0:
            n = len(self.keypoints.names)
            return np.full((n, 3), np.nan), np.zeros(n)
        points = initial.within_person(points)
        if np.isfinite(points[self._trunk, 0]).sum() < 3:
            return np.full_like(points, np.nan), likelihood
        self._set_lengths(part_lengths(self.keypoints, points))
        neutral = np.tile(quaternion.to_matrix(self._skeleton.neutral), (self._skeleton.n_segments, 1, 1))
        standing = keypoint_places(self._body.model, neutral, np.zeros(3))
        turn, shift = rigid(standing[self._trunk], points[self._trunk])
        self._pose = VideoBodyPose(turn @ neutral, shift, 0)
        self._solve(points, np.where(np.isfinite(points[:, 0]), 1.0, 0.0), _FIRST_STEPS)
        return self._search(frame)

    def _search(self, frame: HeatMapFrame) -> tuple[FloatArray, FloatArray]:
        """Both lattices, with inverse kinematics after each."""
        expected = self._predicted()
        wide = np.minimum(1 + self._missed, WIDEST).astype(np.float64)
        found, likelihood = self._candidates(frame, expected, COARSE * wide, False)
        self._solve(found, likelihood, _STEPS)
        found, likelihood = self._candidates(frame, found, np.full(len(found), FINE), True)
        self._solve(found, likelihood, _STEPS)
        return found, likelihood

    def _candidates(
        self, frame: HeatMapFrame, centres: FloatArray, spacing: FloatArray, is_fine: bool
    ) -> tuple[FloatArray, FloatArray]:
        total = np.zeros((len(centres), (2 * HALF_WIDTH + 1) ** 3))
        n_cameras = 0
        for model, seen in zip(self._models, frame.cameras, strict=True):
            if seen is not None:
                n_cameras += 1
                lattice.add_likelihood(
                    total, model, seen.likelihood, seen.map_from_pixel, centres, spacing, HALF_WIDTH, is_fine
                )
        found, likelihood = lattice.best_points(total, centres, spacing, HALF_WIDTH, self.options.cluster)
        lost = likelihood < LEAST_MEAN * max(n_cameras, 1)
        found[lost] = np.nan
        return found, likelihood

    def _predicted(self) -> FloatArray:
        assert self._pose is not None
        now = keypoint_places(self._body.model, self._pose.R, self._pose.root)
        if self._before is None:
            return now
        return now + (now - self._before)

    def _solve(self, targets: FloatArray, likelihood: FloatArray, steps: int) -> None:
        assert self._pose is not None
        weights = likelihood if self.options.weighted else np.ones(len(likelihood))
        weights = np.where(np.isfinite(targets[:, 0]), weights, 0.0)
        self._pose = solve(
            self._body, targets, weights, self._pose.R, self._pose.root, self._pose.R, HELD_SIGMA**-2,
            self._floor, steps,
        )  # fmt: skip

    def _result(
        self, frame: HeatMapFrame, candidates: FloatArray, likelihood: FloatArray, lost: NDArray[np.bool_]
    ) -> VideoPose:
        assert self._pose is not None
        places = keypoint_places(self._body.model, self._pose.R, self._pose.root)
        newest = self._frame(frame.sequence, frame.time_ns, self._pose, lost)
        self._waiting.append((newest, self._pose))
        smoothed = self._smoothed(places)
        ahead = places if self._before is None else 2 * places - self._before
        self._before = places
        regions = tuple(person_region(camera, ahead, self.keypoints.names) for camera in self.cameras)
        return VideoPose(
            frame.sequence, frame.time_ns, newest, smoothed, candidates, places, likelihood,
            lost.astype(np.uint8), regions,
        )  # fmt: skip

    def _smoothed(self, places: FloatArray) -> SkeletonFrame | None:
        targets = self._low_pass.add(places)
        if len(self._waiting) <= DELAY:
            return None
        frame, pose = self._waiting[0]
        smooth = solve(
            self._body, targets, np.ones(len(targets)), pose.R, pose.root, pose.R, HELD_SIGMA**-2,
            self._floor, _STEPS,
        )  # fmt: skip
        p_w = self._joints(smooth)
        rate, acceleration = self._rates.add(frame.time_ns, smooth.R, p_w)
        return SkeletonFrame(
            frame.sequence, frame.time_ns, np.stack([quaternion.from_matrix(each) for each in smooth.R]),
            rate, acceleration, p_w, frame.sigma, frame.status, 0,
        )  # fmt: skip

    def _frame(
        self, sequence: int, time_ns: int, pose: VideoBodyPose, lost: NDArray[np.bool_]
    ) -> SkeletonFrame:
        n = self._skeleton.n_segments
        shown = self.keypoints.shows[~lost].any(axis=0)
        unknown = np.full((n, 3), np.nan)
        return SkeletonFrame(
            sequence, time_ns, np.stack([quaternion.from_matrix(each) for each in pose.R]), unknown,
            unknown.copy(), self._joints(pose), np.full(n, np.nan),
            np.where(shown, Status.MEASURED, Status.PREDICTED).astype(np.uint8), 0,
        )  # fmt: skip

    def _joints(self, pose: VideoBodyPose) -> FloatArray:
        """(n_segments, 3) m, where the proximal joints are."""
        return kernels.places(self._body.model.parents, self._body.model.offsets, pose.R, pose.root)

    def _nobody(self, frame: HeatMapFrame, n: int) -> VideoPose:
        s = self._skeleton.n_segments
        unknown = np.full((s, 3), np.nan)
        nothing = SkeletonFrame(
            frame.sequence, frame.time_ns, np.full((s, 4), np.nan), unknown, unknown.copy(), unknown.copy(),
            np.full(s, np.nan), np.full(s, Status.MISSING, dtype=np.uint8), 0,
        )  # fmt: skip
        return VideoPose(
            frame.sequence, frame.time_ns, nothing, None, np.full((n, 3), np.nan), np.full((n, 3), np.nan),
            np.zeros(n), np.full(n, Tracking.LOST, dtype=np.uint8), tuple(None for _ in self.cameras),
        )  # fmt: skip
