"""A robot that is to follow a person: its URDF, and a file that says which link follows which segment."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from gateway.body.skeleton import Skeleton
from gateway.body.urdf import UrdfJoint, UrdfTree, read_urdf
from gateway.errors import SettingsError, nearest
from gateway.frames import FloatArray
from gateway.support.settings_files import Strict, find_file, load_settings, read_text

_FORWARD = {
    "x": np.eye(3),
    "-x": np.diag([-1.0, -1.0, 1.0]),
    "y": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
    "-y": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}
"""Base link to a world in which the robot looks along x."""


class LinkEntry(Strict):
    """What one link follows."""

    segment: str
    orientation: float = Field(default=1.0, ge=0, le=100, description="weight, of rad")
    reach: float = Field(
        default=0.0, ge=0, le=100, description="weight of its place, of m; 0: orientation alone"
    )
    start: str | None = Field(
        default=None, description="segment that its place is taken from, such as the upper arm of a hand"
    )
    start_link: str | None = Field(default=None, description="link that stands for that segment")

    @model_validator(mode="after")
    def _reach_has_a_start(self) -> Self:
        if self.reach and (self.start is None or self.start_link is None):
            raise ValueError("reach is taken from somewhere: name start (a segment) and start_link")
        return self


class RobotFile(Strict):
    """How a robot follows a person."""

    urdf: str | None = Field(
        default=None, description="its URDF, absolute or beside this file; else outputs.retarget.urdf"
    )
    base: str = Field(description="segment that the base link stands for: pelvis, or thorax for an arm")
    forward: Literal["x", "-x", "y", "-y"] = Field(
        default="x", description="axis of the base link along which the robot looks"
    )
    soles: tuple[str, ...] = Field(
        default=(), description="links that stand on the ground; none: the base is bolted down"
    )
    neutral_deg: dict[str, float] = Field(
        default={}, description="joint angles at which it stands as a person does with hanging arms; others 0"
    )
    most_deg_per_s: float = Field(
        default=360, gt=0, le=100_000, description="fastest turn of a joint whose URDF allows more"
    )
    links: dict[str, LinkEntry] = Field(min_length=1)

    @model_validator(mode="before")
    @classmethod
    def _segments_alone(cls, given: Any) -> Any:
        """Take ``link: segment`` for ``link: {segment: segment}``."""
        if isinstance(given, dict) and isinstance(given.get("links"), dict):
            links = {
                link: {"segment": entry} if isinstance(entry, str) else entry
                for link, entry in given["links"].items()
            }
            return {**given, "links": links}
        return given


@dataclass(frozen=True)
class Robot:
    """A robot and what its links follow."""

    tree: UrdfTree
    joints: tuple[UrdfJoint, ...]
    """Those that turn, limb by limb from the base outward: the order of all arrays of joints."""
    limits: FloatArray
    """(J, 2) rad; infinite: continuous."""
    rates: FloatArray
    """(J,) rad/s, the fastest."""
    neutral: FloatArray
    """(J,) rad, where it stands as a person does with hanging arms; within the limits or not."""
    file: RobotFile

    @property
    def joint_names(self) -> tuple[str, ...]:
        """As the URDF names them."""
        return tuple(joint.name for joint in self.joints)

    @property
    def base_to_world(self) -> FloatArray:
        """(3, 3) base link to a world in which the robot looks along x."""
        return _FORWARD[self.file.forward]


def load_robot(name: str, skeleton: Skeleton, urdf: Path | None = None) -> Robot:
    """Read a robot file, shipped or a path, and the URDF that it or ``urdf`` names.

    Raises ``SettingsError`` naming file, field and remedy, for what the person does not have among it.
    """
    path = find_file(name, "robots")
    file = load_settings(path, RobotFile)
    if urdf is None and file.urdf is None:
        raise SettingsError(
            f"{path}: 'urdf' is missing, and outputs.retarget.urdf too: name the robot's URDF"
        )
    source = urdf if urdf is not None else path.parent / str(file.urdf)
    return robot_of(read_urdf(read_text(source), str(source)), file, skeleton, str(path))


def robot_of(tree: UrdfTree, file: RobotFile, skeleton: Skeleton, where: str) -> Robot:
    """Check one against the others. Raises ``SettingsError``, which begins with ``where``."""
    joints = tuple(joint for joint in _limb_by_limb(tree, tree.links[0]) if joint.turns)
    known = [joint.name for joint in joints]
    _check(file.neutral_deg, known, f"{where}: neutral_deg", "turning joint of the robot")
    _check(file.soles, tree.links, f"{where}: soles", "link of the robot")
    _check(file.links, tree.links, f"{where}: links", "link of the robot")
    segments = [file.base]
    for entry in file.links.values():
        segments += [entry.segment] if entry.start is None else [entry.segment, entry.start]
        if entry.start_link is not None:
            _check([entry.start_link], tree.links, f"{where}: start_link", "link of the robot")
    _check(segments, skeleton.segment_names, f"{where}: links", f"segment of body '{skeleton.name}'")

    most = np.radians(file.most_deg_per_s)
    return Robot(
        tree,
        joints,
        np.array([_limits(joint) for joint in joints]).reshape(-1, 2),
        # A URDF may leave the rate out, or have one that is faster than wanted.
        np.array([min(most, joint.rate or most) for joint in joints]),
        np.radians([file.neutral_deg.get(name, 0.0) for name in known]),
        file,
    )


def _limb_by_limb(tree: UrdfTree, link: str) -> Iterator[UrdfJoint]:
    """Yield the joints beyond a link, each before those beyond it: MuJoCo's order."""
    for child in tree.links:
        joint = tree.joint_of.get(child)
        if joint is not None and joint.parent == link:
            yield joint
            yield from _limb_by_limb(tree, child)


def _limits(joint: UrdfJoint) -> tuple[float, float]:
    if joint.kind == "continuous" or joint.limits is None:
        return -np.inf, np.inf
    return joint.limits


def _check(names: Iterable[str] | Mapping[str, object], known: Iterable[str], where: str, what: str) -> None:
    known = list(known)
    for name in names:
        if name not in known:
            raise SettingsError(f"{where}: '{name}' is no {what}{nearest(name, known)}")
