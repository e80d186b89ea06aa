"""Markers of a trial to points and axes of the body, by the rules of a marker set."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from devices.marker_files import MarkerTrial
from gateway.errors import GatewayError, nearest
from gateway.frames import FloatArray, IntArray
from gateway.reconstruction.optical import point_rules as rules
from gateway.reconstruction.optical.marker_set import (
    MARKER_DIAMETER,
    MARKER_RADIUS,
    BelowLine,
    Between,
    Chord,
    DavisHip,
    HaraHip,
    HarringtonHip,
    Length,
    MarkerSet,
    Perpendicular,
    PointRule,
    RightTriangle,
    ScaledOffset,
    Shifted,
    names_in,
)

_UP = {
    "x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
    "-x": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-z": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
}
"""From the axes of the optical system to the world, Z up, by the axis that points up there; ``-z``: z points
down."""

AXES_UP = tuple(_UP)

_SHORTEST_M, _LONGEST_M = 0.001, 2.0
"""Of a person's measurement: a number of a file that is none of these is in another unit than its points."""
MOST_ANGLE = np.pi / 2
"""rad: a wand further from its joint's axis than that is none."""


def to_world(positions: FloatArray, vertical: str) -> FloatArray:
    """Return positions (…, 3) of a system whose axis ``vertical`` points up, in the world, Z up."""
    turned: FloatArray = positions @ _UP[vertical].T
    return turned


def vertical_axis(marker_set: MarkerSet, trial: MarkerTrial) -> str:
    """Return the axis of the file along which high markers lie above low ones.

    The root's markers stand for those of an end of the body that carries none.

    Raises ``GatewayError`` where the markers that would tell are not there.
    """
    low, high = (_middle(marker_set, trial, labels) for labels in marker_set.file.vertical)
    if not (np.abs(high - low) > 0.0).any():  # unknown, or the root's markers stand for both
        feet, top = (" or ".join(labels) for labels in marker_set.file.vertical)
        raise GatewayError(
            f"{trial.name}: which axis points up is not seen without {feet} and {top}: tell it with --up"
        )
    axis = int(np.argmax(np.abs(high - low)))
    return "xyz"[axis] if (high - low)[axis] > 0 else f"-{'xyz'[axis]}"


def standing_alike(
    marker_set: MarkerSet, trials: Sequence[MarkerTrial], vertical: str
) -> tuple[list[MarkerTrial], dict[str, str]]:
    """Return the trials with the body upright along ``vertical``, the axis of the first, and, of those that
    had to be turned, the axis along which it stands in their files."""
    turned, axes = list(trials[:1]), dict[str, str]()
    for trial in trials[1:]:
        try:
            own = vertical_axis(marker_set, trial)
        except GatewayError:  # too few markers to tell
            own = vertical
        if own != vertical:
            axes[trial.name] = own
            trial = replace(trial, positions=to_world(trial.positions, own) @ _UP[vertical])  # noqa: PLW2901
        turned.append(trial)
    return turned, axes


def _middle(marker_set: MarkerSet, trial: MarkerTrial, labels: list[str]) -> FloatArray:
    """Return (3,) m, mean place of markers; of the root's where none of these is seen; NaN without
    those too."""
    root = marker_set.file.markers.get(marker_set.body.segment_names[0], [])
    for some in (labels, root):
        places = trial.columns(tuple(some)).reshape(-1, 3)
        if np.isfinite(places).any():
            mean: FloatArray = np.nanmean(places, axis=0)
            return mean
    return np.full(3, np.nan)


@dataclass(frozen=True)
class Measured:
    """Lengths and angles of a person, and which lengths that count nobody told."""

    lengths: Mapping[str, float]  # m
    angles: Mapping[str, float]  # rad
    assumed: tuple[str, ...]


def measurements(
    marker_set: MarkerSet,
    trials: list[MarkerTrial],
    given: Mapping[str, float],
    given_angles: Mapping[str, float] | None = None,
) -> Measured:
    """Return what the rules need: as given (m, rad), else from the files, else the marker set's defaults.

    Raises ``GatewayError`` for one given that the marker set does not have, and for an angle that cannot be.
    """
    known, angles = marker_set.file.measurements, dict(given_angles or {})
    _refuse_unknown(marker_set, "measurement", given, known)
    _refuse_unknown(marker_set, "angle", angles, marker_set.file.angles)
    lengths, assumed, counting = dict(given), [], marker_set.counting()
    for name, entry in known.items():
        measured = [
            trial.parameters[parameter] * trial.metres_per_unit
            for trial in trials
            for parameter in entry.parameters
            if _SHORTEST_M < trial.parameters.get(parameter, 0.0) * trial.metres_per_unit < _LONGEST_M
        ]
        if name in lengths:
            continue
        if measured:
            lengths[name] = float(np.mean(measured))
        elif entry.default_m is not None:
            lengths[name] = entry.default_m
            if name in counting:
                assumed.append(name)
    for name, angle in marker_set.file.angles.items():
        if name not in angles:
            found = [
                _given_angle(trial, parameter)
                for trial in trials
                for parameter in angle.parameters
                if trial.parameters.get(parameter)
            ]
            angles[name] = float(np.mean(found or [0.0]))
    return Measured(lengths, angles, tuple(assumed))


def _given_angle(trial: MarkerTrial, parameter: str) -> float:
    angle = trial.parameters[parameter]
    if abs(angle) > MOST_ANGLE:
        raise GatewayError(f"{trial.name}: {parameter} is {angle:g} rad: no wand stands so; correct the file")
    return angle


def _refuse_unknown(
    marker_set: MarkerSet, what: str, given: Mapping[str, float], known: Mapping[str, object]
) -> None:
    for name in given:
        if name not in known:
            raise GatewayError(
                f"marker set '{marker_set.file.name}' has no {what} '{name}'{nearest(name, known)}"
            )


@dataclass(frozen=True)
class SegmentPlaces:
    """Where rules find the segments: F frames, S segments of the body. NaN where markers were missing."""

    origins: FloatArray  # (F, S, 3) m, proximal joints, world
    axes: FloatArray  # (F, S, 3, 3) segment to world
    tips: FloatArray  # (F, S, 3) m; NaN where no rule tells

    def only(self, frames: IntArray) -> SegmentPlaces:
        """Return some of its frames."""
        return SegmentPlaces(self.origins[frames], self.axes[frames], self.tips[frames])


class Landmarks:
    """Points of a trial, each worked out when it is first asked for."""

    def __init__(self, marker_set: MarkerSet, markers: Mapping[str, FloatArray], measured: Measured):
        """Find nothing yet. markers: label to (F, 3) m, world."""
        self._set = marker_set
        self._lengths = measured.lengths
        self._angles = measured.angles
        self._points: dict[str, FloatArray] = dict(markers)
        self._n_frames = len(next(iter(markers.values())))

    def point(self, name: str) -> FloatArray:
        """Return (F, 3) m; NaN where its markers are missing."""
        if name not in self._points:
            self._points[name] = self._worked_out(name)
        return self._points[name]

    def axes(self, segment: str) -> FloatArray | None:
        """Return (F, 3, 3) of a segment; None where the marker set tells none."""
        rule = self._set.file.segments[segment].axes
        if rule is None:
            return None
        (first, a, b), (second, c, d) = rule.primary, rule.secondary
        return rules.frame_axes((first, self.point(a), self.point(b)), (second, self.point(c), self.point(d)))

    def places(self) -> SegmentPlaces:
        """Return all segments; one without axes of its own is turned as its parent."""
        body = self._set.body
        shape = (self._n_frames, body.n_segments, 3)
        origins, tips, axes = np.full(shape, np.nan), np.full(shape, np.nan), np.full((*shape, 3), np.nan)
        for s, name in enumerate(body.segment_names):
            entry = self._set.file.segments[name]
            origins[:, s] = self.point(entry.origin)
            found = self.axes(name)
            axes[:, s] = axes[:, body.parents[s]] if found is None else found
            if entry.tip is not None:
                tips[:, s] = self.point(entry.tip)
        return SegmentPlaces(origins, axes, tips)

    def _worked_out(self, name: str) -> FloatArray:
        if name not in self._set.file.points:
            return np.full((self._n_frames, 3), np.nan)  # a marker that this trial does not have
        for rule in self._set.rules(name):
            if set(names_in(getattr(rule, rule.kind))) & set(self._set.file.measurements) <= set(
                self._lengths
            ):
                found = self._by_rule(rule)
                if np.isfinite(found).all(axis=1).any():
                    return found
        return np.full((self._n_frames, 3), np.nan)

    def _by_rule(self, rule: PointRule) -> FloatArray:
        if rule.midpoint is not None:
            return rules.midpoint([self.point(name) for name in rule.midpoint])
        return _APPLY[rule.kind](self, getattr(rule, rule.kind))

    def line(self, ends: tuple[str, str]) -> tuple[FloatArray, FloatArray]:
        """Return the two points of a line."""
        return self.point(ends[0]), self.point(ends[1])

    def length(self, value: Length) -> float:
        """Return a length, m: a number, or a measurement by name, ``marker_radius`` among them."""
        if value == MARKER_RADIUS:
            return self.marker_radius
        return self._lengths[value] if isinstance(value, str) else value

    def angle(self, name: str) -> float:
        """Return an angle of the person by name, rad."""
        return self._angles[name]

    def inside(self, width: Length) -> float:
        """Return how far it is from a marker's middle to the middle of a joint of that width, m."""
        return 0.5 * self.length(width) + self.marker_radius

    @property
    def marker_radius(self) -> float:
        """m: of the person's markers where it is known, else as the marker set has it."""
        diameter = self._lengths.get(MARKER_DIAMETER)
        return self._set.file.marker_radius_m if diameter is None else 0.5 * diameter


def _chord(at: Landmarks, rule: Chord) -> FloatArray:
    points = at.point(rule.proximal), at.point(rule.marker), at.point(rule.plane)
    ahead = 0.0 if rule.wand_angle is None else at.angle(rule.wand_angle)
    turned = ahead if rule.side == "right" else -ahead
    if rule.offset is not None:
        return rules.chord(*points, at.length(rule.offset) + at.marker_radius, turned)
    return rules.chord(*points, at.inside(rule.width or 0.0), turned)


def _davis_hip(at: Landmarks, rule: DavisHip) -> FloatArray:
    legs = at.length(rule.legs[0]), at.length(rule.legs[1])
    measured = None if rule.measured is None else (at.length(rule.measured[0]), at.length(rule.measured[1]))
    asis, sacrum = at.line(rule.asis), at.point(rule.sacrum)
    return rules.davis_hip(asis, sacrum, legs, at.marker_radius, rule.side, measured)


def _harrington_hip(at: Landmarks, rule: HarringtonHip) -> FloatArray:
    return rules.harrington_hip(at.line(rule.asis), at.point(rule.sacrum), rule.side)


def _hara_hip(at: Landmarks, rule: HaraHip) -> FloatArray:
    return rules.hara_hip(at.line(rule.asis), at.point(rule.sacrum), at.length(rule.leg), rule.side)


def _between(at: Landmarks, rule: Between) -> FloatArray:
    return rules.between(*at.line(rule.line), rule.fraction)


def _shifted(at: Landmarks, rule: Shifted) -> FloatArray:
    return rules.shifted(at.point(rule.point), *at.line(rule.along), at.length(rule.by))


def _perpendicular(at: Landmarks, rule: Perpendicular) -> FloatArray:
    by = at.length(rule.by) if rule.by is not None else at.inside(rule.width or 0.0)
    return rules.perpendicular(at.point(rule.point), at.line(rule.first), at.line(rule.second), by)


def _scaled_offset(at: Landmarks, rule: ScaledOffset) -> FloatArray:
    axes = at.axes(rule.segment)
    origin = at.point(rule.origin)
    if axes is None:
        return np.full_like(origin, np.nan)
    return rules.scaled_offset(origin, axes, rule.fractions, at.line(rule.of))


def _below_line(at: Landmarks, rule: BelowLine) -> FloatArray:
    return rules.below_line(at.point(rule.point), at.line(rule.line), rule.fraction)


def _right_triangle(at: Landmarks, rule: RightTriangle) -> FloatArray:
    points = at.point(rule.proximal), at.point(rule.marker), at.point(rule.distal)
    return rules.right_triangle(*points, at.inside(rule.width), rule.side)


_APPLY: dict[str, Callable[..., FloatArray]] = {
    "between": _between,
    "shifted": _shifted,
    "perpendicular": _perpendicular,
    "chord": _chord,
    "davis_hip": _davis_hip,
    "harrington_hip": _harrington_hip,
    "hara_hip": _hara_hip,
    "scaled_offset": _scaled_offset,
    "below_line": _below_line,
    "right_triangle": _right_triangle,
}


def landmarks_of(marker_set: MarkerSet, trial: MarkerTrial, vertical: str, measured: Measured) -> Landmarks:
    """Return the landmarks of a trial in the world."""
    world = to_world(trial.columns(marker_set.labels), vertical)
    markers = {label: world[:, m] for m, label in enumerate(marker_set.labels)}
    return Landmarks(marker_set, markers, measured)
