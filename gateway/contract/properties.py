"""What MQTT 5 lets a message say of itself."""

from __future__ import annotations

from typing import Literal

from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

JSON = "application/json"
MSGPACK = "application/msgpack"


def properties_of(
    protocol: Literal["3.1.1", "5"], content_type: str, expiry_s: int | None = None
) -> Properties | None:
    """Return content type, and how long a broker may keep a message that it cannot deliver; None before MQTT
    5."""
    if protocol != "5":
        return None
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    properties.ContentType = content_type
    if expiry_s is not None:
        properties.MessageExpiryInterval = expiry_s
    return properties
