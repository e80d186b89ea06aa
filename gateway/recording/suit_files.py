"""A worn suit as the rig and body files that people edit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from devices import recording_format as fmt
from gateway.body.joint_file import WORLD_NAME
from gateway.body.joints import WORLD, Angle, Decomposition, Joint
from gateway.body.sensor_entries import CalibrationEntry
from gateway.body.skeleton import Skeleton, WornSuit, field_dip_deg

_DIGITS = 12
"""Of calibrations: ``suit.json`` has every bit."""


def body_of(skeleton: Skeleton) -> dict[str, Any]:
    """A skeleton as the content of a body file."""
    names = skeleton.segment_names
    content: dict[str, Any] = {
        "name": skeleton.name,
        "neutral": skeleton.neutral.tolist(),
        "segments": [
            {
                "name": name,
                "parent": None if parent < 0 else names[parent],
                "joint": skeleton.offsets[i].tolist(),
                "tip": skeleton.tips[i].tolist(),
                "contacts": [point.tolist() for segment, point in skeleton.contacts if segment == i],
            }
            for i, (name, parent) in enumerate(zip(names, skeleton.parents.tolist(), strict=True))
        ],
        "joints": [_joint(joint, names) for joint in skeleton.joints],
    }
    for rule in skeleton.interpolations:
        between = [names[rule.first], names[rule.second]]
        content["segments"][rule.segment]["interpolate"] = {"between": between, "fraction": rule.fraction}
    if skeleton.stature_m is not None:
        content["stature_m"] = skeleton.stature_m
    return content


def _joint(joint: Joint, names: Sequence[str]) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": joint.name,
        "proximal": WORLD_NAME if joint.proximal == WORLD else names[joint.proximal],
        "distal": names[joint.distal],
        "angles": {angle.name: _angle(angle, joint.decomposition) for angle in joint.angles},
        "free": list(joint.free),
        "source": joint.source,
    }
    if joint.decomposition is not Decomposition.HINGE:
        entry["decomposition"] = joint.decomposition.name.lower()
    return entry


def _angle(angle: Angle, decomposition: Decomposition) -> dict[str, Any]:
    letter = ("-" if angle.sign < 0 else "") + "xyz"[angle.axis_index]
    is_hinge = decomposition is Decomposition.HINGE
    entry: dict[str, Any] = {"axis": list(angle.axis) if is_hinge else letter}
    if math.isfinite(angle.limits[0]) and math.isfinite(angle.limits[1]):
        entry["limits_deg"] = np.degrees(angle.limits).tolist()
    return entry


def rig_of(suit: WornSuit) -> dict[str, Any]:
    """A worn suit as the content of a rig file beside its body file."""
    names = suit.skeleton.segment_names
    modules: list[dict[str, Any]] = [
        {
            "id": suit.module_ids[row],
            "segment": names[segment],
            "position": suit.lever_arms[segment].tolist(),
            "sensor_to_segment": suit.sensor_to_segment[segment].tolist(),
        }
        for segment, row in enumerate(suit.module_of_segment.tolist())
        if row >= 0
    ]
    for module in modules:
        calibration = suit.calibrations.get(module["id"])
        if calibration is not None:
            entry = CalibrationEntry.of(calibration, digits=_DIGITS)
            module["calibration"] = entry.model_dump(mode="json", exclude_none=True)
        if suit.sun is not None:
            module["cells"] = suit.sun.normals[suit.module_ids.index(module["id"])].tolist()
    modules.sort(key=lambda module: suit.module_ids.index(module["id"]))
    devices = [
        {
            "kind": device.quantity.name.lower(),
            "segment": names[device.segment],
            "device": device.device,
            "position": device.position.tolist(),
            "device_to_segment": device.orientation.tolist(),
        }
        for device in suit.local_devices
    ]
    return {"body": fmt.BODY, "modules": modules, "local_devices": devices, "world": _world(suit)}


def _world(suit: WornSuit) -> dict[str, Any]:
    east, north, _ = suit.magnetic_field
    field = {
        "norm_ut": float(np.linalg.norm(suit.magnetic_field)),
        "dip_deg": field_dip_deg(suit.magnetic_field),
        "declination_deg": float(np.degrees(np.arctan2(east, north))),
    }
    world: dict[str, Any] = {"gravity": float(-suit.gravity[2]), "magnetic_field": field}
    if suit.sun is not None:
        world["second_field"] = "both" if suit.sun.beside_magnetometer else "sun"
        world["place"] = {"latitude_deg": suit.sun.latitude_deg, "longitude_deg": suit.sun.longitude_deg}
    return world
