"""One person's keypoints and pose from frame to frame: steps 3 to 5 of JP2020-042476A."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gateway.body.camera import Camera
from gateway.frames import CameraHeatMaps, FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.optical.pose_solver import HELD_SIGMA, Held
from gateway.reconstruction.optical.tracking import rigid
from gateway.reconstruction.video import initial, lattice, one_camera
from gateway.reconstruction.video.inverse_kinematics import (
    Goal,
    VideoBody,
    VideoBodyPose,
    orientation_sigmas,
    solve,
    video_body,
)
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.projection import camera_model
from gateway.reconstruction.video.proportions import PARTS, part_lengths, sized, standard_lengths
from gateway.reconstruction.video.sides import pairs_of, sides_put_right

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
PATIENCE = 30
"""Frames without any keypoint of the trunk after which the person is sought anew."""
TRUNK = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
_BELOW_FLOOR = 0.25
"""Of the lowest keypoint at the start, from which the floor told cannot be the person's, m."""
_VOLUME_CELL = 0.08
_STEPS = 8
_FIRST_STEPS = 40

CameraMaps = Sequence[CameraHeatMaps | None]
"""Of one person, in the order of the cameras; None for one that has none."""


@dataclass(frozen=True)
class VideoOptions:
    """What may be chosen of the method."""

    floor_m: float | None = 0.0
    """Height of the floor; None: there is none."""
    is_measured: bool = False
    """Whether the keypoint set's skeleton is this person's already; else its lengths follow from the first
    frames."""


@dataclass(frozen=True)
class Sighting:
    """What the cameras say of one person at one instant."""

    candidates: FloatArray
    """(n_keypoints, 3) m; NaN: lost."""
    likelihood: FloatArray
    """(n_keypoints,) summed PCM, 0 to the number of cameras."""

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(n_keypoints,) too unlikely wherever they were looked for."""
        return np.isnan(self.candidates[:, 0])


class KeypointTracker:
    """Finds a person, then looks for every keypoint where the body, moving on, will have it."""

    def __init__(self, cameras: Sequence[Camera], keypoints: KeypointSet, options: VideoOptions) -> None:
        self.keypoints = keypoints
        self.options = options
        self.floor = -np.inf if options.floor_m is None else options.floor_m
        """m; minus infinity: none, or not the person's, who was found far below it."""
        self.pose: VideoBodyPose | None = None
        """The last pose; None: no person is known."""
        self._models = tuple(camera_model(camera) for camera in cameras)
        self._trunk = [keypoints.index(name) for name in TRUNK]
        self._pairs = pairs_of(keypoints.names)
        self._lengths: list[FloatArray] = []
        self.person = keypoints
        """The keypoints on this person's body, as far as its lengths are known."""
        self.body: VideoBody = video_body(keypoints.skeleton, keypoints.markers)
        self._settled = options.is_measured
        self.reset()

    def reset(self) -> None:
        """Forget the pose; the lengths stay."""
        self.pose = None
        self._places: list[FloatArray] = []
        self._missed = np.zeros(len(self.keypoints.names), dtype=np.int64)

    def _set_lengths(self, lengths: FloatArray) -> None:
        """Take the parts of the body, (n_parts,) m in the order of ``PARTS``, as told; NaN: as the rest."""
        skeleton, markers = sized(self.keypoints, lengths)
        self.person = replace(self.keypoints, skeleton=skeleton, markers=markers)
        self.body = video_body(skeleton, markers)

    def keep_lengths(self) -> None:
        """Measure the person no more: the lengths are those of the body now."""
        self._settled = True

    @property
    def is_settled(self) -> bool:
        """Whether the lengths of the body are known, and change no more."""
        return self._settled

    @property
    def places(self) -> FloatArray:
        """(n_keypoints, 3) m, where the body has its keypoints. Only with a pose."""
        assert self.pose is not None
        return self.body.model.markers_at(self.pose.R, self.pose.root)

    @property
    def joints(self) -> FloatArray:
        """(S, 3) m, of every segment the proximal one. Only with a pose."""
        assert self.pose is not None
        return self.body.model.joints_at(self.pose.R, self.pose.root)

    @property
    def lost(self) -> float:
        """Share of the keypoints that the last instant did not show; 1 while no person is known."""
        return 1.0 if self.pose is None else float((self._missed > 0).mean())

    def expected_after(self, frames: int) -> FloatArray | None:
        """Return (n_keypoints, 3) m, where they will be so many frames later, going on as they went; None: no
        person is known."""
        return None if self.pose is None else self._ahead(frames)

    def _ahead(self, frames: int) -> FloatArray:
        if len(self._places) < 2:
            return self.places
        return self._places[-1] + frames * (self._places[-1] - self._places[-2])

    def put_right(self, maps: CameraMaps) -> CameraMaps:
        """Return the maps with left and right exchanged where a camera has taken them for each other."""
        if self.pose is None:
            return maps
        return sides_put_right(self._models, maps, self._ahead(1), self._pairs)

    def track(self, maps: CameraMaps) -> Sighting:
        """Find the person in one frame, and keep the pose."""
        sighting = self._first(maps) if self.pose is None else self._search(maps)
        self._missed = np.where(sighting.lost, self._missed + 1, 0)
        if self.pose is None:
            return sighting
        if self._missed[self._trunk].min() > PATIENCE:
            self.reset()
            return sighting
        if not self._settled:
            self._measure(sighting)
        self._places = [*self._places[-1:], self.places]
        return sighting

    def solve(self, sighting: Sighting, steps: int = _STEPS) -> None:
        """Find the pose by inverse kinematics from the last one, which what is not seen is drawn to."""
        assert self.pose is not None
        held = Held(self.pose.R, HELD_SIGMA**-2)
        goal = Goal(sighting.candidates, np.where(sighting.lost, 0.0, sighting.likelihood), held, self.floor)
        self.pose = solve(self.body, goal, self.pose.R, self.pose.root, steps)

    def orientation_sigmas(self, sighting: Sighting) -> FloatArray:
        """Return (S,) rad of the last pose, by what is seen of it."""
        assert self.pose is not None
        weights = np.where(sighting.lost, 0.0, sighting.likelihood)
        return orientation_sigmas(self.body, sighting.candidates, weights, self.pose, HELD_SIGMA**-2)

    def _first(self, maps: CameraMaps) -> Sighting:
        """Find a person from nothing but maps: rays, what they leave open from the volume, and a first
        pose."""
        n = len(self.keypoints.names)
        nobody = Sighting(np.full((n, 3), np.nan), np.zeros(n))
        if len(maps) == 1:
            return self._first_alone(maps) or nobody
        if sum(seen is not None for seen in maps) < 2:
            return nobody
        points, _ = initial.from_rays(self._models, maps)
        points = initial.within_person(points)
        if np.isnan(points[self._trunk, 0]).sum() > 1:
            points = self._completed(maps, points)
        if np.isnan(points[self._trunk, 0]).sum() > 1:
            return nobody
        self._stand_up(points)
        return self._search(maps)

    def _first_alone(self, maps: CameraMaps) -> Sighting | None:
        """Do the same with one camera: depth by the floor, one ratio for all lengths."""
        if maps[0] is None or not np.isfinite(self.floor):
            return None
        points = one_camera.from_floor(self._models[0], maps[0], self.keypoints.names, self.floor)
        if np.isnan(points[self._trunk, 0]).any():
            return None
        if not self._settled:
            seen = part_lengths(self.keypoints, points)
            self._set_lengths(one_camera.lengths_shown(seen, standard_lengths(self.keypoints)))
            self._settled = True
        self._stand_up(points)
        return self._search(maps)

    def _completed(self, maps: CameraMaps, points: FloatArray) -> FloatArray:
        """Return points, those of the trunk by the best cells of what the cameras' maps show together, and
        others where they can be of the same person."""
        centre = initial.middle_of_views(self._models, maps)
        if not np.isfinite(centre).all():
            return points
        is_trunk = np.zeros(len(points), dtype=np.bool_)
        is_trunk[self._trunk] = True
        cells, likely = initial.from_volume(
            self._models, maps, centre, initial.PERSON_RADIUS, _VOLUME_CELL, is_trunk
        )
        n_cameras = sum(seen is not None for seen in maps)
        good = is_trunk & (likely > LEAST_MEAN * n_cameras)
        if good.sum() < len(self._trunk) - 1:
            return points
        return initial.within_person(np.where(good[:, None], cells, points), good)

    def _stand_up(self, points: FloatArray) -> None:
        """Lay the standard body over the points of the trunk, size it, and bend it to all of them."""
        if not self._settled:
            self._set_lengths(part_lengths(self.keypoints, points))
        lowest = float(np.nanmin(points[:, 2]))
        if lowest < self.floor - _BELOW_FLOOR:
            self.floor = -np.inf
        skeleton = self.person.skeleton
        neutral = np.tile(quaternion.to_matrix(skeleton.neutral), (skeleton.n_segments, 1, 1))
        standing = self.body.model.markers_at(neutral, np.zeros(3))
        turn, shift = rigid(standing[self._trunk], points[self._trunk])
        self.pose = VideoBodyPose(turn @ neutral, shift, 0)
        self.solve(Sighting(points, np.ones(len(points))), _FIRST_STEPS)

    def _search(self, maps: CameraMaps) -> Sighting:
        """Search both lattices, with inverse kinematics after each."""
        wide = np.minimum(1 + self._missed, WIDEST).astype(np.float64)
        # one camera tells no depth: going on as it went, the body would leave for nowhere
        alone = sum(seen is not None for seen in maps) < 2
        expected = self.places if alone else self._ahead(1)
        maps = sides_put_right(self._models, maps, expected, self._pairs)
        coarse = self._candidates(maps, expected, COARSE * wide, False)
        self.solve(coarse)
        fine = self._candidates(maps, coarse.candidates, np.full(len(wide), FINE), True)
        self.solve(fine)
        return fine

    def _candidates(
        self, maps: CameraMaps, centres: FloatArray, spacing: FloatArray, is_fine: bool
    ) -> Sighting:
        total = np.zeros((len(centres), (2 * HALF_WIDTH + 1) ** 3))
        lattices = lattice.Lattices(centres, spacing, HALF_WIDTH)
        n_cameras = 0
        for model, seen in zip(self._models, maps, strict=True):
            if seen is not None:
                n_cameras += 1
                view = lattice.View(model, seen.likelihood, seen.map_from_pixel)
                lattice.add_likelihood(total, view, lattices, is_fine)
        found, likelihood = lattice.best_points(total, centres, spacing, HALF_WIDTH)
        found[likelihood < LEAST_MEAN * max(n_cameras, 1)] = np.nan
        return Sighting(found, likelihood)

    def _measure(self, sighting: Sighting) -> None:
        """Measure the lengths of the parts: medians over the frames so far."""
        self._lengths.append(part_lengths(self.keypoints, sighting.candidates))
        rows = np.array(self._lengths)
        known = np.isfinite(rows).any(axis=0)
        lengths = np.full(len(PARTS), np.nan)
        lengths[known] = np.nanmedian(rows[:, known], axis=0)
        self._set_lengths(lengths)
        self._settled = len(self._lengths) == SIZING_FRAMES
        self.solve(sighting)
