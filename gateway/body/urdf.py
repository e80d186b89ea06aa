"""Robots described in URDF, as bodies.

A segment is a link with all that is fixed to it; its origin is where its joint is. As in every body file, all
segments' axes are parallel in the neutral posture, here those of the base link with all joints at zero: joint
axes keep their URDF directions in that posture, whatever way each link's own frame is turned.

Parsed with the standard library's parser behind ``defusedxml``, since URDF files come from anywhere. The URDF
libraries (yourdfpy, urchin) would bring a mesh library along for what is a tree of joints.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree.ElementTree import Element, ParseError  # types only; defusedxml parses

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from devices.deferred import Rotation
from gateway.errors import SettingsError
from gateway.frames import FloatArray

_DECIMALS = 9
_TURNING = ("revolute", "continuous")
_RIGID = ("fixed", "prismatic")


@dataclass(frozen=True)
class UrdfJoint:
    """A ``<joint>`` element."""

    name: str
    kind: str
    parent: str
    child: str
    xyz: FloatArray  # (3,) m, in the parent link
    rotation: FloatArray  # (3, 3) child link to parent link at zero
    axis: FloatArray  # (3,) in the child link
    limits: tuple[float, float] | None  # rad or m
    rate: float | None = None  # rad/s or m/s, the fastest; None: not stated

    @property
    def turns(self) -> bool:
        """Whether it is revolute or continuous."""
        return self.kind in _TURNING


@dataclass(frozen=True)
class UrdfTree:
    """Links and joints of a URDF."""

    name: str
    links: list[str]
    """Parents before children; the first is the base."""
    joint_of: dict[str, UrdfJoint]
    """By the link at its end."""


@dataclass
class ImportedRobot:
    """A body file's content, and how it relates to the links of the robot."""

    content: dict[str, Any]
    """For a body file."""
    segment_of_link: dict[str, str] = field(default_factory=dict)
    """Which segment each link became part of."""
    link_in_segment: dict[str, FloatArray] = field(default_factory=dict)
    """(4, 4) link to segment, constant."""
    notes: list[str] = field(default_factory=list)
    """What could not be taken over as it is, for the user."""


def import_urdf(text: str, where: str = "URDF", has_fixed_base: bool = True) -> ImportedRobot:
    """Return the robot of a URDF text as a body.

    has_fixed_base: joints on the base turn against the world; otherwise against the base, which is then to
    carry a module. Raises ``SettingsError``, which begins with ``where``, for what is no URDF tree.
    """
    tree = read_urdf(text, where)
    name = _plain(tree.name, set())
    builder = _Builder(tree.links[0], has_fixed_base)
    for link in tree.links[1:]:
        builder.add(tree.joint_of[link], where)
    if not builder.joints:
        raise SettingsError(f"{where}: no joint of robot '{name}' turns (revolute, continuous)")
    return builder.robot(name)


def read_urdf(text: str, where: str = "URDF") -> UrdfTree:
    """Return links and joints. Raises ``SettingsError``, which begins with ``where``."""
    robot = _root(text, where)
    links = [_named(link, where) for link in robot.findall("link")]
    joints = [_joint(element, where) for element in robot.findall("joint")]
    order = _from_the_base(links, joints, where)
    return UrdfTree(robot.get("name") or "robot", order, {joint.child: joint for joint in joints})


class _Builder:
    """Segments and joints, link by link from the base outward."""

    def __init__(self, base: str, has_fixed_base: bool) -> None:
        self._names: set[str] = set()
        self._base = self._new_name(base)
        self._has_fixed_base = has_fixed_base
        self._at_zero: dict[str, FloatArray] = {base: np.eye(4)}  # link to base
        self._segment = {base: self._base}
        self._origin: dict[str, FloatArray] = {self._base: np.zeros(3)}
        self._parents: dict[str, str | None] = {self._base: None}
        self._ends: dict[str, list[FloatArray]] = {self._base: []}
        self.joints: list[dict[str, Any]] = []
        self._notes: list[str] = []

    def add(self, joint: UrdfJoint, where: str) -> None:
        """Add the link at the end of a joint; a fixed or sliding joint adds it to its parent's segment."""
        # Poses with all joints at zero, in the axes of the base: a body file has one frame for all segments.
        pose = self._at_zero[joint.parent] @ _transform(joint)
        self._at_zero[joint.child] = pose
        segment = self._segment[joint.parent]
        self._ends[segment].append(pose[:3, 3] - self._origin[segment])
        if joint.kind in _RIGID:
            self._segment[joint.child] = segment
            if joint.kind == "prismatic":
                self._notes.append(f"joint '{joint.name}' slides: it is taken as fixed at zero")
            return
        if joint.kind not in _TURNING:
            raise SettingsError(
                f"{where}: joint '{joint.name}' is of type '{joint.kind}'; known are revolute, continuous, "
                "fixed and prismatic (taken as fixed)"
            )

        own = self._new_name(joint.child)
        self._segment[joint.child] = own
        self._origin[own] = pose[:3, 3]
        self._parents[own], self._ends[own] = segment, []
        self.joints.append(self._entry(joint, segment, own, pose[:3, :3] @ joint.axis))

    def robot(self, name: str) -> ImportedRobot:
        """Return all of it."""
        segments = [self._segment_entry(segment) for segment in self._parents]
        content = {"name": name, "neutral": [1, 0, 0, 0], "segments": segments, "joints": self.joints}
        imported = ImportedRobot(content, self._segment, notes=self._notes)
        for link, segment in self._segment.items():
            pose = self._at_zero[link].copy()
            pose[:3, 3] -= self._origin[segment]
            imported.link_in_segment[link] = pose
        return imported

    def _segment_entry(self, segment: str) -> dict[str, Any]:
        parent = self._parents[segment]
        ends = self._ends[segment]
        tip = max(ends, key=lambda end: float(np.linalg.norm(end)), default=np.zeros(3))
        entry: dict[str, Any] = {"name": segment, "parent": parent, "tip": _numbers(tip)}
        if parent is not None:
            entry["joint"] = _numbers(self._origin[segment] - self._origin[parent])
        return entry

    def _entry(self, joint: UrdfJoint, proximal: str, distal: str, axis: FloatArray) -> dict[str, Any]:
        angle: dict[str, Any] = {"axis": _numbers(axis)}
        if joint.limits is not None and joint.kind == "revolute":
            angle["limits_deg"] = np.round(np.degrees(joint.limits), 6).tolist()
        is_on_base = self._has_fixed_base and proximal == self._base
        return {
            "name": _plain(joint.name, {entry["name"] for entry in self.joints}),
            "proximal": "world" if is_on_base else proximal,
            "distal": distal,
            "angles": {"angle": angle},
        }

    def _new_name(self, link: str) -> str:
        name = _plain(link, self._names)
        self._names.add(name)
        return name


def _root(text: str, where: str) -> Element:
    try:
        robot: Element = fromstring(text, forbid_dtd=True)
    except DefusedXmlException as error:
        raise SettingsError(
            f"{where}: refused, a URDF needs no document type or entities ({error})"
        ) from error
    except (ParseError, ValueError) as error:
        raise SettingsError(f"{where}: no XML: {error}") from error
    if robot.tag != "robot":
        raise SettingsError(f"{where}: begins with <{robot.tag}>, a URDF begins with <robot>")
    if any("xacro" in str(element.tag) for element in robot.iter()):
        raise SettingsError(f"{where}: holds xacro macros: expand it first, with `xacro FILE > robot.urdf`")
    return robot


def _from_the_base(links: list[str], joints: list[UrdfJoint], where: str) -> list[str]:
    """Return links, parents before children. Raises ``SettingsError`` for what is no single tree."""
    children: dict[str, list[str]] = {link: [] for link in links}
    if len(children) < len(links):
        raise SettingsError(f"{where}: two links have the same name")
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end not in children:
                raise SettingsError(f"{where}: joint '{joint.name}' names link '{end}', which is not there")
        children[joint.parent].append(joint.child)
    ends = [joint.child for joint in joints]
    bases = [link for link in links if link not in ends]
    if len(bases) != 1 or len(set(ends)) < len(ends):
        raise SettingsError(f"{where}: the links must form one tree; found {len(bases)} bases: {bases}")
    order = [bases[0]]
    for link in order:
        order.extend(children[link])
    # A loop beside the tree has no base, and so was never reached from it.
    if len(order) != len(links):
        raise SettingsError(f"{where}: {len(links) - len(order)} links are joined in a loop")
    return order


def _joint(element: Element, where: str) -> UrdfJoint:
    name = _named(element, where)
    where = f"{where}: joint '{name}'"
    ends = {}
    for end in ("parent", "child"):
        found = element.find(end)
        link = found.get("link") if found is not None else None
        if link is None:
            raise SettingsError(f"{where} has no <{end} link=…>")
        ends[end] = link
    origin, limit = _attributes(element, "origin"), _attributes(element, "limit")
    kind = element.get("type") or ""
    axis = _vector(_attributes(element, "axis").get("xyz", "1 0 0"), f"{where} axis")
    length = float(np.linalg.norm(axis))
    if kind in _TURNING and not length > 1e-9:
        raise SettingsError(f"{where} has an axis of length zero")
    rpy = _vector(origin.get("rpy", "0 0 0"), f"{where} rpy")
    return UrdfJoint(
        name,
        kind,
        ends["parent"],
        ends["child"],
        _vector(origin.get("xyz", "0 0 0"), f"{where} xyz"),
        Rotation.from_euler("xyz", rpy).as_matrix(),
        axis / max(length, 1e-9),
        _joint_limits(limit, where),
        _fastest(limit, where),
    )


def _joint_limits(limit: Mapping[str, str], where: str) -> tuple[float, float] | None:
    if "lower" not in limit and "upper" not in limit:
        return None
    low, high, _ = _vector(f"{limit.get('lower', '0')} {limit.get('upper', '0')} 0", f"{where} limit")
    if low > high:
        raise SettingsError(f"{where} has limits {low:g} to {high:g}: the smaller one comes first")
    return float(low), float(high)


def _fastest(limit: Mapping[str, str], where: str) -> float | None:
    if "velocity" not in limit:
        return None
    rate = float(_vector(f"{limit['velocity']} 0 0", f"{where} velocity")[0])
    return rate if rate > 0 else None


def _attributes(element: Element, tag: str) -> Mapping[str, str]:
    found = element.find(tag)
    return {} if found is None else found.attrib


def _vector(text: str, where: str) -> FloatArray:
    try:
        numbers = [float(part) for part in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise SettingsError(f"{where} is '{text}': three numbers are wanted")
    return np.array(numbers)


def _transform(joint: UrdfJoint) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = joint.rotation, joint.xyz
    return pose


def _named(element: Element, where: str) -> str:
    name = element.get("name")
    if not name:
        raise SettingsError(f"{where}: a <{element.tag}> has no name")
    return name


def _plain(name: str, taken: set[str]) -> str:
    """Return a name in the letters of body files, unlike those taken."""
    plain = re.sub(r"[^a-z0-9_]+", "_", name.lower()).strip("_") or "part"
    plain = f"{plain}_link" if plain == "world" else plain
    unique, n = plain, 2
    while unique in taken:
        unique, n = f"{plain}_{n}", n + 1
    return unique


def _numbers(vector: FloatArray) -> list[float]:
    numbers: list[float] = (np.round(vector, _DECIMALS) + 0.0).tolist()
    return numbers
