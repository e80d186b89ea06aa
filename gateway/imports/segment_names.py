"""Which segment a module sits on: by what it is called, or by a map (YAML, OpenSense's XML)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import parse

from gateway.errors import GatewayError, nearest
from gateway.support.settings_files import load_yaml

BODY = "human_17"
"""What is worn of where no body is named."""

_PARTS: dict[str, tuple[str, ...]] = {
    "pelvis": ("pelvis", "hips", "sacrum"),
    "thorax": ("thorax", "torso", "trunk", "chest", "sternum", "t8"),
    "head": ("head",),
    "shoulder_girdle": ("shoulder girdle", "shoulder", "clavicle", "scapula"),
    "upper_arm": ("upper arm", "upperarm", "humerus"),
    "forearm": ("forearm", "fore arm", "lower arm", "lowerarm", "radius", "ulna"),
    "hand": ("hand",),
    "thigh": ("thigh", "upper leg", "upperleg", "femur"),
    "shank": ("shank", "lower leg", "lowerleg", "tibia", "calf"),
    "foot": ("foot", "calcn", "calcaneus"),
}
_CENTRAL = {"pelvis", "thorax", "head"}
_SIDES = {"left": "left", "l": "left", "lft": "left", "right": "right", "r": "right", "rgt": "right"}
_NOT_WORN = {"imu", "sensor", "dot", "mt", "mtw"}


@dataclass(frozen=True)
class SegmentNames:
    """What became of the modules' names."""

    segments: dict[int, str]
    """Module id to segment."""
    unknown: tuple[str, ...]
    """Modules on no segment that is known: they are recorded, and belong to no body."""
    notes: tuple[str, ...]


def segment_of(name: str) -> tuple[str, bool] | None:
    """Return the segment that a name means, and whether its side had to be guessed; None when it means
    none."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    words = [word for word in re.split(r"[^a-z0-9]+", spaced.lower()) if word and word not in _NOT_WORN]
    sides = [_SIDES[word] for word in words if word in _SIDES]
    rest = " ".join(word for word in words if word not in _SIDES)
    part = next((part for part, names in _PARTS.items() if rest in names), None)
    if part is None:
        return None
    if part in _CENTRAL:
        return part, False
    return f"{sides[0] if sides else 'right'}_{part}", not sides


def mapped_segments(names: Mapping[int, str], given: Mapping[str, str], known: Sequence[str]) -> SegmentNames:
    """Return segments of modules, by ``given`` (name or end of a name to segment) or else by what names mean.

    known: the segments there are. Raises ``GatewayError`` for one that is not, for a given name that no
    module has, and for two modules on one segment.
    """
    segments: dict[int, str] = {}
    unknown, notes, used = [], [], set()
    for module, name in names.items():
        key = _given_for(name, given)
        if key is not None:
            used.add(key)
            segments[module] = _segment(given[key], known, name)
        elif (meant := segment_of(name)) is None or meant[0] not in known:
            unknown.append(name)
        else:
            segments[module] = meant[0]
            if meant[1]:
                notes.append(f"'{name}' tells no side: taken for {meant[0]}; --map {name}=… says otherwise")
    idle = sorted(set(given) - used)
    if idle:
        raise GatewayError(f"no module is called '{idle[0]}'{nearest(idle[0], names.values())}")
    _refuse_two_on_one(segments, names)
    return SegmentNames(segments, tuple(unknown), tuple(notes))


def _given_for(name: str, given: Mapping[str, str]) -> str | None:
    """Return the key of ``given`` that is the name, or its end (a serial number)."""
    if name in given:
        return name
    ends = [key for key in given if name.lower().endswith(key.lower().lstrip("_"))]
    return ends[0] if ends else None


def _segment(text: str, known: Sequence[str], name: str) -> str:
    if text in known:
        return text
    meant = segment_of(text)
    if meant is None or meant[1] or meant[0] not in known:
        raise GatewayError(f"'{name}' is mapped to '{text}', which is no segment{nearest(text, known)}")
    return meant[0]


def _refuse_two_on_one(segments: Mapping[int, str], names: Mapping[int, str]) -> None:
    worn: dict[str, int] = {}
    for module, segment in segments.items():
        if segment in worn:
            raise GatewayError(
                f"'{names[worn[segment]]}' and '{names[module]}' both mean {segment}: tell them apart, "
                f"--map '{names[module]}=left_thigh' or the like"
            )
        worn[segment] = module


def read_maps(texts: list[str]) -> dict[str, str]:
    """Return ``--map`` options together: ``NAME=SEGMENT`` or a file. Raises ``GatewayError``."""
    given: dict[str, str] = {}
    for text in texts:
        name, equals, segment = text.rpartition("=")
        if equals and name and segment:
            given[name] = segment
        else:
            given.update(_of_file(Path(text)))
    return given


def _of_file(path: Path) -> dict[str, str]:
    if path.suffix.lower() == ".xml":
        return _of_opensense(path)
    content = load_yaml(path)
    if not isinstance(content, dict) or not all(isinstance(value, str) for value in content.values()):
        raise GatewayError(f"{path}: lines 'module: segment' are wanted, such as '00B42279: pelvis'")
    return {str(name): segment for name, segment in content.items()}


def _of_opensense(path: Path) -> dict[str, str]:
    """Return ``<ExperimentalSensor name="_00B42279">`` with its ``<name_in_model>``."""
    try:
        sensors = list(parse(path, forbid_dtd=True).iter("ExperimentalSensor"))
    except (ParseError, DefusedXmlException) as error:
        raise GatewayError(f"{path}: no XML that can be read ({error})") from error
    except OSError as error:
        raise GatewayError(f"{path} cannot be read: {error.strerror}") from error
    if not sensors:
        raise GatewayError(f"{path} names no <ExperimentalSensor>: a mapping file of OpenSense is wanted")
    return {str(each.get("name")): each.findtext("name_in_model", "").strip() for each in sensors}
