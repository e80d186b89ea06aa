"""Finds devices, identifies them, and changes their settings and ids so that nothing is lost.

What counts is what reads back. A write is done when the device has committed it and reads it back; a
device that restarts in the middle is waited for and asked what it holds. Devices are addressed by
unique id throughout, so that two with the same module id are never mixed up.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from devices.commands.command_client import CommandClient
from devices.commands.device_errors import (
    CommandRefusedError,
    DeviceError,
    NoAnswerError,
    UnfinishedError,
    UnverifiedError,
    WritesLockedError,
)
from devices.commands.roster import Device, Roster, conflicts, plan_moves
from devices.commands.setting_values import SETTING_KEYS, Value, decoded_setting, encoded_setting, setting_key
from devices.commands.transactions import Answer
from devices.link import LinkError
from firmware_protocol.commands import Result, Verb, decode_payload
from firmware_protocol.framing import SUPPORTED

_log = logging.getLogger(__name__)

RESTART_PATIENCE_S = 6.0
"""How long a device that fell silent in the middle of a change is waited for."""

_ATTEMPTS = 3
_INFO_ATTEMPTS = 2
_WORTH_RETRYING = (Result.NOTHING_STAGED, Result.FLASH_FAILED)


@dataclass(frozen=True, slots=True)
class Change:
    """What was written to one device, and what stood there before: enough to take it back."""

    unique_id: bytes
    before: Mapping[str, Value]
    after: Mapping[str, Value]


class Configurator:
    """Discovery and settings of the devices behind one client."""

    def __init__(self, client: CommandClient, restart_patience_s: float = RESTART_PATIENCE_S) -> None:
        self.client = client
        self.roster: Roster | None = None
        """Newest list of devices; None when a change has made it doubtful."""
        self._present: frozenset[bytes] = frozenset()  # at the last look, by unique id
        self._restart_patience_s = restart_patience_s

    async def discover(self) -> Roster:
        """Ask who is there. Raises ``LinkError`` when no link is up.

        Takes a little more than a second, and a quarter of one when all that were there the last time answer.
        """
        # Both at once: each broadcast waits for the slowest device.
        hellos, infos = await asyncio.gather(
            self.client.request_all(Verb.HELLO, *SUPPORTED, known=self._present),
            self.client.request_all(Verb.GET_INFO, known=self._present),
        )
        answers = {**infos, **hellos}
        self._present = frozenset(answers)
        await self._ask_again_for_infos(answers)
        # Health carries the module id alone: of two devices with one id it could be either's.
        sharing = {
            conflict.module
            for conflict in conflicts({unique_id: answer.module for unique_id, answer in answers.items()})
        }
        devices = [
            Device(
                unique_id=unique_id,
                module=answer.module,
                link=answer.link,
                version=_chosen_version(hellos.get(unique_id)),
                info=self._info(unique_id),
                health=None if answer.module in sharing else self.client.healths.get(answer.module),
            )
            for unique_id, answer in answers.items()
        ]
        self.roster = Roster(tuple(sorted(devices, key=lambda device: (device.module, device.unique_id))))
        return self.roster

    async def identify(self, unique_id: bytes, seconds: int) -> None:
        """Make a device blink; 0 stops it. Raises as ``CommandClient.request``."""
        await self.client.request(unique_id, Verb.IDENTIFY, seconds)

    async def read(self, unique_id: bytes, names: Iterable[str]) -> dict[str, Value]:
        """Return settings of a device by name.

        Raises as ``CommandClient.request``, ``ValueError`` for no such name.
        """
        return {name: await self._read_one(unique_id, name) for name in names}

    async def read_committed(self, unique_id: bytes, names: Iterable[str]) -> dict[str, Value]:
        """Return what a restart would leave. A device reads back what is staged: that is discarded first."""
        await self._discard(unique_id)
        return await self.read(unique_id, names)

    async def read_all(self, unique_id: bytes) -> dict[str, Value]:
        """Return all settings that the device has; those that its firmware does not know are left out."""
        values = {}
        for name in SETTING_KEYS:
            try:
                values[name] = await self._read_one(unique_id, name)
            except CommandRefusedError as error:
                if error.result is not Result.NO_SUCH_SETTING:
                    raise
        return values

    async def write(self, unique_id: bytes, wanted: Mapping[str, Value]) -> Change:
        """Stage, commit and read back. What is as wanted already is not written again.

        Raises ``WritesLockedError``, ``CommandRefusedError`` when the device will not, ``UnverifiedError``
        when it does not hold what was written, ``NoAnswerError`` when it does not come back, and
        ``ValueError``, before anything is sent, for values outside of their limits.
        """
        if not self.client.allow_writes:
            raise WritesLockedError("writing settings")
        encoded = {name: encoded_setting(name, value) for name, value in wanted.items()}
        # What somebody else staged and never committed would be committed along.
        await self._discard(unique_id)
        before = await self.read(unique_id, wanted)
        missing = {name: raw for name, raw in encoded.items() if encoded_setting(name, before[name]) != raw}
        after = before
        failure: Exception | None = None
        for _ in range(_ATTEMPTS):
            if not missing:
                return Change(unique_id, before, after)
            # The device will answer under another id: what the roster says of it is void.
            if "module_id" in missing:
                self.roster = None
            failure = await self._stage_and_commit(unique_id, missing)
            # Read back what is committed, in any case: only that shows whether the write took.
            after = await self._patiently(partial(self.read_committed, unique_id, wanted))
            missing = {
                name: raw for name, raw in encoded.items() if encoded_setting(name, after[name]) != raw
            }
        if missing:
            raise _unverified(unique_id, missing, after, failure)
        return Change(unique_id, before, after)

    async def assign_ids(
        self, wanted: Mapping[bytes, int], reserved: Collection[int] = (), *, may_share: bool = False
    ) -> list[Change]:
        """Give devices their module ids, by unique id, in an order in which no two share one.

        reserved: ids of modules that may be switched off just now, not to be used in passing.
        may_share: as in ``plan_moves``.
        Every round looks at what the devices really hold, so that one which restarted in the middle
        is taken up where it is; one that refuses ends it. Afterwards the ids are right, or
        ``UnfinishedError`` says who has which. Raises ``ValueError`` for ids that cannot all be given,
        and as ``write`` does; only after ``UnfinishedError`` has anything changed.
        """
        if not self.client.allow_writes:
            raise WritesLockedError("changing module ids")
        before: dict[bytes, int] = {}
        failure: Exception | None = None
        # One attempt more than a write has: the last round only looks whether all is right.
        for _ in range(_ATTEMPTS + 1):
            try:
                present = await self._present_ids(wanted)
                moves = plan_moves(present, wanted, reserved, may_share=may_share)
            except (DeviceError, LinkError, ValueError) as error:
                # Nothing has been changed yet, so the error itself says it all.
                if not before:
                    raise
                failure = error
                break
            before = before or present
            if not moves:
                return _moved(before, wanted)
            try:
                for move in moves:
                    await self.write(move.unique_id, {"module_id": move.after})
            except (NoAnswerError, UnverifiedError, LinkError) as error:
                _log.info("ids are planned anew: %s", error)
                failure = error
            except DeviceError as error:
                failure = error
                break
        raise await self._unfinished(wanted, before, failure)

    async def present_ids(self, unique_ids: Iterable[bytes]) -> dict[bytes, int]:
        """Return the ids of all that can be heard; those named that did not answer are asked by themselves.

        Raises ``LinkError`` when no link is up.
        """
        present = (await self.discover()).ids
        missing = [unique_id for unique_id in unique_ids if unique_id not in present]
        asked = [self.read_committed(unique_id, ["module_id"]) for unique_id in missing]
        for unique_id, held in zip(
            missing, await asyncio.gather(*asked, return_exceptions=True), strict=True
        ):
            if isinstance(held, dict):
                present[unique_id] = int(held["module_id"])
            elif not isinstance(held, DeviceError | LinkError):
                raise held
        return present

    async def plan(self, wanted: Mapping[bytes, Mapping[str, Value]]) -> list[Change]:
        """Return what writing settings (by name, by unique id) would change. Raises as ``write`` does."""
        changes = []
        for unique_id, settings in wanted.items():
            before = await self._patiently(partial(self.read_committed, unique_id, settings))
            changes.append(differing(Change(unique_id, before, settings)))
        return [change for change in changes if change.before]

    async def committed(self, changes: Iterable[Change]) -> list[Change]:
        """Return what of some changes the devices hold now. One that does not answer may hold all of it."""
        held = await asyncio.gather(*map(self._committed_of, changes))
        return [change for change in held if change.before]

    async def _committed_of(self, change: Change) -> Change:
        try:
            held = await self.read_committed(change.unique_id, change.before)
        except (DeviceError, LinkError) as error:
            _log.debug("%s: whether it was changed is not known: %s", change.unique_id.hex(), error)
            return change
        return differing(Change(change.unique_id, change.before, held))

    async def _present_ids(self, wanted: Iterable[bytes]) -> dict[bytes, int]:
        present = (await self.discover()).ids
        for unique_id in wanted:
            if unique_id not in present:
                # Perhaps it is restarting just now.
                held = await self._patiently(partial(self.read, unique_id, ["module_id"]))
                present[unique_id] = int(held["module_id"])
        return present

    async def _unfinished(
        self, wanted: Mapping[bytes, int], before: Mapping[bytes, int], failure: Exception | None
    ) -> Exception:
        """Return what to raise: the failure itself where nothing was changed."""
        present: dict[bytes, int | None] = dict.fromkeys(wanted)
        try:
            found = (await self.discover()).ids
        except LinkError as error:
            _log.debug("ids are not known: %s", error)
            found = {}
        present |= {uid: module for uid, module in found.items() if uid in wanted}
        if failure is not None and all(present[uid] == before[uid] for uid in wanted):
            return failure
        held = {uid: module for uid, module in present.items() if module is not None}
        parts = [_place_of_id(uid, module, wanted[uid]) for uid, module in present.items()]
        parts += [str(conflict) for conflict in conflicts(held)]
        reason = "" if failure is None else str(failure)
        parts += [reason] if reason else []
        return UnfinishedError("; ".join(parts) + "; ask for the same again, or undo", present, reason)

    async def _stage_and_commit(self, unique_id: bytes, encoded: Mapping[str, bytes]) -> Exception | None:
        """Write and commit; return an error that reading back will settle, or None.

        Raises if the device refuses.
        """
        request = self.client.request
        try:
            for name, raw in encoded.items():
                await request(unique_id, Verb.WRITE_SETTING, SETTING_KEYS[name], raw)
            # Until here nothing has changed: the device replaces all settings at once, or none.
            await request(unique_id, Verb.COMMIT)
        except (NoAnswerError, LinkError) as error:
            return error
        except CommandRefusedError as error:
            if error.result not in _WORTH_RETRYING:
                await self._discard(unique_id)
                raise
            return error
        return None

    async def _discard(self, unique_id: bytes) -> None:
        try:
            await self.client.request(unique_id, Verb.DISCARD)
        except CommandRefusedError as error:
            if error.result is not Result.NOTHING_STAGED:
                raise

    async def _read_one(self, unique_id: bytes, name: str) -> Value:
        key = setting_key(name)
        for _ in range(_ATTEMPTS):
            # An answer to an earlier question has another key.
            answered, raw = await self.client.request(unique_id, Verb.READ_SETTING, key)
            if answered == key:
                break
        value = decoded_setting(name, raw) if answered == key else None
        if value is None:
            raise UnverifiedError(
                f"device {unique_id.hex()} gives {raw!r} for {name}: "
                "its firmware may be newer than the gateway"
            )
        return value

    async def _patiently(self, reading: Callable[[], Awaitable[dict[str, Value]]]) -> dict[str, Value]:
        """Read, and without an answer go on for as long as a restart may take."""
        loop = asyncio.get_running_loop()
        end = loop.time() + self._restart_patience_s
        while True:
            try:
                return await reading()
            except (NoAnswerError, LinkError):
                if loop.time() >= end:
                    raise

    async def _ask_again_for_infos(self, answers: Mapping[bytes, Answer]) -> None:
        """Ask for descriptions that are missing: each follows the answer in a packet of its own, and may be
        lost.
        """
        for unique_id, _ in itertools.product(answers, range(_INFO_ATTEMPTS)):
            if unique_id not in self.client.infos:
                try:
                    await self.client.request(unique_id, Verb.GET_INFO)
                except (NoAnswerError, CommandRefusedError) as error:
                    _log.debug("no description: %s", error)

    def _info(self, unique_id: bytes) -> Any:
        known = self.client.infos.get(unique_id)
        return None if known is None else known[1]


def differing(change: Change) -> Change:
    """Return the settings of a change that are not afterwards as before."""
    names = [
        name
        for name, after in change.after.items()
        if encoded_setting(name, change.before[name]) != encoded_setting(name, after)
    ]
    return Change(
        change.unique_id,
        {name: change.before[name] for name in names},
        {name: change.after[name] for name in names},
    )


def _moved(before: Mapping[bytes, int], wanted: Mapping[bytes, int]) -> list[Change]:
    return [
        Change(unique_id, {"module_id": before[unique_id]}, {"module_id": after})
        for unique_id, after in wanted.items()
        if before[unique_id] != after
    ]


def _place_of_id(unique_id: bytes, module: int | None, wanted: int) -> str:
    """Return what a device has for an id, and what not."""
    if module is None:
        return f"device {unique_id.hex()} does not answer, and may have module id {wanted} or not"
    other = "" if module == wanted else f", not {wanted}"
    return f"device {unique_id.hex()} has module id {module}{other}"


def _chosen_version(hello: Answer | None) -> int | None:
    payload = decode_payload(Verb.HELLO, hello.payload) if hello is not None else None
    return int(payload[0]) or None if payload else None


def _unverified(
    unique_id: bytes, missing: Iterable[str], after: Mapping[str, Value], failure: Exception | None
) -> UnverifiedError:
    holds = ", ".join(f"{name}={after[name]}" for name in missing)
    reason = f" ({failure})" if failure is not None else ""
    return UnverifiedError(
        f"device {unique_id.hex()} still holds {holds} after {_ATTEMPTS} attempts{reason}: try again; "
        "if it stays so its flash is worn out"
    )
