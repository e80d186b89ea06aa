"""Rig files: which modules, local measuring devices and cameras go with which body, and where they sit."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from gateway.body.anthropometry import Subject, scaled
from gateway.body.body_file import Point, Quaternion, WorldSettings, load_body
from gateway.body.sensor_entries import CalibrationEntry, Vector
from gateway.body.skeleton import (
    CameraPosition,
    LocalDevice,
    SensorRanges,
    Skeleton,
    SunCells,
    WornSuit,
    field_vector,
)
from gateway.body.subject_file import is_subject, load_subject
from gateway.errors import SettingsError, nearest
from gateway.frames import Quantity
from gateway.support.settings_files import Strict, find_file, load_settings, load_yaml

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
    position: Point = Field(default=(0, 0, 0), description="proximal joint to module, segment axes, m")
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
    position: Point = Field(default=(0, 0, 0), description="proximal joint to device, segment axes, m")
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


class PositionCameras(Strict):
    """Cameras that locate the wearer of the modules."""

    subject: str = Field(description="file of `video solve --fit-subject`: the person and the cameras")
    device: int = Field(ge=0, le=63, description="id of the local device of kind position")
    sigma_mm: float = Field(default=20, gt=0, le=1000, description="standard deviation of each coordinate")
    latency_ms: float = Field(
        default=0, ge=0, le=5000, description="from a picture to the arrival of its heat maps, at the least"
    )
    turn_deg: float = Field(
        default=0,
        ge=-360,
        le=360,
        description="from east to the X axis of the cameras' world, counter-clockwise seen from above",
    )


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


def load_rig(name: str, beside: Path | None = None) -> WornSuit:
    """Return a rig by name or path; a fitted subject (`optical fit`) is one too, of markers.

    Raises ``SettingsError`` naming the file, the entry and the remedy."""
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
    """Return the cameras as the suit has them. Raises ``SettingsError`` where the rig has no device for them,
    or their subject no cameras."""
    cameras = rig.cameras
    if cameras is None:
        return None
    person = load_rig(cameras.subject, path)
    if cameras.device not in [device.device for device in rig.local_devices if device.kind == "position"]:
        raise SettingsError(
            f"{path}: cameras: no local device of kind 'position' has the id {cameras.device}: add one, "
            f"such as {{kind: position, device: {cameras.device}, segment: pelvis}}"
        )
    if person.video is None:
        raise SettingsError(
            f"{path}: cameras: '{cameras.subject}' names no cameras: one that does is written "
            "by `mocap-gateway video solve --fit-subject`"
        )
    return CameraPosition(
        person,
        cameras.device,
        cameras.sigma_mm * 1e-3,
        round(cameras.latency_ms * 1e6),
        float(np.radians(cameras.turn_deg)),
    )


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
