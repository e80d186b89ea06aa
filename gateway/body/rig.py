"""Body and rig files: which segments there are, and which module sits where on them.

A *body* is a skeleton; a *rig* says which modules and local measuring devices are worn on it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from gateway.body.anthropometry import Subject, scaled
from gateway.body.joint_file import JointEntry, joints_of
from gateway.body.markers import BodyMarkers
from gateway.body.position_cameras import PositionCameras
from gateway.body.sensor_entries import CalibrationEntry
from gateway.body.skeleton import (
    CameraPosition,
    Interpolation,
    LocalDevice,
    SensorRanges,
    Skeleton,
    SunCells,
    WornSuit,
    field_vector,
)
from gateway.errors import SettingsError, nearest
from gateway.frames import Quantity
from gateway.support.names import LOWER_NAME
from gateway.support.settings_files import Strict, find_file, load_settings, load_yaml

Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Quaternion = tuple[Finite, Finite, Finite, Finite]
ModuleId = Annotated[int, Field(ge=0, le=63)]

FACES: tuple[Vector, Vector, Vector, Vector, Vector, Vector] = (
    (1, 0, 0),
    (-1, 0, 0),
    (0, 1, 0),
    (0, -1, 0),
    (0, 0, 1),
    (0, 0, -1),
)
"""Where the cells of a ``LightSample`` look, unless the rig says otherwise."""


class SegmentInterpolation(Strict):
    """Where a segment without module is: between two others."""

    between: tuple[str, str] = Field(description="two segments with modules")
    fraction: float = Field(ge=0, le=1, description="of the way from the first to the second")


class BodySegment(Strict):
    """One rigid segment."""

    name: str = Field(min_length=1, pattern=LOWER_NAME, description="ISB name in lower case")
    parent: str | None = Field(description="segment it is joined to; null for the root")
    joint: Vector = Field(default=(0, 0, 0), description="proximal joint in the parent's axes, m")
    tip: Vector = Field(description="where the segment ends, own axes, m")
    contacts: list[Vector] = Field(
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


class RangeEntry(Strict):
    """Where a module's sensors end. One that is left out is found once values stay flat there."""

    accelerometer: float | None = Field(default=None, gt=0, description="± m/s²")
    gyroscope: float | None = Field(default=None, gt=0, description="± °/s")

    def model(self) -> SensorRanges:
        """Return it in SI units."""
        force = math.inf if self.accelerometer is None else self.accelerometer
        return SensorRanges(force, math.inf if self.gyroscope is None else math.radians(self.gyroscope))


class WornModule(Strict):
    """A module strapped to a segment."""

    id: ModuleId
    segment: str
    position: Vector = Field(default=(0, 0, 0), description="proximal joint to module, segment axes, m")
    sensor_to_segment: Quaternion = Field(
        default=(1, 0, 0, 0), description="w x y z; takes sensor axes to segment axes"
    )
    calibration: CalibrationEntry | None = Field(
        default=None, description="corrections of its readings, as `calibrate sensors` measured them"
    )
    ranges: RangeEntry | None = Field(
        default=None, description="where its sensors end, for modules that do not tell by themselves"
    )
    cells: tuple[Vector, Vector, Vector, Vector, Vector, Vector] = Field(
        default=FACES,
        description="where its six photoelectric cells look, sensor axes; left out: +x −x +y −y +z −z",
    )

    @field_validator("sensor_to_segment")
    @classmethod
    def _is_rotation(cls, value: Quaternion) -> Quaternion:
        return _rotation(value)

    @field_validator("cells")
    @classmethod
    def _span_space(cls, value: tuple[Vector, ...]) -> tuple[Vector, ...]:
        normals = np.array(value)
        if not np.linalg.norm(normals, axis=1).all() or np.linalg.matrix_rank(normals, tol=0.1) < 3:
            raise ValueError("the cells must look in directions that span space, none of length 0")
        return value


class WornLocalDevice(Strict):
    """A local measuring device (ML), or a fixed point."""

    kind: Literal["fixed_point", "acceleration", "velocity", "position", "air_velocity"] = Field(
        description="what it measures, in world axes; air_velocity: pressure tubes along its own axes"
    )
    segment: str
    device: ModuleId | None = Field(default=None, description="id it sends under; none for a fixed point")
    position: Vector = Field(default=(0, 0, 0), description="proximal joint to device, segment axes, m")
    device_to_segment: Quaternion = Field(
        default=(1, 0, 0, 0), description="for air_velocity: w x y z; takes the tubes' axes to segment axes"
    )

    @field_validator("device_to_segment")
    @classmethod
    def _is_rotation(cls, value: Quaternion) -> Quaternion:
        return _rotation(value)


def _rotation(value: Quaternion) -> Quaternion:
    """Return the quaternion. Raises ``ValueError`` for one that is not of length 1."""
    norm = float(np.linalg.norm(value))
    if abs(norm - 1) > 0.01:
        raise ValueError(f"a quaternion w x y z of length 1 is wanted, this one has length {norm:.3f}")
    return value


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


class RigFile(Strict):
    """Which modules sit where on which body."""

    body: str = Field(description="name of a shipped body, or path of a body file")
    modules: list[WornModule] = Field(min_length=1, max_length=64)
    local_devices: list[WornLocalDevice] = Field(default=[])
    cameras: PositionCameras | None = Field(
        default=None, description="cameras whose hip keypoints are a position device"
    )
    world: WorldSettings = WorldSettings()
    subject: Subject | None = Field(
        default=None, description="the person who wears it: scales the body's lengths (not module positions)"
    )
    joint_definitions: dict[str, str] = Field(
        default={}, description="joint name to one of the alternatives in the body file"
    )


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


def load_rig(name: str, beside: Path | None = None) -> WornSuit:
    """Return a rig by name or path; a fitted subject (`optical fit`) is one too, of markers.

    Raises ``SettingsError`` naming the file, the entry and the remedy."""
    from gateway.body.subject_file import is_subject, load_subject  # noqa: PLC0415 - it needs this module

    path = find_file(name, "rigs", beside)
    if is_subject(load_yaml(path)):
        return load_subject(path)
    rig = load_settings(path, RigFile)
    skeleton = load_body(rig.body, path, rig.joint_definitions)
    if rig.subject is not None:
        skeleton = scaled(skeleton, rig.subject, str(path))
    _refuse_conflicts(path, rig, skeleton)
    n = skeleton.n_segments
    module_of_segment = np.full(n, -1, dtype=np.int64)
    sensor_to_segment = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    lever_arms = np.zeros((n, 3))
    for row, module in enumerate(rig.modules):
        segment = skeleton.index(module.segment)
        module_of_segment[segment] = row
        sensor_to_segment[segment] = np.array(module.sensor_to_segment) / np.linalg.norm(
            module.sensor_to_segment
        )
        lever_arms[segment] = module.position
    field = rig.world.magnetic_field
    return WornSuit(
        skeleton=skeleton,
        module_ids=tuple(module.id for module in rig.modules),
        module_of_segment=module_of_segment,
        sensor_to_segment=sensor_to_segment,
        lever_arms=lever_arms,
        local_devices=tuple(_local_device(device, skeleton) for device in rig.local_devices),
        gravity=np.array([0.0, 0.0, -rig.world.gravity]),
        magnetic_field=field_vector(field.norm_ut, field.dip_deg, field.declination_deg),
        calibrations={m.id: m.calibration.model() for m in rig.modules if m.calibration is not None},
        ranges={m.id: m.ranges.model() for m in rig.modules if m.ranges is not None},
        sun=_sun(rig),
        camera_position=_camera_position(rig, path),
    )


def _camera_position(rig: RigFile, path: Path) -> CameraPosition | None:
    if rig.cameras is None:
        return None
    positions = [device.device for device in rig.local_devices if device.kind == "position"]
    return rig.cameras.worn(load_rig(rig.cameras.subject, path), positions, path)


def _sun(rig: RigFile) -> SunCells | None:
    place = rig.world.place
    if place is None:
        return None
    return SunCells(
        place.latitude_deg,
        place.longitude_deg,
        np.array([module.cells for module in rig.modules], dtype=np.float64),
        rig.world.second_field == "both",
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


def _local_device(device: WornLocalDevice, skeleton: Skeleton) -> LocalDevice:
    return LocalDevice(
        quantity=Quantity[device.kind.upper()],
        segment=skeleton.index(device.segment),
        position=np.array(device.position, dtype=np.float64),
        device=device.device,
        orientation=np.array(device.device_to_segment) / np.linalg.norm(device.device_to_segment),
    )


def _refuse_conflicts(path: Path, rig: RigFile, skeleton: Skeleton) -> None:
    worn: dict[str, int] = {}
    ids: dict[int, str] = {}
    for module in rig.modules:
        _known_segment(path, f"module {module.id}", module.segment, skeleton)
        if module.id in ids:
            raise SettingsError(
                f"{path}: module id {module.id} is given to '{ids[module.id]}' and '{module.segment}'"
            )
        if module.segment in worn:
            raise SettingsError(
                f"{path}: '{module.segment}' carries modules {worn[module.segment]} and {module.id}"
            )
        worn[module.segment], ids[module.id] = module.id, module.segment
    for device in rig.local_devices:
        _known_segment(path, f"local device ({device.kind})", device.segment, skeleton)
        if (device.kind == "fixed_point") != (device.device is None):
            raise SettingsError(
                f"{path}: a local device of kind '{device.kind}' "
                + (
                    "sends nothing and has no 'device' id"
                    if device.kind == "fixed_point"
                    else "needs its 'device' id"
                )
            )
        # A device shares the number space of the modules on the wire.
        if device.device in ids:
            raise SettingsError(f"{path}: id {device.device} is given to a module and to a local device")


def _known_segment(path: Path, whose: str, segment: str, skeleton: Skeleton) -> None:
    if segment not in skeleton.segment_names:
        raise SettingsError(
            f"{path}: {whose} sits on '{segment}', which body '{skeleton.name}' does not have"
            + nearest(segment, skeleton.segment_names)
        )
