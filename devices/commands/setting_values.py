"""Settings of devices by name: values to what is sent, and back."""

from __future__ import annotations

from typing import Any

from devices.known_names import nearest
from firmware_protocol.device_settings import SETTINGS, decode_value, encode_value
from firmware_protocol.fields import INTEGER_RANGE, WireField

Value = Any
"""A setting's value: int, float, str, or a tuple of floats, as it is declared."""

SETTING_KEYS: dict[str, int] = {setting.name: key for key, setting in SETTINGS.items()}
"""Number of each setting."""


def setting_key(name: str) -> int:
    """Return the number of a setting. Raises ``ValueError`` naming those there are."""
    if name not in SETTING_KEYS:
        raise ValueError(f"there is no setting '{name}'{nearest(name, SETTING_KEYS)}")
    return SETTING_KEYS[name]


def encoded_setting(name: str, value: Value) -> bytes:
    """Return a value as it goes to the device. Raises ``ValueError`` naming the setting and its limits."""
    key = setting_key(name)
    try:
        return encode_value(key, tuple(value) if isinstance(value, list) else value)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{name}={value!r} cannot be: {_limits(SETTINGS[key].value)}") from error


def decoded_setting(name: str, raw: bytes) -> Value | None:
    """Return the value in what a device gave; None when it holds none."""
    return decode_value(setting_key(name), raw)


def _limits(declared: WireField) -> str:
    """Return in words what a setting takes."""
    if declared.meanings:
        allowed = ", ".join(f"{number} ({meaning})" for number, meaning in declared.meanings.items())
    elif declared.is_text:
        allowed = f"text of up to {declared.count} bytes"
    elif declared.count > 1:
        allowed = f"{declared.count} numbers"
    else:
        low, high = INTEGER_RANGE.get(declared.code, (None, None))
        step = declared.scale or 1
        # What is not declared is limited by the number on the wire.
        least = declared.minimum if declared.minimum is not None else (low or 0) * step
        most = declared.maximum if declared.maximum is not None else (high or 0) * step
        allowed = f"a number from {least:g} to {most:g}"
    return f"{allowed}{declared.unit and ' '}{declared.unit}; {declared.sentence}"
