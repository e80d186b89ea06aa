"""Body files: which segments and joints there are; and the world that a body stands in."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from firmware_protocol.samples import STANDARD_GRAVITY
from gateway.body.joints import WORLD, Angle, Decomposition, Joint
from gateway.body.sensor_entries import Finite
from gateway.body.skeleton import BodyMarkers, Interpolation, Skeleton, WornSuit, field_vector
from gateway.errors import SettingsError, nearest
from gateway.frames import Vector3
from gateway.support.names import LOWER_NAME
from gateway.support.settings_files import Strict, find_file, load_settings

AxisName = Literal["x", "y", "z", "-x", "-y", "-z"]
Name = Annotated[str, Field(min_length=1, pattern=LOWER_NAME)]

WORLD_NAME = "world"
_ROTATIONS = 3


class AngleEntry(Strict):
    """One angle of a joint."""

    axis: AxisName | tuple[Finite, Finite, Finite] = Field(
        description="axis about which it grows right-handed: x, -y, …; for a joint of one angle any vector"
    )
    limits_deg: tuple[Finite, Finite] | None = Field(
        default=None, description="smallest and largest, degrees"
    )

    @field_validator("limits_deg")
    @classmethod
    def _is_range(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and value[0] > value[1]:
            raise ValueError("the smaller limit comes first")
        return value

    def vector(self) -> Vector3:
        """Return the axis as a unit vector."""
        if isinstance(self.axis, str):
            unit = [0.0, 0.0, 0.0]
            unit["xyz".index(self.axis[-1])] = -1.0 if self.axis[0] == "-" else 1.0
            return unit[0], unit[1], unit[2]
        norm = math.hypot(*self.axis)
        if norm < 1e-9:
            raise ValueError("an axis of length zero")
        x, y, z = (component / norm for component in self.axis)
        return x, y, z


class Definition(Strict):
    """How a joint's rotation becomes angles."""

    decomposition: Literal["cardan", "swing_twist"] = Field(
        default="cardan", description="for three angles; a joint of one angle is a hinge"
    )
    angles: dict[Name, AngleEntry] = Field(description="in the order of the rotations: one, or three")
    source: str = Field(default="", description="publication the definition follows")

    @model_validator(mode="after")
    def _is_complete(self) -> Definition:
        if len(self.angles) not in (1, _ROTATIONS):
            raise ValueError(f"a joint has one angle or three, not {len(self.angles)}")
        if len(self.angles) == _ROTATIONS:
            _check_order([entry.axis for entry in self.angles.values()], self.decomposition)
        for entry in self.angles.values():
            entry.vector()
        return self

    def angle_tuple(self) -> tuple[Angle, ...]:
        """Return the angles of the entry as the program uses them."""
        return tuple(Angle(name, entry.vector(), _limits(entry)) for name, entry in self.angles.items())


class JointEntry(Definition):
    """A joint of a body file."""

    name: Name
    proximal: str = Field(description="segment that counts as standing still, or 'world'")
    distal: str = Field(description="segment that turns")
    free: list[str] | None = Field(
        default=None, description="angles the joint is modelled to have; others stay small. Default: all"
    )
    alternatives: dict[Name, Definition] = Field(
        default={}, description="other definitions, which a rig file can choose"
    )

    @model_validator(mode="after")
    def _names_its_own_angles(self) -> JointEntry:
        for name in self.free or ():
            if name not in self.angles:
                raise ValueError(f"'free' names '{name}', which is no angle{nearest(name, self.angles)}")
        return self


def joints_of(
    path: Path,
    entries: Sequence[JointEntry],
    segments: Sequence[str],
    chosen: Mapping[str, str] | None = None,
) -> tuple[Joint, ...]:
    """Return the joints of a body file. Raises ``SettingsError`` naming the joint and the remedy.

    segments: names in order. chosen: joint name to the name of one of its alternatives.
    """
    chosen = chosen or {}
    names = [entry.name for entry in entries]
    for name in chosen:
        if name not in names:
            raise SettingsError(
                f"{path}: there is no joint '{name}' to define otherwise, as joint_definitions wants"
                + nearest(name, names)
            )
    for name in names:
        if names.count(name) > 1:
            raise SettingsError(f"{path}: joint '{name}' stands twice")
    return tuple(_joint(path, entry, list(segments), chosen.get(entry.name)) for entry in entries)


def _joint(path: Path, entry: JointEntry, segments: list[str], alternative: str | None) -> Joint:
    for end in (entry.proximal, entry.distal):
        if end not in segments and (end != WORLD_NAME or end == entry.distal):
            raise SettingsError(
                f"{path}: joint '{entry.name}' names segment '{end}', which the body does not have"
                + nearest(end, segments)
            )
    if entry.proximal == entry.distal:
        raise SettingsError(f"{path}: joint '{entry.name}' joins '{entry.distal}' to itself")
    definition: Definition = entry
    if alternative is not None:
        if alternative not in entry.alternatives:
            raise SettingsError(
                f"{path}: joint '{entry.name}' has no definition '{alternative}'"
                + nearest(alternative, entry.alternatives)
            )
        definition = entry.alternatives[alternative]
    angles = definition.angle_tuple()
    # An alternative definition names other angles, which the list of free ones does not know.
    is_free = entry.free is None or alternative is not None
    return Joint(
        name=entry.name,
        proximal=WORLD if entry.proximal == WORLD_NAME else segments.index(entry.proximal),
        distal=segments.index(entry.distal),
        decomposition=_decomposition(definition),
        angles=angles,
        free=tuple(angle.name for angle in angles if is_free or angle.name in (entry.free or ())),
        source=definition.source,
    )


def _decomposition(definition: Definition) -> Decomposition:
    return (
        Decomposition.HINGE
        if len(definition.angles) == 1
        else Decomposition[definition.decomposition.upper()]
    )


def _check_order(axes: Sequence[AxisName | Vector3], decomposition: str) -> None:
    letters = [axis[-1] for axis in axes if isinstance(axis, str)]
    if len(letters) < _ROTATIONS:
        raise ValueError("three angles go about the axes x, y, z (or -x, -y, -z); vectors are for one angle")
    if letters[0] == letters[1] or letters[1] == letters[2]:
        raise ValueError(f"successive rotations need different axes, not {', '.join(letters)}")
    if decomposition == "swing_twist" and letters[0] == letters[2]:
        raise ValueError("swing and twist need three different axes, the twist's last")


def _limits(entry: AngleEntry) -> tuple[float, float]:
    if entry.limits_deg is None:
        return -math.inf, math.inf
    low, high = np.radians(entry.limits_deg).tolist()
    return low, high


_Coordinate = Annotated[float, Field(ge=-20, le=20, allow_inf_nan=False)]
Point = tuple[_Coordinate, _Coordinate, _Coordinate]
"""m, of a segment's own: what lies further off was meant in millimetres."""
Quaternion = tuple[Finite, Finite, Finite, Finite]


class SegmentInterpolation(Strict):
    """Where a segment without module is: between two others."""

    between: tuple[str, str] = Field(description="two segments with modules")
    fraction: float = Field(ge=0, le=1, description="of the way from the first to the second")


class BodySegment(Strict):
    """One rigid segment."""

    name: str = Field(min_length=1, pattern=LOWER_NAME, description="ISB name in lower case")
    parent: str | None = Field(description="segment it is joined to; null for the root")
    joint: Point = Field(default=(0, 0, 0), description="proximal joint in the parent's axes, m")
    tip: Point = Field(description="where the segment ends, own axes, m")
    contacts: list[Point] = Field(
        default=[], description="points that carry the body on the ground (heel, ball), own axes, m"
    )
    interpolate: SegmentInterpolation | None = Field(
        default=None, description="what a segment without module follows; its parent if left out"
    )


class BodyFile(Strict):
    """A skeleton; parents stand before their children."""

    name: str
    neutral: Quaternion = Field(default=(1, 0, 0, 0), description="segment to world in the neutral posture")
    stature_m: float | None = Field(
        default=None, gt=0.4, lt=2.6, description="height of the person the lengths belong to, m"
    )
    segments: list[BodySegment] = Field(min_length=1)
    joints: list[JointEntry] = Field(default=[], description="for joint angles, limits and calibration")


class MagneticField(Strict):
    """The local field of the earth."""

    norm_ut: float = Field(default=50, gt=0, le=1000, description="strength, µT")
    dip_deg: float = Field(default=65, ge=-90, le=90, description="below the horizontal, degrees")
    declination_deg: float = Field(
        default=0, ge=-180, le=180, description="magnetic north, clockwise from north"
    )


class Place(Strict):
    """Where on earth: gives, with the date and time, where the sun stands."""

    latitude_deg: float = Field(ge=-90, le=90, description="north, degrees")
    longitude_deg: float = Field(ge=-180, le=180, description="east, degrees")


class WorldSettings(Strict):
    """What the sensors stand in."""

    gravity: float = Field(default=STANDARD_GRAVITY, gt=9, lt=10, description="m/s²")
    magnetic_field: MagneticField = MagneticField()
    second_field: Literal["magnetometer", "sun", "both"] = Field(
        default="magnetometer",
        description="what shows headings beside gravity: the earth's field, the sun by photoelectric cells "
        "(needs 'place'), or both",
    )
    place: Place | None = Field(default=None, description="for second_field: sun or both")

    @model_validator(mode="after")
    def _knows_where_the_sun_is(self) -> WorldSettings:
        if (self.second_field == "magnetometer") != (self.place is None):
            raise ValueError(
                "second_field: sun (or both) needs 'place: {latitude_deg: …, longitude_deg: …}', "
                "and no other does"
            )
        return self


def load_body(
    name: str, beside: Path | None = None, joint_definitions: Mapping[str, str] | None = None
) -> Skeleton:
    """Return a body by name or path, its joints by the definitions chosen. Raises ``SettingsError``."""
    path = find_file(name, "bodies", beside)
    return skeleton_of(load_settings(path, BodyFile), path, joint_definitions)


def skeleton_of(body: BodyFile, path: Path, joint_definitions: Mapping[str, str] | None = None) -> Skeleton:
    """Return the skeleton that the content of a file describes. Raises ``SettingsError``, which names
    ``path``."""
    names = [segment.name for segment in body.segments]
    parents = []
    for position, segment in enumerate(body.segments):
        if segment.name in names[:position]:
            raise SettingsError(f"{path}: segment '{segment.name}' stands twice")
        parents.append(_parent_index(path, segment, names[:position]))
    _refuse_unknown_neighbours(path, body)
    joints = joints_of(path, body.joints, names, joint_definitions)
    return replace(_skeleton(body, names, parents), joints=joints)


def _parent_index(path: Path, segment: BodySegment, before: list[str]) -> int:
    if (segment.parent is None) != (not before):
        raise SettingsError(
            f"{path}: the first segment, and no other, has 'parent: null'; see '{segment.name}'"
        )
    if segment.parent is None:
        return -1
    if segment.parent not in before:
        raise SettingsError(
            f"{path}: parent '{segment.parent}' of '{segment.name}' must be a segment standing before it"
            + nearest(segment.parent, before)
        )
    return before.index(segment.parent)


def _skeleton(body: BodyFile, names: list[str], parents: list[int]) -> Skeleton:
    return Skeleton(
        name=body.name,
        segment_names=tuple(names),
        parents=np.array(parents, dtype=np.int64),
        offsets=np.array([segment.joint for segment in body.segments], dtype=np.float64),
        tips=np.array([segment.tip for segment in body.segments], dtype=np.float64),
        # Files have a few decimals: made a unit quaternion again.
        neutral=np.array(body.neutral) / np.linalg.norm(body.neutral),
        stature_m=body.stature_m,
        contacts=tuple(
            (s, np.array(point, dtype=np.float64))
            for s, segment in enumerate(body.segments)
            for point in segment.contacts
        ),
        interpolations=tuple(
            Interpolation(s, names.index(rule.between[0]), names.index(rule.between[1]), rule.fraction)
            for s, segment in enumerate(body.segments)
            if (rule := segment.interpolate) is not None
        ),
    )


def _refuse_unknown_neighbours(path: Path, body: BodyFile) -> None:
    names = [segment.name for segment in body.segments]
    for segment in body.segments:
        for neighbour in segment.interpolate.between if segment.interpolate else ():
            if neighbour not in names or neighbour == segment.name:
                raise SettingsError(
                    f"{path}: '{segment.name}' is interpolated from '{neighbour}', which is no other "
                    "segment of this body" + nearest(neighbour, names)
                )


def worn_without_modules(skeleton: Skeleton, markers: BodyMarkers, world: WorldSettings) -> WornSuit:
    """Return a body that wears markers, and no module."""
    n, field = skeleton.n_segments, world.magnetic_field
    return WornSuit(
        skeleton=skeleton,
        module_ids=(),
        module_of_segment=np.full(n, -1, dtype=np.int64),
        sensor_to_segment=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        lever_arms=np.zeros((n, 3)),
        local_devices=(),
        gravity=np.array([0.0, 0.0, -world.gravity]),
        magnetic_field=field_vector(field.norm_ut, field.dip_deg, field.declination_deg),
        markers=markers,
    )
