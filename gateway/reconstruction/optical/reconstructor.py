"""Markers to skeleton, frame by frame, for a body that has been fitted."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from gateway.body.markers import BodyMarkers
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, MarkerFrame, SkeletonFrame, Status
from gateway.geometry import quaternion
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.labelling import relabelled
from gateway.reconstruction.optical.pose_solver import (
    Pose,
    body_model,
    orientation_sigmas,
    solve_pose,
)
from gateway.reconstruction.optical.rates import Rates
from gateway.reconstruction.optical.tracking import NEAR, start_pose, turned_on

_LONGEST = 15
_FAR = 0.15
"""A marker farther than this from where it is expected is not asked until its name has been questioned, m."""
_LONGEST_PREDICTION_NS = 60_000_000
_GOOD_SHARE = 0.5
"""Of the markers seen, that must be near their virtual ones for the body not to count as lost."""
_ACCEPTED = 0.25
"""Say from which a marker counts as used."""
_SMALLEST_VARIANCE = 0.25


@dataclass(frozen=True)
class MarkerFit:
    """How the last pose explains the markers, in the order of the fitted body."""

    positions: FloatArray
    """(M, 3) m, after names were put right; NaN: not seen, or nobody's."""
    virtual: FloatArray
    """(M, 3) m: where the body has its markers."""
    residuals: FloatArray
    """(M,) m; NaN where not seen."""
    used: FloatArray
    """(M,) bool: had a say."""
    renamed: tuple[tuple[int, int], ...]
    """(marker, whose point it had been; -1 for a nameless one)."""

    @property
    def rmse(self) -> float:
        """m, of the markers used; NaN with none."""
        chosen = self.residuals[self.used.astype(bool)]
        return float(np.sqrt(np.mean(chosen**2))) if len(chosen) else float("nan")


class OpticalReconstructor:
    """Whole-body pose of every frame, from the one before; begins, and begins anew, from the markers alone.

    Sans-I/O and deterministic. ``last`` tells how the last frame was explained, ``counts`` what was put right.
    """

    def __init__(self, skeleton: Skeleton, markers: BodyMarkers) -> None:
        self.skeleton = skeleton
        self.markers = markers
        self.model = body_model(skeleton, markers)
        self.counts: Counter[str] = Counter()
        """starts, renamed, rejected, lost (frames without a pose)."""
        self.last: MarkerFit | None = None
        self._neutral = quaternion.to_matrix(skeleton.neutral)
        self._rates = Rates()
        self._before: tuple[int, Pose] | None = None
        self._now: tuple[int, Pose] | None = None

    def reset(self) -> None:
        """Forget the pose: the next frame begins from its markers alone."""
        self._before = self._now = None
        self._rates.reset()

    def update(self, observation: MarkerFrame) -> SkeletonFrame:
        """The pose of one instant. Without enough markers the last one is held; before the first, NaN."""
        pose, renamed = self._tracked(observation)
        if pose is None:
            self.counts["lost"] += 1
            self.last = None
            return self._without_markers(observation)
        self._before, self._now = self._now, (observation.time_ns, pose)
        self.last = self._explained(observation, pose, renamed)
        return self._frame(observation, pose)

    def _tracked(self, frame: MarkerFrame) -> tuple[Pose | None, tuple[tuple[int, int], ...]]:
        pose = self._followed(frame)
        if pose is not None:
            named = relabelled(
                frame.positions, self._virtual(pose), self.model.sigmas, frame.unlabelled
            )
            renamed: tuple[tuple[int, int], ...] = ()
            if named is not None:
                renamed = named.renamed
                self.counts["renamed"] += len(renamed)
                self.counts["rejected"] += len(named.rejected)
                pose = self._solved(named.positions, pose.R, pose.root)
            if _is_good(pose, frame.positions):
                return pose, renamed
        begun = start_pose(self.model, frame.positions, self._neutral)
        if begun is None:
            return None, ()
        self.counts["starts"] += 1
        self._rates.reset()
        named = relabelled(frame.positions, self._virtual(begun), self.model.sigmas, frame.unlabelled)
        if named is None:
            return begun, ()
        self.counts["renamed"] += len(named.renamed)
        return self._solved(named.positions, begun.R, begun.root), named.renamed

    def _followed(self, frame: MarkerFrame) -> Pose | None:
        """From the last pose, moved on as it was moving; None without one, or with too few markers."""
        if self._now is None or np.isfinite(frame.positions).all(axis=1).sum() < 3:
            return None
        R, root = self._predicted(frame.time_ns)
        p = kernels.places(self.model.parents, self.model.offsets, R, root)
        expected = kernels.marker_places(self.model.segments, self.model.positions, R, p)
        near = np.linalg.norm(frame.positions - expected, axis=1) < _FAR
        return self._solved(np.where(near[:, None], frame.positions, np.nan), R, root)

    def _predicted(self, time_ns: int) -> tuple[FloatArray, FloatArray]:
        assert self._now is not None
        time_now, now = self._now
        if self._before is None:
            return now.R, now.root
        time_before, before = self._before
        step, ahead = time_now - time_before, time_ns - time_now
        if not (0 < step < _LONGEST_PREDICTION_NS and 0 < ahead < _LONGEST_PREDICTION_NS):
            return now.R, now.root
        return turned_on(before.R, now.R, ahead / step), now.root + (now.root - before.root) * (ahead / step)

    def _solved(self, observed: FloatArray, R: FloatArray, root: FloatArray) -> Pose:
        everyone = np.ones(len(observed))
        return solve_pose(self.model, np.ascontiguousarray(observed), everyone, R, root, NEAR, _LONGEST)

    def _virtual(self, pose: Pose) -> FloatArray:
        p = kernels.places(self.model.parents, self.model.offsets, pose.R, pose.root)
        return kernels.marker_places(self.model.segments, self.model.positions, pose.R, p)

    def _explained(
        self, frame: MarkerFrame, pose: Pose, renamed: tuple[tuple[int, int], ...]
    ) -> MarkerFit:
        virtual = self._virtual(pose)
        positions = np.where(np.isfinite(pose.residuals)[:, None], frame.positions, np.nan)
        for marker, source in renamed:
            given = frame.unlabelled if source < 0 else frame.positions[source : source + 1]
            at = np.argmin(np.linalg.norm(given - virtual[marker], axis=1))
            positions[marker] = given[at]
        return MarkerFit(positions, virtual, pose.residuals, pose.weights > _ACCEPTED, renamed)

    def _frame(self, frame: MarkerFrame, pose: Pose) -> SkeletonFrame:
        p_w = kernels.places(self.model.parents, self.model.offsets, pose.R, pose.root)
        rate, acceleration = self._rates.add(frame.time_ns, pose.R, p_w)
        used = pose.weights > _ACCEPTED
        carried = np.zeros(self.skeleton.n_segments, dtype=bool)
        carried[self.model.segments[used]] = True
        return SkeletonFrame(
            sequence=frame.sequence,
            time_ns=frame.time_ns,
            q_wb=np.stack([quaternion.from_matrix(each) for each in pose.R]),
            angular_rate=rate,
            joint_acceleration=acceleration,
            p_w=p_w,
            sigma=orientation_sigmas(self.model.parents, pose.factor, self._variance(pose)),
            status=np.where(carried, Status.MEASURED, Status.PREDICTED).astype(np.uint8),
            root=0,
        )

    def _variance(self, pose: Pose) -> float:
        """Of the residuals, in units of the markers' own σ²."""
        squares = np.nan_to_num(pose.residuals / self.model.sigmas) ** 2
        freedom = max(3.0 * pose.weights.sum() - len(pose.factor), 0.3 * pose.weights.sum(), 1.0)
        return max(float((pose.weights * squares).sum() / freedom), _SMALLEST_VARIANCE)

    def _without_markers(self, frame: MarkerFrame) -> SkeletonFrame:
        n = self.skeleton.n_segments
        unknown = np.full((n, 3), np.nan)
        q_wb, p_w, status = np.full((n, 4), np.nan), unknown.copy(), Status.MISSING
        if self._now is not None:
            pose = self._now[1]
            q_wb = np.stack([quaternion.from_matrix(each) for each in pose.R])
            p_w = kernels.places(self.model.parents, self.model.offsets, pose.R, pose.root)
            status = Status.HELD
        return SkeletonFrame(
            frame.sequence, frame.time_ns, q_wb, unknown, unknown.copy(), p_w, np.full(n, np.nan),
            np.full(n, status, dtype=np.uint8), 0,
        )  # fmt: skip


def _is_good(pose: Pose, observed: FloatArray) -> bool:
    seen = np.isfinite(observed).all(axis=1).sum()
    return bool((pose.weights > _ACCEPTED).sum() >= _GOOD_SHARE * seen)
