"""Body files: which segments and joints there are; and the world that a body stands in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from gateway.body.joint_file import JointEntry, joints_of
from gateway.body.markers import BodyMarkers
from gateway.body.sensor_entries import Finite
from gateway.body.skeleton import Interpolation, Skeleton, WornSuit, field_vector
from gateway.errors import SettingsError, nearest
from gateway.support.names import LOWER_NAME
from gateway.support.settings_files import Strict, find_file, load_settings

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

    gravity: float = Field(default=9.80665, gt=9, lt=10, description="m/s²")
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
