"""Which devices can be heard, and in which order their module ids are changed.

Devices go by unique id, since two may have been given the same module id; ``plan_moves`` gives them others
so that no two share one on the way. Pure.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from devices.commands.device_errors import UnknownDeviceError
from firmware_protocol import MAX_MODULE, RELAY, DeviceInfo, Health

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


class Move(NamedTuple):
    """One device takes another id."""

    unique_id: bytes
    before: int
    after: int


def plan_moves(
    present: Mapping[bytes, int],
    wanted: Mapping[bytes, int],
    reserved: Collection[int] = (),
    *,
    may_share: bool = False,
) -> list[Move]:
    """Return the changes that lead from the present ids to the wanted ones, in a safe order.

    present: id of every device that can be heard; wanted: id of those that are to have a certain one.
    A device takes an id only when nobody has it. Where ids go round in a circle one device waits on a
    spare id, if there is one that is neither present, wanted nor reserved. Without a spare, and only
    then, two devices share an id for the time of one change.

    may_share: ids that several devices have at the end are wanted, to take a separation of them back.
    Raises ``ValueError`` otherwise for an id that is wanted twice, or held by a device that is to keep it.
    """
    if not may_share:
        _refuse_impossible(present, wanted)
    held = dict(present)
    pending = {uid: wanted[uid] for uid in sorted(wanted) if held.get(uid, wanted[uid]) != wanted[uid]}
    moves: list[Move] = []
    while pending:
        # Where ids may be shared at the end, those of devices that have theirs block nobody.
        settled = {held[each] for each in held if each not in pending} if may_share else set()
        uid, after = _next_change(pending, held, {*wanted.values(), *reserved}, settled)
        moves.append(Move(uid, held[uid], after))
        held[uid] = after
        if pending[uid] == after:
            del pending[uid]
    return moves


def spare_id(taken: Collection[int]) -> int | None:
    """Return the highest id that is not taken: the rigs people write count from below."""
    return next((spare for spare in range(MAX_MODULE, -1, -1) if spare not in taken), None)


def _next_change(
    pending: Mapping[bytes, int],
    held: Mapping[bytes, int],
    reserved: set[int],
    shared: Collection[int],
) -> tuple[bytes, int]:
    """Return who takes which id next. shared: ids that are taken although somebody has and keeps them."""
    taken = set(held.values())
    for uid, after in pending.items():
        if after not in taken or after in shared:
            return uid, after
    # Ids go round in a circle. Who waits on a spare one already stands in nobody's way: moved from spare to
    # spare, it would be for ever.
    awaited = set(pending.values())
    uid = next(each for each in pending if held[each] in awaited)
    spare = spare_id(reserved | taken)
    return uid, pending[uid] if spare is None else spare


def _refuse_impossible(present: Mapping[bytes, int], wanted: Mapping[bytes, int]) -> None:
    twice = [each for each, n in Counter(wanted.values()).items() if n > 1]
    if twice:
        raise ValueError(f"module id {twice[0]} is wanted for more than one device")
    for uid, held in present.items():
        if uid not in wanted and held in wanted.values():
            raise ValueError(f"module id {held} is held by device {uid.hex()}: give that one another id too")
