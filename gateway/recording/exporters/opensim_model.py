"""OpenSim: the body of a take as a model of its own, ``.osim``, with the person's lengths, masses, markers.

It has every degree of freedom that the poses have, so that a ``.mot`` of the same take puts it exactly there.
It has no muscles.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ElementTree, SubElement, indent

import numpy as np

from firmware_protocol.samples import STANDARD_GRAVITY
from gateway.body.inertia import BodyInertia, body_inertia
from gateway.body.skeleton import BodyMarkers
from gateway.contract.opensim_names import BODIES
from gateway.recording.exporters.opensim import Turns, model_turns, pelvis_origin
from gateway.recording.exporters.take import Take

USUAL_KG = 75.0
"""Of a person whose mass is not known."""
_GRAVITY = f"0 {-STANDARD_GRAVITY} 0"
_JOINT_RADIUS_M = 0.015
"""Of the ball that shows a joint."""


def write_osim(take: Take, path: Path, _units_per_m: float) -> None:
    """Write the body as an OpenSim model; lengths in metres, whatever the other exports use.

    Raises ``OSError``, and ``GatewayError`` for a body of which no table has the masses.
    """
    kg = USUAL_KG if take.mass_kg is None else take.mass_kg
    inertia = body_inertia(take.skeleton, kg)
    markers = None if take.recording is None else take.recording.meta.suit.markers

    document = Element("OpenSimDocument", Version="40000")
    model = SubElement(document, "Model", name=take.name)
    SubElement(model, "Ground", name="ground")
    _text(model, "gravity", _GRAVITY)
    _text(model, "length_units", "meters")
    _text(model, "force_units", "N")
    _bodies(model, take, inertia)
    joints = _objects(model, "JointSet", "jointset")
    for turns in model_turns(take.skeleton):
        _joint(joints, take, turns)
    if markers is not None:
        _markers(model, take, markers)

    indent(document)
    with path.open("wb") as file:
        ElementTree(document).write(file, encoding="utf-8", xml_declaration=True)


def body_name(segment: str) -> str:
    """Return the name of a segment's body in the model."""
    return BODIES.get(segment, segment)


def _origins(take: Take) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return vectors (S, 3) from each segment's joint to its body's origin, m; zero but for the root."""
    origins = np.zeros((take.skeleton.n_segments, 3))
    origins[take.skeleton.parents < 0] = pelvis_origin(take.skeleton)
    return origins


def _bodies(model: Element, take: Take, inertia: BodyInertia) -> None:
    bodies, origins = _objects(model, "BodySet", "bodyset"), _origins(take)
    for s, segment in enumerate(take.skeleton.segment_names):
        body = SubElement(bodies, "Body", name=body_name(segment))
        shown = SubElement(body, "attached_geometry")
        ball = SubElement(shown, "Sphere", name=f"{body_name(segment)}_joint")
        _text(ball, "socket_frame", "..")
        _text(ball, "radius", repr(_JOINT_RADIUS_M))
        _text(body, "mass", repr(float(inertia.mass[s])))
        _text(body, "mass_center", _numbers(inertia.centre[s] - origins[s]))
        _text(body, "inertia", _numbers(inertia.inertia[s][[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]))


def _joint(joints: Element, take: Take, turns: Turns) -> None:
    skeleton, s = take.skeleton, turns.segment
    parent, segment = int(skeleton.parents[s]), skeleton.segment_names[s]
    origins = _origins(take)
    body = body_name(segment)
    above = "ground" if parent < 0 else body_name(skeleton.segment_names[parent])
    joint = SubElement(joints, "CustomJoint", name=f"{above}_{body}")
    _text(joint, "socket_parent_frame", f"{above}_offset")
    _text(joint, "socket_child_frame", f"{body}_offset")
    coordinates = SubElement(joint, "coordinates")
    for name, limits in zip(turns.coordinates, turns.limits, strict=True):
        _coordinate(coordinates, name, _numbers(limits))
    moving = [f"{segment}_t{axis}" for axis in "xyz"] if parent < 0 else [None] * 3
    for place in moving:
        if place is not None:
            _coordinate(coordinates, place, "-100 100")
    frames = SubElement(joint, "frames")
    at = np.zeros(3) if parent < 0 else skeleton.offsets[s] - origins[parent]
    for name, on, where in ((above, "/ground" if parent < 0 else f"/bodyset/{above}", at),
                            (body, f"/bodyset/{body}", np.zeros(3))):  # fmt: skip
        frame = SubElement(frames, "PhysicalOffsetFrame", name=f"{name}_offset")
        _text(frame, "socket_parent", on)
        _text(frame, "translation", _numbers(where))
        _text(frame, "orientation", "0 0 0")
    transform = SubElement(joint, "SpatialTransform")
    for k, (name, axis) in enumerate(zip(turns.coordinates, turns.axes, strict=True), 1):
        _axis(transform, f"rotation{k}", name, axis)
    for k, (place, axis) in enumerate(zip(moving, np.eye(3), strict=True), 1):
        _axis(transform, f"translation{k}", place, axis)


def _coordinate(coordinates: Element, name: str, limits: str) -> None:
    coordinate = SubElement(coordinates, "Coordinate", name=name)
    _text(coordinate, "default_value", "0")
    _text(coordinate, "range", limits)
    _text(coordinate, "clamped", "false")


def _axis(transform: Element, name: str, coordinate: str | None, axis: np.ndarray[Any, Any]) -> None:
    along = SubElement(transform, "TransformAxis", name=name)
    _text(along, "coordinates", coordinate or "")
    _text(along, "axis", _numbers(axis))
    if coordinate is None:
        _text(SubElement(along, "Constant", name="function"), "value", "0")
    else:
        _text(SubElement(along, "LinearFunction", name="function"), "coefficients", "1 0")


def _markers(model: Element, take: Take, markers: BodyMarkers) -> None:
    listed, origins = _objects(model, "MarkerSet", "markerset"), _origins(take)
    for label, s, place in zip(markers.labels, markers.segments.tolist(), markers.positions, strict=True):
        marker = SubElement(listed, "Marker", name=label)
        _text(marker, "socket_parent_frame", f"/bodyset/{body_name(take.skeleton.segment_names[s])}")
        _text(marker, "location", _numbers(place - origins[s]))
        _text(marker, "fixed", "true")


def _objects(model: Element, kind: str, name: str) -> Element:
    return SubElement(SubElement(model, kind, name=name), "objects")


def _text(element: Element, name: str, text: str) -> None:
    SubElement(element, name).text = text


def _numbers(values: np.ndarray[Any, Any]) -> str:
    return " ".join(repr(float(each)) for each in values)
