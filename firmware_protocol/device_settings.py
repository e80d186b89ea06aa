"""What a module can be told to keep: every setting declared once, with limits and factory value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import radians
from typing import Any

from firmware_protocol.codec import FieldsCodec
from firmware_protocol.fields import WireField
from firmware_protocol.framing import MAX_MODULE


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One setting: how its value lies on the wire and in flash, and what it is at first."""

    key: int
    value: WireField
    """Layout, unit, scale, limits, sentence; its name is the setting's."""
    factory: Any

    @property
    def name(self) -> str:
        """Name of the setting."""
        return self.value.name


def _setting(key: int, name: str, code: str, factory: Any, sentence: str, **rest: Any) -> Setting:
    return Setting(key=key, factory=factory, value=WireField(name=name, code=code, sentence=sentence, **rest))


_DECIHERTZ = 0.1
_DEGREE = radians(1)
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_NO_CALIBRATION = (*_IDENTITY, *[0.0] * 3, *[0.0] * 3, *_IDENTITY, *[0.0] * 3, 25.0, 0.0, 0.0)

_DECLARED = (
    _setting(
        1, "module_id", "B", 0, "Id under which the module sends, unique in a suit.", maximum=MAX_MODULE
    ),
    _setting(
        2,
        "sampling_rate",
        "H",
        100.0,
        "Samples of accelerometer and gyroscope each second.",
        unit="Hz",
        scale=_DECIHERTZ,
        minimum=10 * _DECIHERTZ,
        maximum=40_000 * _DECIHERTZ,
    ),
    _setting(
        3,
        "accelerometer_range",
        "H",
        1_569 * 0.1,
        "Largest specific force of an axis; the sensor takes the nearest range that holds it.",
        unit="m/s²",
        scale=0.1,
        minimum=100 * 0.1,
        maximum=4_000 * 0.1,
    ),
    _setting(
        4,
        "gyroscope_range",
        "H",
        2000 * _DEGREE,
        "Largest angular rate of an axis; one step is 1°/s.",
        unit="rad/s",
        scale=_DEGREE,
        minimum=15 * _DEGREE,
        maximum=4_000 * _DEGREE,
    ),
    _setting(
        5,
        "magnetometer_range",
        "H",
        4900.0,
        "Largest magnetic field of an axis.",
        unit="µT",
        scale=1.0,
        minimum=100.0,
        maximum=10_000.0,
    ),
    _setting(
        6,
        "accelerometer_low_pass",
        "H",
        0.0,
        "Cut-off frequency of the sensor's own filter; 0 turns it off.",
        unit="Hz",
        scale=_DECIHERTZ,
        maximum=40_000 * _DECIHERTZ,
    ),
    _setting(
        7,
        "gyroscope_low_pass",
        "H",
        0.0,
        "Cut-off frequency of the sensor's own filter; 0 turns it off.",
        unit="Hz",
        scale=_DECIHERTZ,
        maximum=40_000 * _DECIHERTZ,
    ),
    _setting(
        8,
        "mode",
        "B",
        2,
        "What the module sends.",
        meanings={
            1: "orientation fused on the module",
            2: "raw samples on the module's own timer",
            3: "raw samples on the host's trigger",
        },
    ),
    _setting(
        9,
        "calibration",
        "f",
        _NO_CALIBRATION,
        "Accelerometer matrix (3×3, row after row) and bias (3, m/s²); gyroscope bias (3, rad/s); "
        "magnetometer soft iron (3×3) and hard iron (3, µT); temperature of calibration (°C); reserved (2).",
        count=30,
    ),
    _setting(10, "label", "s", "", "A name for people.", count=16, is_text=True),
)

SETTINGS: Mapping[int, Setting] = {declared.key: declared for declared in _DECLARED}
"""Key to declaration."""

_CODECS = {key: FieldsCodec((declared.value,)) for key, declared in SETTINGS.items()}


def factory_settings() -> dict[int, Any]:
    """Return the factory value of every setting, by key."""
    return {key: declared.factory for key, declared in SETTINGS.items()}


def encode_value(key: int, value: Any) -> bytes:
    """Return a setting's value on the wire and in flash.

    Raises ValueError, naming the setting, for an unknown key or a value outside its limits.
    """
    if key not in _CODECS:
        raise ValueError(f"setting {key}: there are {', '.join(f'{s.key} {s.name}' for s in _DECLARED)}")
    return _CODECS[key].encode(value)


def decode_value(key: int, data: bytes) -> Any:
    """Return the value; None for an unknown key or bytes that are no value of the setting. Never raises."""
    codec = _CODECS.get(key)
    values = None if codec is None else codec.decode(data)
    return None if values is None else values[0]
