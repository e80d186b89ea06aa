"""Which devices can be heard: by unique id, since two may have been given the same module id."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

from devices.device_errors import UnknownDeviceError
from firmware_protocol import RELAY, DeviceInfo, Health

_SHORTEST_PREFIX = 4
"""Hexadecimal digits; fewer are taken for a module id."""


@dataclass(frozen=True, slots=True)
class Device:
    """A module, local measuring device or relay that answered."""

    unique_id: bytes
    module: int
    link: str
    version: int | None
    """Version of the protocol that both sides speak; None: none in common."""
    info: DeviceInfo | None
    health: Health | None
    """None also where two devices share the module id: it may be either's."""

    @property
    def is_relay(self) -> bool:
        """Whether it is the relay of the suit."""
        return self.module == RELAY


@dataclass(frozen=True, slots=True)
class Conflict:
    """Devices that share one module id; their samples cannot be told apart."""

    module: int
    unique_ids: tuple[bytes, ...]

    def __str__(self) -> str:
        sharing = " and ".join(unique_id.hex() for unique_id in self.unique_ids)
        return f"module id {self.module} is shared by {sharing}"


@dataclass(frozen=True, slots=True)
class Roster:
    """All devices that answered, in order of module id."""

    devices: tuple[Device, ...]

    @property
    def ids(self) -> dict[bytes, int]:
        """Module id by unique id; relays, whose id is fixed, left out."""
        return {device.unique_id: device.module for device in self.devices if not device.is_relay}

    @property
    def conflicts(self) -> tuple[Conflict, ...]:
        """Module ids that several devices have."""
        return conflicts(self.ids)

    def find(self, text: str) -> Device:
        """Return the device meant by a module id (``3``, ``relay``) or by the beginning of a unique id.

        Raises ``UnknownDeviceError``, naming what there is.
        """
        wanted = text.strip().lower()
        number = RELAY if wanted == "relay" else _module_id(wanted)
        # A number is always a module id: a unique id that begins with it is longer.
        if number is not None:
            found = [device for device in self.devices if device.module == number]
        else:
            found = [device for device in self.devices if device.unique_id.hex().startswith(wanted)]
        if len(found) == 1:
            return found[0]
        if found:
            several = " and ".join(device.unique_id.hex() for device in found)
            raise UnknownDeviceError(f"'{text}' means {several}: name one by its unique id")
        there = ", ".join(f"{device.module} ({device.unique_id.hex()})" for device in self.devices)
        raise UnknownDeviceError(f"no device '{text}' answers; there are: {there or 'none'}")


def conflicts(ids: dict[bytes, int]) -> tuple[Conflict, ...]:
    """Return the module ids that several devices share."""
    sharing: dict[int, list[bytes]] = defaultdict(list)
    for unique_id, module in sorted(ids.items()):
        sharing[module].append(unique_id)
    return tuple(
        Conflict(module, tuple(unique_ids))
        for module, unique_ids in sorted(sharing.items())
        if unique_ids[1:]
    )


def _module_id(text: str) -> int | None:
    return int(text) if text.isdecimal() and len(text) < _SHORTEST_PREFIX else None
