"""What a recording holds beside the data: suit, configuration without secrets, software and host.

The suit stands there twice: as JSON with every number bit for bit, since reading a rig file normalises
quaternions; and as the rig and body files that people edit. JSON fields are found by the dataclasses
themselves, so that a suit that grows is still stored whole.
"""

from __future__ import annotations

import dataclasses
import enum
import json
import math
import platform
import re
import sys
import types
import typing
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit, urlunsplit

import numpy as np
import yaml

import gateway
from devices import recording_format as fmt
from gateway.body.body_file import WORLD_NAME
from gateway.body.joints import WORLD, Angle, Decomposition, Joint
from gateway.body.sensor_entries import CalibrationEntry
from gateway.body.skeleton import Skeleton, WornSuit, field_dip_deg
from gateway.errors import SettingsError
from gateway.settings import GatewaySettings
from gateway.support.former_names import current
from gateway.support.processor import target_name

REDACTED = "(not recorded)"
_SECRET = re.compile(r"(password|passphrase|secret|token|psk|api_?key)(?!_file)", re.IGNORECASE)
_LIBRARIES = ("numpy", "scipy", "numba", "llvmlite", "vqf", "mcap")


def attachments_of(settings: GatewaySettings, suit: WornSuit) -> dict[str, bytes]:
    """Return the attachments of a recording that begins now, by name."""
    attachments = {
        fmt.SUIT: encode_suit(suit),
        fmt.BODY: _yaml(body_of(suit.skeleton)),
        fmt.RIG: _yaml(rig_of(suit)),
        fmt.SETTINGS: json.dumps(without_secrets(settings.model_dump(mode="json")), indent=1).encode(),
        fmt.HOST: json.dumps(host(), indent=1).encode(),
    }
    if settings.clock.table is not None:
        attachments[fmt.CLOCK_TABLE] = Path(settings.clock.table).read_bytes()
    return attachments


def without_secrets(plain: Any, key: str = "") -> Any:
    """Return JSON values without secrets: keys named like one, and user names and passwords in URLs."""
    if isinstance(plain, dict):
        return {name: without_secrets(value, name) for name, value in plain.items()}
    if isinstance(plain, list):
        return [without_secrets(value, key) for value in plain]
    if isinstance(plain, str):
        return REDACTED if plain and _SECRET.search(key) else _without_credentials(plain)
    return plain


def _without_credentials(text: str) -> str:
    if "://" not in text or "@" not in text:
        return text
    try:
        parts = urlsplit(text)
    except ValueError:
        return REDACTED
    return urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))


def host() -> dict[str, object]:
    """Return versions and machine: what bit-identical results may depend on."""
    return {
        "gateway": gateway.__version__,
        "python": platform.python_version(),
        "implementation": sys.implementation.name,
        "libraries": {name: _version(name) for name in _LIBRARIES},
        "kernel": f"{platform.system()} {platform.release()}",
        "machine": platform.machine(),
        "processor": _processor(),
        "instructions": target_name(),
    }


def _version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return ""


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(errors="replace").splitlines() if info.exists() else []
    named = (line.split(":", 1)[1].strip() for line in lines if line.startswith(("model name", "Model")))
    return next(named, platform.processor())


def _yaml(content: dict[str, Any]) -> bytes:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110).encode()


_Dataclass = TypeVar("_Dataclass")


def encode_suit(suit: WornSuit) -> bytes:
    """Return the suit as JSON text."""
    return json.dumps(_plain(suit), indent=1).encode()


def decode_suit(text: bytes) -> WornSuit:
    """Return the suit that ``text`` was made of. Raises ``SettingsError`` for a text that describes none."""
    try:
        return _built(WornSuit, current(json.loads(text)))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise SettingsError(f"the recorded suit cannot be read: {error}") from error


def _plain(value: Any) -> Any:
    """Return a value as JSON values; numbers of arrays keep their shortest exact form."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: _plain(getattr(value, field.name)) for field in fields if field.init}
    if isinstance(value, np.ndarray):
        return {"dtype": value.dtype.str, "shape": list(value.shape), "values": value.ravel().tolist()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return _plain_scalar(value)


def _plain_scalar(value: Any) -> Any:
    if isinstance(value, enum.Enum):
        return value.value
    return value.item() if isinstance(value, np.generic) else value


def _built(kind: type[_Dataclass], plain: dict[str, Any]) -> _Dataclass:
    """Return a dataclass of its plain form: fields that the text lacks keep their defaults, others are
    refused."""
    hints = typing.get_type_hints(kind)
    names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(set(plain) - names)
    if unknown:
        raise ValueError(f"'{unknown[0]}' is not known to this version: a newer one wrote it")
    return kind(**{name: _value(hints[name], item) for name, item in plain.items()})


def _value(hint: Any, plain: Any) -> Any:
    """Return a field's value of its plain form, by the field's type."""
    if isinstance(plain, dict) and set(plain) == {"dtype", "shape", "values"}:
        return np.array(plain["values"], dtype=_number_type(plain["dtype"])).reshape(plain["shape"])
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in {typing.Union, types.UnionType}:
        options = [option for option in inner if option is not type(None)]
        return None if plain is None else _value(options[0], plain)
    if origin in {tuple, list}:
        # tuple[X, ...] has one type for all items, tuple[X, Y] one for each.
        hints = inner if len(inner) == len(plain) and ... not in inner else (inner[0],) * len(plain)
        return origin(_value(each, item) for each, item in zip(hints, plain, strict=True))
    if origin in {dict, Mapping}:
        return {_value(inner[0], key): _value(inner[1], item) for key, item in plain.items()}
    return _scalar(hint, plain)


def _number_type(name: object) -> np.dtype[Any]:
    """Plain numbers only: numpy would also read objects, records and expressions from such a name."""
    if not re.fullmatch(r"[<>|=][biuf][1248]", str(name)):
        raise ValueError(f"{str(name)[:20]!r} is no type of a number")
    return np.dtype(str(name))


def _scalar(hint: Any, plain: Any) -> Any:
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _built(hint, plain)
    is_converted = isinstance(hint, type) and (issubclass(hint, enum.Enum) or hint is int)
    return hint(plain) if is_converted else plain


_DIGITS = 12
"""Of calibrations: ``suit.json`` has every bit."""


def body_of(skeleton: Skeleton) -> dict[str, Any]:
    """Return a skeleton as the content of a body file."""
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
    """Return a worn suit as the content of a rig file beside its body file."""
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
    # In the order of the suit: poses of a replay depend on the order of the modules.
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
