"""All settings of all devices as plain data, and back again."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from devices.commands.configure import Change, Configurator
from devices.commands.device_errors import DeviceError, UnfinishedError, WritesLockedError
from devices.commands.roster import Roster, plan_moves
from devices.commands.setting_values import Value, encoded_setting
from devices.link import LinkError


@dataclass
class Restored:
    """What writing a backup back came to, by unique id."""

    changes: list[Change] = field(default_factory=list)
    unchanged: list[bytes] = field(default_factory=list)
    absent: list[bytes] = field(default_factory=list)
    """In the backup, but not on the air."""
    failures: dict[bytes, str] = field(default_factory=dict)


async def read_backup(configurator: Configurator, roster: Roster) -> dict[str, dict[str, Value]]:
    """Return settings by name, by unique id (hexadecimal), of all modules heard. Raises as reading does."""
    return {
        unique_id.hex(): await configurator.read_all(unique_id)
        for unique_id in sorted(roster.ids, key=lambda uid: (roster.ids[uid], uid))
    }


async def restore_backup(
    configurator: Configurator,
    backup: Mapping[str, Mapping[str, Any]],
    reserved: Collection[int] = (),
    *,
    may_share: bool = False,
) -> Restored:
    """Write back what differs; ids last and in a safe order. One device that fails does not stop the others.

    may_share: as in ``plan_moves``.
    Raises ``ValueError``, before anything is sent, for a unique id, a value or ids that cannot be,
    ``WritesLockedError`` where writing is not allowed, and ``LinkError`` when no link is up at the start.
    """
    if not configurator.client.allow_writes:
        raise WritesLockedError("restoring settings")
    wanted = {parse_unique_id(text): dict(settings) for text, settings in backup.items()}
    for settings in wanted.values():
        for name, value in settings.items():
            encoded_setting(name, value)
    present = await configurator.present_ids(wanted)
    restored = Restored(absent=[uid for uid in wanted if uid not in present])
    ids = {
        uid: settings.pop("module_id")
        for uid, settings in wanted.items()
        if uid in present and "module_id" in settings
    }
    plan_moves(present, ids, reserved, may_share=may_share)  # refuses ids that cannot all be given
    for uid, settings in wanted.items():
        if uid in present and settings:
            try:
                change = await configurator.write(uid, settings)
            except (DeviceError, LinkError) as error:
                restored.failures[uid] = str(error)
            else:
                _note(restored, change)
    before = {uid: present[uid] for uid in ids}
    await _restore_ids(
        restored, ids, before, partial(configurator.assign_ids, ids, reserved, may_share=may_share)
    )
    touched = {change.unique_id for change in restored.changes}
    restored.unchanged = [
        uid for uid in wanted if uid in present and uid not in {*touched, *restored.failures}
    ]
    return restored


async def _restore_ids(
    restored: Restored,
    ids: Mapping[bytes, int],
    before: Mapping[bytes, int],
    assign: Callable[[], Awaitable[list[Change]]],
) -> None:
    """Give the ids, and note what came of it."""
    held: dict[bytes, int | None] = dict(before)
    try:
        restored.changes += await assign()
        return
    except UnfinishedError as error:
        reason, held = error.reason, error.present
    except (DeviceError, LinkError, ValueError) as error:
        reason = str(error)
    # Each device by itself: some may have got their ids before others failed.
    for uid, wanted in ids.items():
        now = held[uid]
        if now != wanted:
            has = "does not answer" if now is None else f"has module id {now}, not {wanted}"
            restored.failures[uid] = "; ".join(filter(None, [restored.failures.get(uid), has, reason]))
        elif now != before[uid]:
            restored.changes.append(Change(uid, {"module_id": before[uid]}, {"module_id": now}))


def _note(restored: Restored, change: Change) -> None:
    if dict(change.before) != dict(change.after):
        restored.changes.append(change)


def parse_unique_id(text: str) -> bytes:
    """Return 12 bytes from hexadecimal. Raises ``ValueError``."""
    try:
        unique_id = bytes.fromhex(text)
    except ValueError:
        unique_id = b""
    if len(unique_id) != 12:
        raise ValueError(f"'{text}' is no unique id: 24 hexadecimal digits are wanted")
    return unique_id
