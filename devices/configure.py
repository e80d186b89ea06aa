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

from devices.command_client import CommandClient
from devices.device_errors import (
    CommandRefusedError,
    NoAnswerError,
    UnfinishedError,
    UnverifiedError,
    WritesLockedError,
)
from devices.id_plan import plan_moves
from devices.link import LinkError
from devices.roster import Device, Roster, conflicts
from devices.setting_values import SETTING_KEYS, Value, decoded_setting, encoded_setting, setting_key
from devices.transactions import Answer
from firmware_protocol.commands import Result, Verb, decode_payload
from firmware_protocol.versions import SUPPORTED

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
        self._restart_patience_s = restart_patience_s

    async def discover(self) -> Roster:
        """Ask who is there. Takes a little more than a second. Raises ``LinkError`` when no link is up."""
        hellos, infos = await asyncio.gather(
            self.client.ask_all(Verb.HELLO, *SUPPORTED), self.client.ask_all(Verb.GET_INFO)
        )
        answers = {**infos, **hellos}
        await self._ask_again_for_infos(answers)
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
        """Make a device blink; 0 stops it. Raises as ``CommandClient.ask``."""
        await self.client.ask(unique_id, Verb.IDENTIFY, seconds)

    async def read(self, unique_id: bytes, names: Iterable[str]) -> dict[str, Value]:
        """Settings of a device by name. Raises as ``CommandClient.ask``, ``ValueError`` for no such name."""
        return {name: await self._read_one(unique_id, name) for name in names}

    async def read_all(self, unique_id: bytes) -> dict[str, Value]:
        """All settings that the device has; those that its firmware does not know are left out."""
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
        await self._discard(unique_id)
        before = await self.read(unique_id, wanted)
        missing = {name: raw for name, raw in encoded.items() if encoded_setting(name, before[name]) != raw}
        after = before
        failure: Exception | None = None
        for _ in range(_ATTEMPTS):
            if not missing:
                return Change(unique_id, before, after)
            self.roster = None
            failure = await self._stage_and_commit(unique_id, missing)
            after = await self._patiently(partial(self._read_committed, unique_id, wanted))
            missing = {
                name: raw for name, raw in encoded.items() if encoded_setting(name, after[name]) != raw
            }
        if missing:
            raise _unverified(unique_id, missing, after, failure)
        return Change(unique_id, before, after)

    async def assign_ids(self, wanted: Mapping[bytes, int], reserved: Collection[int] = ()) -> list[Change]:
        """Give devices their module ids, by unique id, in an order in which no two share one.

        reserved: ids of modules that may be switched off just now, not to be used in passing.
        Every round looks at what the devices really hold, so that one which restarted in the middle
        is taken up where it is. Afterwards the ids are right, or ``UnfinishedError`` says who has which.
        Raises ``ValueError`` for ids that cannot all be given.
        """
        before: dict[bytes, int] = {}
        failure: Exception | None = None
        for _ in range(_ATTEMPTS + 1):
            present = await self._present_ids(wanted)
            before = before or present
            moves = plan_moves(present, wanted, reserved)
            if not moves:
                return [
                    Change(unique_id, {"module_id": before[unique_id]}, {"module_id": after})
                    for unique_id, after in wanted.items()
                    if before[unique_id] != after
                ]
            try:
                for move in moves:
                    await self.write(move.unique_id, {"module_id": move.after})
            except (NoAnswerError, UnverifiedError, LinkError) as error:
                _log.info("ids are planned anew: %s", error)
                failure = error
        raise await self._unfinished(wanted, failure)

    async def _present_ids(self, wanted: Iterable[bytes]) -> dict[bytes, int]:
        present = (await self.discover()).ids
        for unique_id in wanted:
            if unique_id not in present:
                # Perhaps it is restarting just now.
                held = await self._patiently(partial(self.read, unique_id, ["module_id"]))
                present[unique_id] = int(held["module_id"])
        return present

    async def _unfinished(self, wanted: Mapping[bytes, int], failure: Exception | None) -> UnfinishedError:
        present: dict[bytes, int | None] = dict.fromkeys(wanted)
        present |= {uid: module for uid, module in (await self.discover()).ids.items() if uid in wanted}
        held = {uid: module for uid, module in present.items() if module is not None}
        said = [
            f"device {uid.hex()} {'does not answer' if module is None else f'has module id {module}'}"
            + (f", not {wanted[uid]}" if module != wanted[uid] else "")
            for uid, module in present.items()
        ]
        said += [str(conflict) for conflict in conflicts(held)]
        said += [str(failure)] if failure is not None else []
        return UnfinishedError("; ".join(said) + "; ask for the same again, or undo", present)

    async def _stage_and_commit(self, unique_id: bytes, encoded: Mapping[str, bytes]) -> Exception | None:
        """What went wrong in a way that reading back will settle, or None. Raises where it refuses."""
        ask = self.client.ask
        try:
            for name, raw in encoded.items():
                await ask(unique_id, Verb.WRITE_SETTING, SETTING_KEYS[name], raw)
            await ask(unique_id, Verb.COMMIT)
        except (NoAnswerError, LinkError) as error:
            return error
        except CommandRefusedError as error:
            if error.result not in _WORTH_RETRYING:
                await self._discard(unique_id)
                raise
            return error
        return None

    async def _read_committed(self, unique_id: bytes, names: Iterable[str]) -> dict[str, Value]:
        # A device reads back what is staged: only without that is it what a restart would leave.
        await self._discard(unique_id)
        return await self.read(unique_id, names)

    async def _discard(self, unique_id: bytes) -> None:
        try:
            await self.client.ask(unique_id, Verb.DISCARD)
        except CommandRefusedError as error:
            if error.result is not Result.NOTHING_STAGED:
                raise

    async def _read_one(self, unique_id: bytes, name: str) -> Value:
        key = setting_key(name)
        for _ in range(_ATTEMPTS):
            answered, raw = await self.client.ask(unique_id, Verb.READ_SETTING, key)
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
        """Read, and where nobody answers go on for as long as a restart may take."""
        loop = asyncio.get_running_loop()
        end = loop.time() + self._restart_patience_s
        while True:
            try:
                return await reading()
            except (NoAnswerError, LinkError):
                if loop.time() >= end:
                    raise

    async def _ask_again_for_infos(self, answers: Mapping[bytes, Answer]) -> None:
        """A description follows the answer in a packet of its own, and may have been lost."""
        for unique_id, _ in itertools.product(answers, range(_INFO_ATTEMPTS)):
            if unique_id not in self.client.infos:
                try:
                    await self.client.ask(unique_id, Verb.GET_INFO)
                except (NoAnswerError, CommandRefusedError) as error:
                    _log.debug("no description: %s", error)

    def _info(self, unique_id: bytes) -> Any:
        known = self.client.infos.get(unique_id)
        return None if known is None else known[1]


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
