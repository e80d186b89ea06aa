"""A person's body from calibration trials: rules first, then what the motion shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from devices.marker_files import MarkerTrial
from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.optical.anchoring import (
    turned,
    turns_to_bending,
    turns_to_neutral,
    turns_to_rules,
)
from gateway.reconstruction.optical.bundle import (
    Adjusted,
    adjusted,
    own_markers,
    weighted_rmse,
    with_sigmas,
)
from gateway.reconstruction.optical.fitted_body import Fit, JointCentres
from gateway.reconstruction.optical.ghosts import other_sizes
from gateway.reconstruction.optical.joint_ranges import impossible_joints, shown_joints
from gateway.reconstruction.optical.landmarks import (
    Measured,
    SegmentPlaces,
    landmarks_of,
    measurements,
    standing_alike,
    to_world,
    vertical_axis,
)
from gateway.reconstruction.optical.marker_set import MarkerSet
from gateway.reconstruction.optical.pose_solver import BodyModel, Held, Pose, body_model, everyone, solve_pose
from gateway.reconstruction.optical.rule_body import (
    SightedTrial,
    facing_axes,
    from_rules,
    mean_rotation,
    neutral_axes,
    resized,
    straightened,
    unseen,
)
from gateway.reconstruction.optical.tracking import NEAR, start_pose
from gateway.reconstruction.optical.worn_markers import named_trials, worn_part

Progress = Callable[[int, int], None]

MOST_FRAMES = 120
"""That the body is fitted to, of all trials together."""
STILL_FRAMES = 10
"""Of a trial in which nothing moves: more of them tell nothing new."""
SMALLEST_SIGMA = 0.003
"""What a marker strays at the least, per coordinate, m: one that hangs on a segment alone is met exactly."""
_NEAR_AT_FIRST = 0.15  # m: while the body is not known well, all markers have their say
_FREE = 0.1  # m: a joint that rules do not hold
_SHOW_A_PLACE = 2
"""Markers of its own that a segment needs to show where the joints lie that it bears; with fewer, rules have
the say, by ``_HELD`` of their trust."""
_HELD = 0.2
_FEWEST_SEGMENTS = 3
"""That carry markers and lie somewhere: fewer are no body."""
_FAR_BETTER = 0.5
"""Of the rest with rules, below which the motion counts as showing all joints by itself: markers on skin
leave more, whatever the joints."""
_REGRESSIONS = {"davis_hip", "harrington_hip", "hara_hip"}
_STILL = 0.05  # m, of a marker's standard deviation


@dataclass(frozen=True)
class FitOptions:
    """What the trials do not tell."""

    vertical: str | None = None
    """x, y or z; None: found from the markers."""
    lengths: Mapping[str, float] = field(default_factory=dict)
    """Measurements of the person, m."""
    angles: Mapping[str, float] = field(default_factory=dict)
    """Angles of the person, rad."""
    neutral: tuple[float, float] | None = None
    """Seconds of the first trial in which the person stands neutral: axes are then those of that posture."""
    centres: Literal["rules", "both", "motion"] = "both"
    """Where joints are: where rules have them on average; moved by the motion as far as each rule's trust
    lets it; or where the motion has them, whatever rules say."""
    person: str | None = None
    """Whose markers, where files hold those of several people: what stands before the labels."""


def fit_body(
    marker_set: MarkerSet,
    trials: Sequence[MarkerTrial],
    options: FitOptions | None = None,
    progress: Progress | None = None,
) -> Fit:
    """Return the body that explains the trials, as much of it as carries markers; these are called as in the
    files.

    Raises ``GatewayError`` where the trials do not tell enough, ``FormatError`` where it is open whose
    markers are meant.
    """
    options, report = options or FitOptions(), progress or (lambda _done, _total: None)
    named = named_trials(marker_set, trials, options.person)
    measured = measurements(named.marker_set, list(named.trials), options.lengths, options.angles)
    vertical, upright, other_axes = _upright(named.marker_set, named.trials, options.vertical)
    seen = _enough_seen(named.marker_set, upright, vertical, measured)
    marker_set, sightings, bending = seen.marker_set, seen.sightings, _bending(seen.marker_set)
    if options.neutral is not None:
        sightings, bending = _stood_neutral(marker_set, sightings, upright[0], options.neutral), []
    moving = _moving(sightings)
    skeleton, markers = from_rules(marker_set, moving, vertical)
    chosen = [_spread(each, MOST_FRAMES // len(sightings)) for each in moving]
    evidence = _evidence(marker_set, skeleton, markers, chosen)
    report(1, 2)
    stood = None
    if options.neutral is not None:
        stood = _standing(sightings[0], markers, marker_set, options.neutral, upright[0])
    shape = _shaped(marker_set, skeleton, evidence, options.centres, bending, stood)
    poses = shape.done.poses
    final = with_sigmas(shape.done.model, poses, SMALLEST_SIGMA)
    report(2, 2)
    backwards, turned_about = impossible_joints(marker_set.body, final, poses)
    own_labels = tuple(named.file_labels[label] for label in markers.labels)
    sized = resized(marker_set, final.offsets, shape.tips)
    return Fit(
        skeleton=replace(sized, joints=shown_joints(sized, final, poses, bending)),
        markers=replace(markers, labels=own_labels, positions=final.positions, sigmas=final.sigmas),
        trials=named,
        measured=measured,
        centres=shape.centres,
        frames=len(evidence.observed),
        rmse=shape.done.rmse,
        moved=shape.moved,
        too_few=seen.too_few,
        other_sizes=other_sizes(marker_set, upright),
        other_axes=other_axes,
        backwards=backwards,
        turned=turned_about,
        is_still=all(_largest_stray(sighting.markers) < _STILL for sighting in sightings),
    )


def _upright(
    marker_set: MarkerSet, trials: Sequence[MarkerTrial], vertical: str | None
) -> tuple[str, Sequence[MarkerTrial], dict[str, str]]:
    """Return the axis that points up, the trials, and those that were turned to it, with their own axes.

    vertical: as the user has it, for all trials; None: as the markers show it.
    """
    if vertical is not None:
        return vertical, trials, {}
    vertical = vertical_axis(marker_set, trials[0])
    return vertical, *standing_alike(marker_set, trials, vertical)


class _Evidence(NamedTuple):
    """K chosen frames, and the body that rules make of them."""

    model: BodyModel
    observed: FloatArray  # (K, M, 3) m, markers of the body
    axes: FloatArray  # (K, S, 3, 3) segment to world, by rules
    poses: list[Pose]


def _evidence(
    marker_set: MarkerSet, skeleton: Skeleton, markers: BodyMarkers, chosen: Sequence[SightedTrial]
) -> _Evidence:
    """Return the chosen frames of all trials, each with the pose from which the fit begins."""
    model = body_model(skeleton, markers)
    columns = [marker_set.labels.index(label) for label in markers.labels]
    observed = np.concatenate([sighting.markers[:, columns] for sighting in chosen])
    axes = np.concatenate([sighting.places.axes for sighting in chosen])
    roots = np.concatenate([sighting.places.origins[:, 0] for sighting in chosen])
    poses = [
        _begun(model, seen, R, root, skeleton, chosen[0].name)
        for seen, R, root in zip(observed, axes, roots, strict=True)
    ]
    return _Evidence(model, observed, axes, poses)


def _moved_by_motion(
    marker_set: MarkerSet, begun: Adjusted, observed: FloatArray, centres: str, bending: Sequence[int]
) -> Adjusted:
    """Return the body found together with its poses: first with all markers heard, then each by its own σ."""
    trust = _trust(marker_set, begun.model, centres)
    done = adjusted(begun.model, observed, begun.poses, trust, _NEAR_AT_FIRST, bending)
    known = with_sigmas(done.model, done.poses, SMALLEST_SIGMA)
    return adjusted(known, observed, done.poses, trust, NEAR, bending)


class _Shape(NamedTuple):
    """A body of S segments as motion and rules have it."""

    done: Adjusted
    centres: JointCentres
    tips: FloatArray  # (S, 3) m
    moved: FloatArray  # (S,) m: how far the motion moved every joint


def _shaped(
    marker_set: MarkerSet,
    skeleton: Skeleton,
    evidence: _Evidence,
    centres: str,
    bending: Sequence[int],
    stood: FloatArray | None,
) -> _Shape:
    """Return the body with its joints by motion and rules.

    stood: frames (n, M, 3) m whose posture gives the axes; None: rules do.
    """
    begun = Adjusted(evidence.model, evidence.poses, weighted_rmse(evidence.poses), 0)
    done, tips = turned(begun, skeleton.tips, turns_to_bending(evidence.model, evidence.poses, bending))
    if centres == "rules":
        return _Shape(done, JointCentres(is_functional=False), tips, np.zeros(skeleton.n_segments))
    done, decided = _found_in_motion(marker_set, done, evidence.observed, centres, bending)
    moved = np.linalg.norm(done.model.offsets - skeleton.offsets, axis=1)
    if stood is None:
        done, tips = turned(done, tips, turns_to_rules(done.poses, evidence.axes))
        done, tips = turned(done, tips, turns_to_bending(done.model, done.poses, bending))
    else:
        done, tips = _anchored_in_neutral(marker_set, done, evidence.observed, stood, tips, centres)
    return _Shape(done, decided, tips, moved)


def _found_in_motion(
    marker_set: MarkerSet, begun: Adjusted, observed: FloatArray, centres: str, bending: Sequence[int]
) -> tuple[Adjusted, JointCentres]:
    """Return the body as the motion has it, each joint as far from its rule as this lets it. Where some went
    that far, and markers are met far better without rules, it goes without."""
    done = _moved_by_motion(marker_set, begun, observed, centres, bending)
    if centres == "motion":
        return done, JointCentres(is_functional=True)
    away = np.linalg.norm(done.model.offsets - begun.model.offsets, axis=1)
    strained = np.flatnonzero(away > _trust(marker_set, begun.model, centres)).tolist()
    if not strained:
        return done, JointCentres(is_functional=False)
    free = _moved_by_motion(marker_set, begun, observed, "motion", bending)
    if free.rmse < _FAR_BETTER * done.rmse:
        return free, JointCentres(is_functional=True)
    names = marker_set.body.segment_names
    regressed = tuple(names[s] for s in strained if _is_regressed(marker_set, names[s]))
    return done, JointCentres(False, regressed, free.rmse if regressed else np.nan)


def _is_regressed(marker_set: MarkerSet, name: str) -> bool:
    """Return whether a segment hangs in a joint that is placed by a regression on other bones' lengths."""
    origin = marker_set.file.segments[name].origin
    kinds = {rule.kind for rule in marker_set.rules(origin)} if origin in marker_set.file.points else set()
    return bool(kinds & _REGRESSIONS)


def _bending(marker_set: MarkerSet) -> list[int]:
    """Return segments whose joints bend in one plane."""
    entries = marker_set.file.segments
    return [s for s, name in enumerate(marker_set.body.segment_names) if entries[name].bends]


def _anchored_in_neutral(
    marker_set: MarkerSet, done: Adjusted, observed: FloatArray, stood: FloatArray, tips: FloatArray,
    centres: str,
) -> tuple[Adjusted, FloatArray]:  # fmt: skip
    """Return axes by the neutral posture of the frames ``stood`` (n, M, 3), again once joints are
    straight."""
    body = marker_set.body
    done, tips = _made_neutral(body, done, stood, tips)
    straight = done.model._replace(offsets=straightened(body, done.model.offsets))
    done = adjusted(straight, observed, done.poses, _trust(marker_set, straight, centres), NEAR)
    return _made_neutral(body, done, stood, tips)


class _Seen(NamedTuple):
    """The part of a marker set that trials show."""

    marker_set: MarkerSet
    sightings: list[SightedTrial]
    too_few: dict[str, tuple[str, ...]]
    """Limbs of which no frame tells how they lie, with the markers that lack: they are left out."""


def _enough_seen(
    marker_set: MarkerSet, trials: Sequence[MarkerTrial], vertical: str, measured: Measured
) -> _Seen:
    """Return what is seen, without limbs that have too few markers for it.

    A body of which hardly anything would be left stays as it is.
    """
    left, too_few = marker_set, dict[str, tuple[str, ...]]()
    while True:
        sightings = [sighted(left, trial, vertical, measured) for trial in trials]
        never = unseen(left, [sighting.places.axes for sighting in sightings])
        if not never:
            return _Seen(left, sightings, too_few)
        body = left.body
        lost = set(never)
        for name, parent in zip(body.segment_names, body.parents.tolist(), strict=True):
            if parent >= 0 and body.segment_names[parent] in lost:
                lost.add(name)
        own = left.file.markers
        kept = [label for name, labels in own.items() if name not in lost for label in labels]
        if body.segment_names[0] in lost or sum(name not in lost for name in own) < _FEWEST_SEGMENTS:
            whole = [sighted(marker_set, trial, vertical, measured) for trial in trials]
            return _Seen(marker_set, whole, {})
        known = [*too_few.values(), *never.values()]
        lacking = tuple(dict.fromkeys(label for labels in known for label in labels))
        too_few |= {name: tuple(never.get(name) or lacking) for name in body.segment_names if name in lost}
        left = worn_part(left, kept, lost)


def sighted(marker_set: MarkerSet, trial: MarkerTrial, vertical: str, measured: Measured) -> SightedTrial:
    """Return a trial's markers in the world, and what rules make of them."""
    markers = to_world(trial.columns(marker_set.labels), vertical)
    return SightedTrial(trial.name, markers, landmarks_of(marker_set, trial, vertical, measured).places())


def _stood_neutral(
    marker_set: MarkerSet, sightings: list[SightedTrial], trial: MarkerTrial, span: tuple[float, float]
) -> list[SightedTrial]:
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


def _trust(marker_set: MarkerSet, model: BodyModel, centres: str) -> FloatArray:
    """Return (S,) m: 1 σ of every joint's place in its parent."""
    entries = marker_set.file.segments
    trust = np.array([entries[name].trust_mm for name in marker_set.body.segment_names]) * 1e-3
    if centres == "motion":
        return np.maximum(trust, _FREE)
    is_hardly_seen = own_markers(model)[model.parents] < _SHOW_A_PLACE
    return np.where(is_hardly_seen & (model.parents >= 0), _HELD * trust, trust)


def _moving(sightings: Sequence[SightedTrial]) -> list[SightedTrial]:
    """Return the trials, few frames of those in which nothing moves.

    A posture held for seconds is one posture: were all its frames to count, the body would be that of this
    posture, with the skin where it pulled it (an acromion marker moves by 4 cm when the arm is raised).
    """
    return [
        _spread(each, STILL_FRAMES) if _largest_stray(each.markers) < _STILL else each for each in sightings
    ]


def _spread(sighting: SightedTrial, count: int) -> SightedTrial:
    """Return so many of the frames with most markers seen, at equal distances."""
    share = np.isfinite(sighting.markers).all(axis=2).mean(axis=1)
    good = np.flatnonzero(share >= min(0.8, share.max()))
    chosen = np.linspace(0, len(good) - 1, min(len(good), count)).astype(np.int64)
    return sighting.only(good[chosen])


def _standing(
    sighting: SightedTrial,
    markers: BodyMarkers,
    marker_set: MarkerSet,
    span: tuple[float, float],
    trial: MarkerTrial,
) -> FloatArray:
    """Return (n, M, 3) m of some frames of neutral standing."""
    columns = np.array([marker_set.labels.index(label) for label in markers.labels])
    first, last = (round(each * trial.rate_hz) for each in span)
    chosen = np.unique(np.linspace(first, min(last, trial.n_frames) - 1, STILL_FRAMES).astype(np.int64))
    return np.ascontiguousarray(sighting.markers[np.ix_(chosen, columns)])


def _made_neutral(
    body: Skeleton, done: Adjusted, stood: FloatArray, tips: FloatArray
) -> tuple[Adjusted, FloatArray]:
    """Return the fitted body with axes that make the standing frames (n, M, 3) neutral; its tips (S, 3)."""
    model, pose = done.model, done.poses[0]
    standing = []
    for seen in stood:
        pose = solve_pose(model, everyone(seen, _NEAR_AT_FIRST), pose.R, pose.root, Held(pose.R), 30)
        standing.append(pose)
    joints = [model.joints_at(each.R, each.root) for each in standing]
    upright = facing_axes(body, np.mean(joints, axis=0), standing[0].R[0])
    return turned(done, tips, turns_to_neutral(standing, upright))


def _largest_stray(seen: FloatArray) -> float:
    """Return the largest distance of a marker (F, M, 3) from its mean place, root mean square, m."""
    known: NDArray[np.bool_] = np.asarray(np.isfinite(seen).all(axis=2))
    count = np.maximum(known.sum(axis=0), 1)
    values = np.where(known[..., None], seen, 0.0)
    mean = values.sum(axis=0) / count[:, None]
    squares = np.where(known, ((values - mean) ** 2).sum(axis=2), 0.0).sum(axis=0) / count
    return float(np.sqrt(squares.max()))


def _begun(
    model: BodyModel, seen: FloatArray, axes: FloatArray, root: FloatArray, skeleton: Skeleton, name: str
) -> Pose:
    """Return the pose that the fit begins from.

    It is that of the rules; where these do not know all of the body, that of the markers alone.
    seen: (M, 3) m; axes: (S, 3, 3) segment to world and root: (3,) m, by the rules; name: of the trial.
    """
    if np.isfinite(axes).all() and np.isfinite(root).all():
        return solve_pose(model, everyone(seen, _NEAR_AT_FIRST), axes, root, Held(axes), 30)
    pose = start_pose(model, seen, quaternion.to_matrix(skeleton.neutral))
    if pose is None:
        raise GatewayError(f"{name}: a frame with fewer than three markers: too few to fit a body to")
    return pose
