"""A person's body from calibration trials: rules first, then what the motion shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from devices.marker_files import MarkerTrial
from gateway.body.markers import BodyMarkers
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.optical.bundle import adjusted, with_sigmas
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
from gateway.reconstruction.optical.rule_body import Sighting, from_rules, mean_rotation, neutral_axes, resized
from gateway.reconstruction.optical.tracking import NEAR, start_pose

Progress = Callable[[int, int], None]

MOST_FRAMES = 120
"""That the body is fitted to, of all trials together."""
STILL_FRAMES = 10
"""Of a trial in which nothing moves: more of them tell nothing new."""
SMALLEST_SIGMA = 0.003
"""What a marker strays at the least, per coordinate, m: one that hangs on a segment alone is met exactly."""
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
    """Where joints are: where rules have them on average; moved by the motion as far as each rule's trust lets
    it; or where the motion has them, whatever rules say."""


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
    observed, poses = _chosen_frames(marker_set, sightings, skeleton, markers)
    poses = [
        _begun(model, seen, pose, skeleton, sightings[0].name)
        for seen, pose in zip(observed, poses, strict=True)
    ]
    if progress is not None:
        progress(1, 3)
    trust = _trust(marker_set, options.centres)
    done = adjusted(model, observed, poses, trust, NEAR)
    if progress is not None:
        progress(2, 3)
    done = adjusted(with_sigmas(done.model, done.poses, SMALLEST_SIGMA), observed, done.poses, trust, NEAR)
    final = with_sigmas(done.model, done.poses, SMALLEST_SIGMA)
    if progress is not None:
        progress(3, 3)
    sized = resized(marker_set, final.offsets, skeleton.tips)
    return Fit(
        skeleton=replace(sized, joints=shown_joints(sized, final, done.poses)),
        markers=replace(markers, positions=final.positions, sigmas=final.sigmas),
        marker_set=marker_set.file.name,
        lengths=measured.lengths,
        assumed=measured.assumed,
        frames=len(observed),
        rmse=done.rmse,
        moved=np.linalg.norm(final.offsets - skeleton.offsets, axis=1),
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
    """(K, M, 3) of frames with most markers seen, spread over the trials; and where rules find the body there."""
    columns = [marker_set.labels.index(label) for label in markers.labels]
    observed: list[FloatArray] = []
    starts: list[tuple[FloatArray, FloatArray] | None] = []
    for sighting in sightings:
        seen = sighting.markers[:, columns]
        share = np.isfinite(seen).all(axis=2).mean(axis=1)
        good = np.flatnonzero(share >= min(0.8, share.max()))
        is_still = np.nanmax(np.nanstd(seen, axis=0)) < _STILL
        count = min(len(good), STILL_FRAMES if is_still else MOST_FRAMES // len(sightings))
        for frame in good[np.linspace(0, len(good) - 1, count).astype(np.int64)]:
            observed.append(seen[frame])
            axes, origins = sighting.places.axes[frame], sighting.places.origins[frame]
            is_known = np.isfinite(axes).all() and np.isfinite(origins[0]).all()
            starts.append((axes, origins[0]) if is_known else None)
    return np.stack(observed), starts


def _begun(
    model: BodyModel, seen: FloatArray, start: tuple[FloatArray, FloatArray] | None, skeleton: Skeleton, name: str
) -> Pose:
    if start is not None:
        return solve_pose(model, seen, np.ones(len(seen)), start[0], start[1], NEAR, 30)
    pose = start_pose(model, seen, quaternion.to_matrix(skeleton.neutral))
    if pose is None:
        raise GatewayError(f"{name}: a frame with fewer than three markers: too few to fit a body to")
    return pose
