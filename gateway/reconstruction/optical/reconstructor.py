"""Markers to skeleton, frame by frame, for a body that has been fitted."""

from __future__ import annotations

import functools
from collections import Counter
from dataclasses import replace

import numpy as np

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray, MarkerFit, MarkerFrame, SkeletonFrame, Status, unknown_pose
from gateway.geometry import quaternion
from gateway.reconstruction.optical.carrying import Carrying
from gateway.reconstruction.optical.labelling import relabelled
from gateway.reconstruction.optical.pose_solver import (
    HELD_SIGMA,
    Held,
    Pose,
    body_model,
    everyone,
    orientation_sigmas,
    solve_pose,
)
from gateway.reconstruction.optical.rates import WINDOW, Rates
from gateway.reconstruction.optical.tracking import ACCEPTED, NEAR, laid_anew, start_pose, turned_on

_LONGEST, _AS_IT_IS = 15, 0  # steps
_FAR = 0.15
"""A marker farther than this from where it is expected is not asked until its name has been questioned, m."""
_LONGEST_PREDICTION_NS = 60_000_000
_GOOD_SHARE = 0.5
"""Of the markers seen, that must be near their virtual ones for the body not to count as lost."""
_SMALLEST_VARIANCE = 0.25
_WARM_UP_INTERVAL_NS, _WARM_UP_MARKERS = 10_000_000, 4
"""Between frames; on each segment."""


Renamed = tuple[tuple[int, int], ...]
"""(marker, whose point it had been; -1 for a nameless one)."""
Named = tuple[FloatArray, Renamed]
"""Markers (M, 3) m with the points that are theirs, and those that came under another name."""


class OpticalReconstructor:
    """Whole-body pose of every frame, from the one before; begins, and begins anew, from the markers alone.

    Sans-I/O and deterministic. ``last`` tells how the last frame was explained, ``counts`` what was put
    right.
    """

    def __init__(self, skeleton: Skeleton, markers: BodyMarkers) -> None:
        self.skeleton = skeleton
        self.markers = markers
        self.model = body_model(skeleton, markers)
        self.counts: Counter[str] = Counter()
        """starts, laid_anew (frames with segments that had been missed), renamed, rejected, lost (frames
        without a pose)."""
        self.last: MarkerFit | None = None
        self._neutral = quaternion.to_matrix(skeleton.neutral)
        self._rates = Rates()
        self._carrying = Carrying(self.model.parents)
        self._before: tuple[int, Pose] | None = None
        self._now: tuple[int, Pose] | None = None
        self._given: SkeletonFrame | None = None
        """The last pose given out."""

    def reset(self) -> None:
        """Forget the pose: the next frame begins from its markers alone."""
        self._before = self._now = None
        self._given = None
        self._rates.reset()
        self._carrying.reset()

    @property
    def pose(self) -> Pose | None:
        """The last pose found; None before the first."""
        return None if self._now is None else self._now[1]

    def named(self, observation: MarkerFrame, R: FloatArray, root: FloatArray) -> Named:
        """Return the markers of an instant once names are put right that do not fit a pose (S, 3, 3), (3,)
        m."""
        expected = self.model.markers_at(R, root)
        found = relabelled(observation.positions, expected, self.model.sigmas, observation.unlabelled)
        renamed = () if found is None else found.renamed
        return _with_names(observation, renamed, expected), renamed

    def explained(self, observation: MarkerFrame, named: Named, held: Held) -> SkeletonFrame:
        """Return a pose ``held`` as that of an instant, explained by markers already named; how sure it is
        follows from them and from how sure the pose is held."""
        positions, renamed = named
        seen = everyone(np.ascontiguousarray(positions), NEAR)
        pose = solve_pose(self.model, seen, held.R, held.root, held, _AS_IT_IS)
        self.last = self._explained(observation, pose, renamed)
        return self._frame(observation, pose)

    def update(self, observation: MarkerFrame) -> SkeletonFrame:
        """Return the pose of one instant. Without enough markers the last one is held; before the first, NaN.

        A frame of the same instant as the one before changes nothing and gets the same pose.
        """
        if self._given is None or observation.time_ns != self._given.time_ns:
            self._given = self._pose_of(observation)
        return replace(self._given, sequence=observation.sequence)

    def _pose_of(self, observation: MarkerFrame) -> SkeletonFrame:
        pose, renamed = self._tracked(observation)
        if pose is None:
            self.counts["lost"] += 1
            self.last = None
            return self._without_markers(observation)
        self._before, self._now = self._now, (observation.time_ns, pose)
        self._carrying.add(observation.time_ns, pose.R)
        self.last = self._explained(observation, pose, renamed)
        return self._frame(observation, pose)

    def _tracked(self, frame: MarkerFrame) -> tuple[Pose | None, Renamed]:
        pose, renamed = self._followed(frame)
        if pose is not None:
            pose, renamed = self._questioned(frame, pose, renamed)
            if _is_good(pose, frame.positions):
                other = laid_anew(self.model, frame.positions, pose)
                if other is not None:
                    self.counts["laid_anew"] += 1
                    self.reset()
                    pose, renamed = self._questioned(frame, other, ())
                self.counts["renamed"] += len(renamed)
                return pose, renamed
        begun = start_pose(self.model, frame.positions, self._neutral)
        if begun is None:
            return None, ()
        self.counts["starts"] += 1
        self.reset()
        pose, renamed = self._questioned(frame, begun, ())
        self.counts["renamed"] += len(renamed)
        return pose, renamed

    def _questioned(self, frame: MarkerFrame, pose: Pose, renamed: Renamed) -> tuple[Pose, Renamed]:
        """Return the pose, and which markers had others' points, once names that do not fit it are
        put right."""
        virtual = self.model.markers_at(pose.R, pose.root)
        given = _with_names(frame, renamed, virtual)
        named = relabelled(given, virtual, self.model.sigmas, frame.unlabelled)
        if named is None:
            return pose, renamed
        self.counts["rejected"] += len(named.rejected)
        whose = dict(renamed)
        changed = {m: s if s < 0 else whose.get(s, s) for m, s in named.renamed}
        kept = {m: s for m, s in whose.items() if m not in named.rejected}
        both = {m: s for m, s in {**kept, **changed}.items() if m != s}
        return self._solved(frame.time_ns, named.positions, pose.R, pose.root), tuple(sorted(both.items()))

    def _followed(self, frame: MarkerFrame) -> tuple[Pose | None, Renamed]:
        """Return the pose found from the last one, moved on, and which markers had others' points.

        None: there is no last pose, or there are too few markers.

        Names are questioned before the pose is sought: two markers that change places would else turn the
        segment that they sit on.
        """
        if self._now is None or np.isfinite(frame.positions).all(axis=1).sum() < 3:
            return None, ()
        R, root = self._predicted(frame.time_ns)
        expected = self.model.markers_at(R, root)
        named = relabelled(frame.positions, expected, self.model.sigmas, frame.unlabelled)
        renamed = () if named is None else named.renamed
        given = _with_names(frame, renamed, expected)
        near = np.linalg.norm(given - expected, axis=1) < _FAR
        return self._solved(frame.time_ns, np.where(near[:, None], given, np.nan), R, root), renamed

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

    def _solved(self, time_ns: int, observed: FloatArray, R: FloatArray, root: FloatArray) -> Pose:
        held = Held(R)
        if self._now is not None:
            held = Held(self._carrying.ahead(time_ns), HELD_SIGMA**-2)
        seen = everyone(np.ascontiguousarray(observed), NEAR)
        return solve_pose(self.model, seen, R, root, held, _LONGEST)

    def _explained(self, frame: MarkerFrame, pose: Pose, renamed: Renamed) -> MarkerFit:
        virtual = self.model.markers_at(pose.R, pose.root)
        positions = _with_names(frame, renamed, virtual)
        residuals = np.linalg.norm(positions - virtual, axis=1)
        used = pose.weights > ACCEPTED
        return MarkerFit(positions, virtual, residuals, used, renamed, frame.unlabelled)

    def _frame(self, frame: MarkerFrame, pose: Pose) -> SkeletonFrame:
        p_w = self.model.joints_at(pose.R, pose.root)
        rate, acceleration = self._rates.add(frame.time_ns, pose.R, p_w)
        used = pose.weights > ACCEPTED
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
            markers=self.last,
        )

    def _variance(self, pose: Pose) -> float:
        """Return the variance of the residuals, in units of the markers' own σ²."""
        squares = np.nan_to_num(pose.residuals / self.model.sigmas) ** 2
        freedom = max(3.0 * pose.weights.sum() - len(pose.factor), 0.3 * pose.weights.sum(), 1.0)
        return max(float((pose.weights * squares).sum() / freedom), _SMALLEST_VARIANCE)

    def _without_markers(self, frame: MarkerFrame) -> SkeletonFrame:
        """Return the last pose, held; before the first, one of which nothing is known."""
        n, pose = self.skeleton.n_segments, self.pose
        unknown = unknown_pose(n, frame.sequence, frame.time_ns)
        if pose is None:
            return unknown
        return replace(
            unknown,
            q_wb=np.stack([quaternion.from_matrix(each) for each in pose.R]),
            p_w=self.model.joints_at(pose.R, pose.root),
            status=np.full(n, Status.HELD, np.uint8),
        )


def _with_names(frame: MarkerFrame, renamed: Renamed, virtual: FloatArray) -> FloatArray:
    """Return markers (M, 3) with the points they were given; one that lost its point to another has none."""
    positions = frame.positions.copy()
    for _, source in renamed:
        if source >= 0:
            positions[source] = np.nan
    for marker, source in renamed:
        given = frame.unlabelled if source < 0 else frame.positions[source : source + 1]
        positions[marker] = given[np.nanargmin(np.linalg.norm(given - virtual[marker], axis=1))]
    return positions


def _is_good(pose: Pose, observed: FloatArray) -> bool:
    seen = np.isfinite(observed).all(axis=1).sum()
    return bool((pose.weights > ACCEPTED).sum() >= _GOOD_SHARE * seen)


@functools.cache
def warm_up() -> None:
    """Compile what a stream of markers needs, before the first of them comes.

    A chain of two segments is seen standing still until its angular rates are known.

    Kernels are compiled for kinds of arrays, not for their sizes: any body has its own then. The first call
    after an installation takes about 25 s, the first of a process under a second, others nothing.
    """
    offsets = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    body = Skeleton("warm_up", ("upper", "lower"), np.array([-1, 0]), offsets, np.roll(offsets, -1, axis=0))
    segments = np.repeat([0, 1], _WARM_UP_MARKERS)
    places = np.random.default_rng(0).normal(0.0, 0.1, (len(segments), 3))
    labels = tuple(f"m{i}" for i in range(len(segments)))
    markers = BodyMarkers(labels, segments, places, np.full(len(segments), 0.005))
    reconstructor = OpticalReconstructor(body, markers)
    seen = places + offsets[segments]
    for frame in range(WINDOW + 1):
        reconstructor.update(MarkerFrame(frame, frame * _WARM_UP_INTERVAL_NS, seen))
