"""Marker sets as files: which marker sits on which segment, and how joints and axes follow from markers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from gateway.body.body_file import load_body
from gateway.body.skeleton import Skeleton
from gateway.errors import SettingsError, nearest
from gateway.support.settings_files import Strict, find_file, load_settings

Line = tuple[str, str]
Axis = Literal["x", "y", "z"]
Side = Literal["left", "right"]
Length = float | str
"""In m, or the name of a measurement."""
MARKER_DIAMETER = "marker_diameter"
"""The measurement that, where a set has it and it is known, stands for its ``marker_radius_m``."""
MARKER_RADIUS = "marker_radius"
"""Half of that, as a length in rules."""


class Measurement(Strict):
    """A length of the person that rules need."""

    parameters: list[str] = Field(default=[], description="names under which C3D files tell it, file units")
    default_m: float | None = Field(
        default=None, gt=0, lt=2, description="taken, with a note, where nobody tells it; none: rules wait"
    )


class Angle(Strict):
    """An angle of the person that rules need; 0 where nobody tells it."""

    parameters: list[str] = Field(default=[], description="names under which C3D files tell it, rad")


class Between(Strict):
    """A point on a line."""

    line: Line
    fraction: float


class Shifted(Strict):
    """A point moved along a line's direction."""

    point: str
    along: Line
    by: Length


class Perpendicular(Strict):
    """A point moved across two lines."""

    point: str
    first: Line
    second: Line
    by: Length | None = None
    width: Length | None = Field(default=None, description="by half of it and the marker's radius")

    @model_validator(mode="after")
    def _has_one_length(self) -> Perpendicular:
        if (self.by is None) == (self.width is None):
            raise ValueError("either 'by' or 'width' is wanted")
        return self


class Chord(Strict):
    """Joint centre inside a marker, by proximal joint and a third point."""

    proximal: str
    marker: str
    plane: str
    width: Length | None = Field(default=None, description="of the joint: half of it lies between")
    offset: Length | None = Field(default=None, description="from the skin to the joint's centre")
    wand_angle: str | None = Field(
        default=None,
        description="angle by which the third point lies ahead of the joint's axis, about the bone",
    )
    side: Side | None = Field(default=None, description="with wand_angle: of which leg")

    @model_validator(mode="after")
    def _has_consistent_lengths(self) -> Chord:
        if (self.width is None) == (self.offset is None):
            raise ValueError("either 'width' or 'offset' is wanted")
        if (self.wand_angle is None) != (self.side is None):
            raise ValueError("'wand_angle' and 'side' go together")
        return self


class DavisHip(Strict):
    """Hip by pelvis width and leg length."""

    asis: Line
    sacrum: str
    side: Side
    legs: Line = Field(description="measurements of both legs' lengths: this side, the other")
    measured: Line | None = Field(
        default=None, description="of the person: distance of both ASIS; of this side's ASIS and trochanter"
    )


class HaraHip(Strict):
    """Hip by leg length alone."""

    asis: Line
    sacrum: str
    side: Side
    leg: Length


class HarringtonHip(Strict):
    """Hip by width and depth of the pelvis."""

    asis: Line
    sacrum: str
    side: Side


class ScaledOffset(Strict):
    """A point at fractions of a length along a segment's axes."""

    origin: str
    segment: str
    fractions: tuple[float, float, float]
    of: Line


class BelowLine(Strict):
    """A point moved down by a fraction of a line's length."""

    point: str
    line: Line
    fraction: float


class RightTriangle(Strict):
    """A point half a width inside a lateral marker, across the plane of two bones."""

    proximal: str
    marker: str
    distal: str
    width: Length
    side: Side = Field(description="of an elbow or ankle; the other one for a knee, which bends backward")


class PointRule(Strict):
    """How a point follows from others: exactly one of these."""

    midpoint: list[str] | None = None
    between: Between | None = None
    shifted: Shifted | None = None
    perpendicular: Perpendicular | None = None
    chord: Chord | None = None
    davis_hip: DavisHip | None = None
    harrington_hip: HarringtonHip | None = None
    hara_hip: HaraHip | None = None
    scaled_offset: ScaledOffset | None = None
    below_line: BelowLine | None = None
    right_triangle: RightTriangle | None = None

    @model_validator(mode="after")
    def _is_one(self) -> PointRule:
        given = list(self.model_fields_set)
        if len(given) != 1:
            raise ValueError(f"one rule is wanted, there are {len(given)}: {', '.join(given) or 'none'}")
        return self

    @property
    def kind(self) -> str:
        """Name of the rule."""
        return next(iter(self.model_fields_set))


class AxesRule(Strict):
    """A segment's axes: two lines from point to point, the second made perpendicular to the first."""

    primary: tuple[Axis, str, str]
    secondary: tuple[Axis, str, str]

    @model_validator(mode="after")
    def _differ(self) -> AxesRule:
        if self.primary[0] == self.secondary[0]:
            raise ValueError(f"primary and secondary are both {self.primary[0]}: two axes are wanted")
        return self


class SegmentRule(Strict):
    """Where a segment is, by points."""

    origin: str = Field(description="point of its proximal joint")
    tip: str | None = Field(
        default=None, description="point where it ends; none: as long as in the body file"
    )
    axes: AxesRule | None = Field(default=None, description="none: turned as its parent is")
    trust_mm: Annotated[float, Field(gt=0, le=500)] = Field(
        default=5, description="how far the motion may move the joint from where the rule has it, 1 σ"
    )
    bends: bool = Field(
        default=False,
        description="its joint bends in one plane, which tells how its parent is turned about its length",
    )


class MarkerSetFile(Strict):
    """Markers, points, segments."""

    name: str
    body: str = Field(description="name of a shipped body, or path of a body file")
    vertical: tuple[list[str], list[str]] = Field(
        description="markers low on the standing body, markers high on it: finds the axis that points up"
    )
    marker_radius_m: float = Field(default=0.007, ge=0, lt=0.1)
    measurements: dict[str, Measurement] = Field(default={})
    angles: dict[str, Angle] = Field(default={})
    markers: dict[str, list[str]] = Field(description="segment to the markers on it")
    aliases: dict[str, list[str]] = Field(
        default={},
        description="marker to further names that laboratories give it; case and dots count nowhere",
    )
    points: dict[str, PointRule | list[PointRule]] = Field(
        default={},
        description="in order; of several rules the first whose markers and measurements are there",
    )
    segments: dict[str, SegmentRule]


class MarkerSet(Strict):
    """A checked marker set with its body."""

    model_config = ConfigDict(extra="forbid", frozen=True, arbitrary_types_allowed=True)

    file: MarkerSetFile
    body: Skeleton
    path: Path

    @property
    def labels(self) -> tuple[str, ...]:
        """All markers, segment by segment."""
        return tuple(label for labels in self.file.markers.values() for label in labels)

    @property
    def carriers(self) -> dict[str, str]:
        """Marker to the segment it sits on."""
        return {label: segment for segment, labels in self.file.markers.items() for label in labels}

    @property
    def other_names(self) -> dict[str, str]:
        """Further names of markers, each with the label of this set."""
        return {name: label for label, names in self.file.aliases.items() for name in names}

    def rules(self, point: str) -> list[PointRule]:
        """Return the rules of a point, in order of preference."""
        rules = self.file.points[point]
        return rules if isinstance(rules, list) else [rules]

    def counting(self) -> set[str]:
        """Return all points and measurements on which the places of its segments rest, each by the first rule
        that it has; the markers' diameter always."""
        open_names = list(names_in(list(self.file.segments.values())))
        found = {MARKER_DIAMETER}
        while open_names:
            name = open_names.pop()
            if name in found:
                continue
            found.add(name)
            if name in self.file.points:
                rule = next(iter(self.rules(name)))
                open_names += names_in(getattr(rule, rule.kind))
        return found


def load_marker_set(name: str) -> MarkerSet:
    """Return a marker set by name or path. Raises ``SettingsError`` naming file, entry and remedy."""
    path = find_file(name, "marker_sets")
    file = load_settings(path, MarkerSetFile)
    found = MarkerSet(file=file, body=load_body(file.body, path), path=path)
    _check_segments(found)
    _check_points(found)
    return found


def names_in(value: object) -> Iterable[str]:
    """Return all texts in a rule: points and markers, and measurements."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, BaseModel):
        for each in value.__dict__.values():
            yield from names_in(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from names_in(each)


def _check_segments(marker_set: MarkerSet) -> None:
    known, file, path = marker_set.body.segment_names, marker_set.file, marker_set.path
    for segment in (*file.markers, *file.segments):
        if segment not in known:
            raise SettingsError(
                f"{path}: there is no segment '{segment}' in body '{marker_set.body.name}'"
                + nearest(segment, known)
            )
    missing = [segment for segment in known if segment not in file.segments]
    if missing:
        raise SettingsError(f"{path}: 'segments' does not tell where {', '.join(missing)} begin")
    repeated = sorted({label for label in marker_set.labels if marker_set.labels.count(label) > 1})
    if repeated:
        raise SettingsError(f"{path}: marker '{repeated[0]}' sits on two segments")
    _refuse_unknown(path, "aliases", file.aliases, {*marker_set.labels})
    if file.segments[known[0]].axes is None:
        raise SettingsError(f"{path}: segments.{known[0]} is the root: it needs 'axes'")


def _check_points(marker_set: MarkerSet) -> None:
    file, path = marker_set.file, marker_set.path
    known = {*marker_set.labels}
    fixed = {"left", "right", MARKER_RADIUS, *marker_set.body.segment_names, *file.measurements, *file.angles}
    for point in file.points:
        for rule in marker_set.rules(point):
            _refuse_unknown(path, f"points.{point}", names_in(getattr(rule, rule.kind)), known | fixed)
        if point in known:
            raise SettingsError(f"{path}: points.{point} has the name of a marker, or stands twice")
        known.add(point)
    axes = {"x", "y", "z"}
    for name, segment in file.segments.items():
        _refuse_unknown(path, f"segments.{name}", names_in(segment), known | axes)
    _refuse_unknown(path, "vertical", names_in(list(file.vertical)), known)


def _refuse_unknown(path: Path, where: str, names: Iterable[str], known: set[str]) -> None:
    for name in names:
        if name not in known:
            raise SettingsError(
                f"{path}: {where} names '{name}', which is no marker and no point before it"
                + nearest(name, known)
            )
