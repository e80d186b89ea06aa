"""A person's body from calibration trials: rules first, then what the motion shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from devices.marker_files import MarkerTrial
from gateway.body.markers import BodyMarkers
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.optical import kernels
from gateway.reconstruction.optical.anchoring import turned_model, turns_to_neutral, turns_to_rules
from gateway.reconstruction.optical.bundle import Adjusted, adjusted, with_sigmas
from gateway.reconstruction.optical.joint_ranges import shown_joints
from gateway.reconstruction.optical.landmarks import (
    SegmentPlaces,
    landmarks_of,
    measurements,
    to_world,
    vertical_axis,
)
from gateway.reconstruction.optical.marker_set import MarkerSet
from gateway.reconstruction.optical.pose_solver import BodyModel, Pose, body_model, solve_pose
from gateway.reconstruction.optical.rule_body import (
    Sighting,
    facing_axes,
    from_rules,
    mean_rotation,
    neutral_axes,
    resized,
    straightened,
)
from gateway.reconstruction.optical.tracking import NEAR, start_pose

Progress = Callable[[int, int], None]

MOST_FRAMES = 120
"""That the body is fitted to, of all trials together."""
STILL_FRAMES = 10
"""Of a trial in which nothing moves: more of them tell nothing new."""
SMALLEST_SIGMA = 0.003
"""What a marker strays at the least, per coordinate, m: one that hangs on a segment alone is met exactly."""
_NEAR_AT_FIRST = 0.15  # m: while the body is not known well, all markers have their say
_HELD = 1e-4  # m: a joint that is to stay where it is
_STILL = 0.05  # m, of a marker's standard deviation


@dataclass(frozen=True)
class FitOptions:
    """What the trials do not tell."""

    vertical: str | None = None
    """x, y or z; None: found from the markers."""
    lengths: Mapping[str, float] = field(default_factory=dict)
    """Measurements of the person, m."""
    neutral: tuple[float, float] | None = None
    """Seconds of the first trial in which the person stands neutral: axes are then those of that posture."""
    centres: Literal["rules", "both", "motion"] = "both"
    """Where joints are: where rules have them on average; moved by the motion as far as each rule's trust
    lets it; or where the motion has them, whatever rules say."""


@dataclass(frozen=True)
class Fit:
    """A fitted body, and how it came about."""

    skeleton: Skeleton
    markers: BodyMarkers
    marker_set: str
    lengths: Mapping[str, float]
    assumed: tuple[str, ...]
    """Measurements that nobody told."""
    frames: int
    rmse: float
    """m, of the frames it was fitted to."""
    moved: FloatArray
    """(S,) m: how far the motion moved every joint from where rules had it."""


def fit_body(
    marker_set: MarkerSet,
    trials: Sequence[MarkerTrial],
    options: FitOptions | None = None,
    progress: Progress | None = None,
) -> Fit:
    """The body that explains the trials. Raises ``GatewayError`` where they do not tell enough."""
    options = options or FitOptions()
    measured = measurements(marker_set, list(trials), options.lengths)
    vertical = options.vertical or vertical_axis(marker_set, trials[0])
    sightings = [sighted(marker_set, trial, vertical, measured.lengths) for trial in trials]
    if options.neutral is not None:
        sightings = _stood_neutral(marker_set, sightings, trials[0], options.neutral)
    skeleton, markers = from_rules(marker_set, sightings, vertical)
    model = body_model(skeleton, markers)
    observed, starts = _chosen_frames(marker_set, sightings, skeleton, markers)
    poses = [
        _begun(model, seen, start, skeleton, sightings[0].name)
        for seen, start in zip(observed, starts, strict=True)
    ]
    if progress is not None:
        progress(1, 3)
    trust = _trust(marker_set, options.centres)
    done = adjusted(model, observed, poses, trust, _NEAR_AT_FIRST)
    if progress is not None:
        progress(2, 3)
    done = adjusted(with_sigmas(done.model, done.poses, SMALLEST_SIGMA), observed, done.poses, trust, NEAR)
    moved = np.linalg.norm(done.model.offsets - skeleton.offsets, axis=1)
    if options.neutral is None:
        turns = turns_to_rules(done.poses, np.stack([_rule_axes(start, skeleton) for start in starts]))
        model, poses, tips = turned_model(done.model, done.poses, skeleton.tips, turns)
    else:
        stood = _standing(sightings[0], markers, marker_set, options.neutral, trials[0])
        model, poses, tips = _made_neutral(marker_set.body, done, stood, skeleton.tips)
        straight = model._replace(offsets=straightened(marker_set.body, model.offsets))
        done = adjusted(straight, observed, poses, trust, NEAR)
        model, poses, tips = _made_neutral(marker_set.body, done, stood, tips)
    final = with_sigmas(model, poses, SMALLEST_SIGMA)
    if progress is not None:
        progress(3, 3)
    sized = resized(marker_set, final.offsets, tips)
    return Fit(
        skeleton=replace(sized, joints=shown_joints(sized, final, poses)),
        markers=replace(markers, positions=final.positions, sigmas=final.sigmas),
        marker_set=marker_set.file.name,
        lengths=measured.lengths,
        assumed=measured.assumed,
        frames=len(observed),
        rmse=done.rmse,
        moved=moved,
    )


def sighted(
    marker_set: MarkerSet, trial: MarkerTrial, vertical: str, lengths: Mapping[str, float]
) -> Sighting:
    """A trial's markers in the world, and what rules make of them."""
    markers = to_world(trial.columns(marker_set.labels), vertical)
    if not np.isfinite(markers).any():
        raise GatewayError(
            f"{trial.name}: none of the markers of '{marker_set.file.name}' is in it; it has "
            + ", ".join(label for label in trial.labels[:12] if label)
            + (", …" if len(trial.labels) > 12 else "")
        )
    return Sighting(trial.name, markers, landmarks_of(marker_set, trial, vertical, lengths).places())


def _stood_neutral(
    marker_set: MarkerSet, sightings: list[Sighting], trial: MarkerTrial, span: tuple[float, float]
) -> list[Sighting]:
    first, last = (round(each * trial.rate_hz) for each in span)
    stretch = sightings[0].places.axes[max(first, 0) : last]
    body = marker_set.body
    if not len(stretch) or not np.isfinite(stretch).all(axis=(2, 3)).any(axis=0).all():
        raise GatewayError(
            f"{trial.name}: from {span[0]:g} to {span[1]:g} s not every segment is seen (it has "
            f"{trial.duration_s:g} s): name a stretch of neutral standing with all markers"
        )
    standing = np.stack([mean_rotation(stretch[:, s]) for s in range(body.n_segments)])
    return [
        replace(
            each,
            places=SegmentPlaces(
                each.places.origins, neutral_axes(body, each.places.axes, standing), each.places.tips
            ),
        )
        for each in sightings
    ]


def _trust(marker_set: MarkerSet, centres: str) -> FloatArray:
    """(S,) m."""
    entries = marker_set.file.segments
    trust = np.array([entries[name].trust_mm for name in marker_set.body.segment_names]) * 1e-3
    if centres == "rules":
        return np.full_like(trust, _HELD)
    return np.maximum(trust, 0.1) if centres == "motion" else trust


def _chosen_frames(
    marker_set: MarkerSet, sightings: Sequence[Sighting], skeleton: Skeleton, markers: BodyMarkers
) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray] | None]]:
    """(K, M, 3) of frames with most markers seen, spread over the trials; and where rules find the body
    there."""
    columns = [marker_set.labels.index(label) for label in markers.labels]
    observed: list[FloatArray] = []
    starts: list[tuple[FloatArray, FloatArray] | None] = []
    for sighting in sightings:
        seen = sighting.markers[:, columns]
        share = np.isfinite(seen).all(axis=2).mean(axis=1)
        good = np.flatnonzero(share >= min(0.8, share.max()))
        is_still = _largest_stray(seen) < _STILL
        count = min(len(good), STILL_FRAMES if is_still else MOST_FRAMES // len(sightings))
        for frame in good[np.linspace(0, len(good) - 1, count).astype(np.int64)]:
            observed.append(seen[frame])
            axes, origins = sighting.places.axes[frame], sighting.places.origins[frame]
            is_known = np.isfinite(axes).all() and np.isfinite(origins[0]).all()
            starts.append((axes, origins[0]) if is_known else None)
    return np.stack(observed), starts


def _rule_axes(start: tuple[FloatArray, FloatArray] | None, skeleton: Skeleton) -> FloatArray:
    return np.full((skeleton.n_segments, 3, 3), np.nan) if start is None else start[0]


def _standing(
    sighting: Sighting,
    markers: BodyMarkers,
    marker_set: MarkerSet,
    span: tuple[float, float],
    trial: MarkerTrial,
) -> FloatArray:
    """(n, M, 3) m of some frames of neutral standing."""
    columns = np.array([marker_set.labels.index(label) for label in markers.labels])
    first, last = (round(each * trial.rate_hz) for each in span)
    chosen = np.unique(np.linspace(first, min(last, trial.n_frames) - 1, STILL_FRAMES).astype(np.int64))
    return np.ascontiguousarray(sighting.markers[np.ix_(chosen, columns)])


def _made_neutral(
    body: Skeleton, done: Adjusted, stood: FloatArray, tips: FloatArray
) -> tuple[BodyModel, list[Pose], FloatArray]:
    """The fitted body with axes that make the standing frames (n, M, 3) neutral; its poses; its tips (S,
    3)."""
    model, pose = done.model, done.poses[0]
    standing = []
    for seen in stood:
        pose = solve_pose(model, seen, np.ones(len(seen)), pose.R, pose.root, _NEAR_AT_FIRST, 30, pose.R, 0.0)
        standing.append(pose)
    joints = [kernels.places(model.parents, model.offsets, each.R, each.root) for each in standing]
    upright = facing_axes(body, np.mean(joints, axis=0), standing[0].R[0])
    return turned_model(model, done.poses, tips, turns_to_neutral(standing, upright))


def _largest_stray(seen: FloatArray) -> float:
    """The largest distance of a marker (F, M, 3) from its mean place, root mean square, m."""
    known: NDArray[np.bool_] = np.asarray(np.isfinite(seen).all(axis=2))
    count = np.maximum(known.sum(axis=0), 1)
    values = np.where(known[..., None], seen, 0.0)
    mean = values.sum(axis=0) / count[:, None]
    squares = np.where(known, ((values - mean) ** 2).sum(axis=2), 0.0).sum(axis=0) / count
    return float(np.sqrt(squares.max()))


def _begun(
    model: BodyModel,
    seen: FloatArray,
    start: tuple[FloatArray, FloatArray] | None,
    skeleton: Skeleton,
    name: str,
) -> Pose:
    if start is not None:
        return solve_pose(
            model, seen, np.ones(len(seen)), start[0], start[1], _NEAR_AT_FIRST, 30, start[0], 0.0
        )
    pose = start_pose(model, seen, quaternion.to_matrix(skeleton.neutral))
    if pose is None:
        raise GatewayError(f"{name}: a frame with fewer than three markers: too few to fit a body to")
    return pose
