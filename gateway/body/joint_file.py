"""Joints as they stand in body files, and as the program uses them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from gateway.body.joints import WORLD, Angle, Decomposition, Joint
from gateway.errors import SettingsError, nearest
from gateway.frames import Vector3
from gateway.support.names import LOWER_NAME
from gateway.support.settings_files import Strict

Finite = Annotated[float, Field(allow_inf_nan=False)]
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
