"""The verbs carried out on a suit whose links this process reads."""

from __future__ import annotations

import asyncio
import base64
import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, TypeVar

from pydantic import ValidationError

from devices.card_download import Card
from devices.command_client import CommandClient
from devices.configure import Change, Configurator
from devices.device_backup import read_backup, restore_backup
from devices.device_errors import CommandRefusedError, DeviceError, WritesLockedError
from devices.id_plan import plan_moves, spare_id
from devices.link import gateway_time_ns
from devices.roster import Device, Roster
from devices.setting_values import encoded_setting
from firmware_protocol.commands import ALL_FILES, Verb
from gateway.body.skeleton import WornSuit
from gateway.errors import GatewayError, nearest
from gateway.modules import verbs
from gateway.modules.journal import Journal
from gateway.modules.motion_watch import MotionWatch
from gateway.modules.summary import count_samples, segments_of, summarise
from gateway.outputs.messages import plain_json
from gateway.stream import Stream

_log = logging.getLogger(__name__)

Plain = dict[str, Any]
"""JSON values."""

_Done = TypeVar("_Done")


class RequestError(GatewayError):
    """A request that cannot be meant, or cannot be done. ``str(error)`` says what would do."""


class ModuleOperations:
    """All verbs of ``verbs.REQUESTS``. One after another: whoever asks meanwhile waits."""

    def __init__(self, stream: Stream, client: CommandClient, suit: WornSuit, journal: Journal) -> None:
        self.configurator = Configurator(client)
        self._stream = stream
        self._client = client
        self._suit = suit
        self._journal = journal
        self._motion = MotionWatch(stream)
        self._turn = asyncio.Lock()
        self._verbs: dict[str, Callable[[Any], Awaitable[Plain]]] = {
            "list": self._list,
            "identify": self._identify,
            "read": self._read,
            "set": self._set,
            "assign": self._assign,
            "separate": self._separate,
            "undo": self._undo,
            "motion": self._await_motion,
            "backup": self._backup,
            "restore": self._restore,
            "card_list": self._card_list,
            "card_start": self._card_start,
            "card_stop": self._card_stop,
            "card_read": self._card_read,
            "card_erase": self._card_erase,
        }

    @property
    def stream(self) -> Stream:
        """What the suit's links say."""
        return self._stream

    async def perform(self, verb: str, data: Mapping[str, Any]) -> Plain:
        """Do what a verb asks. Raises ``RequestError``, ``DeviceError`` or ``LinkError``."""
        if verb not in self._verbs:
            raise RequestError(f"there is no request 'modules/{verb}'{nearest(verb, self._verbs)}")
        try:
            request = verbs.REQUESTS[verb].model_validate(data)
        except ValidationError as error:
            raise RequestError(f"modules/{verb}: {_first_problem(error)}") from error
        async with self._turn:
            try:
                answer = await self._verbs[verb](request)
            except ValueError as error:
                raise RequestError(str(error)) from error
        return plain_json(answer)

    async def _list(self, request: verbs.ListRequest) -> Plain:
        before = count_samples(self._stream, gateway_time_ns())
        roster, _ = await asyncio.gather(self._discover(), asyncio.sleep(request.listen_s))
        after = count_samples(self._stream, gateway_time_ns())
        listed = summarise(roster, self._stream, self._suit, before, after)
        return {**listed.model_dump(mode="json"), "allows_writes": self._client.allow_writes}

    async def _identify(self, request: verbs.IdentifyRequest) -> Plain:
        device = await self._find(request.device)
        await self.configurator.identify(device.unique_id, request.seconds)
        return _named(device)

    async def _read(self, request: verbs.ReadRequest) -> Plain:
        device = await self._find(request.device)
        return _named(device) | {"settings": await self.configurator.read_all(device.unique_id)}

    async def _set(self, request: verbs.SetRequest) -> Plain:
        device = await self._find(request.device)
        uid, settings = device.unique_id, request.settings
        for name, value in settings.items():
            encoded_setting(name, value)
        if "module_id" in settings:
            # Refuses, naming it, an id that another device has.
            plan_moves((await self._discover()).ids, {uid: settings["module_id"]})  # type: ignore[dict-item]
        before = await self.configurator.read(uid, settings)
        written = await self._recorded(
            [Change(uid, before, settings)], lambda: self.configurator.write(uid, settings)
        )
        return _named(device) | {"before": before, "after": dict(written.after)}

    async def _assign(self, request: verbs.AssignRequest) -> Plain:
        changes = await self._assign_ids({bytes.fromhex(uid): module for uid, module in request.ids.items()})
        return {"changes": list(map(_change, changes))}

    async def _separate(self, _request: verbs.SeparateRequest) -> Plain:
        roster = await self._discover()
        ids: dict[bytes, int] = {}
        for conflict in roster.conflicts:
            for uid in conflict.unique_ids[1:]:
                spare = spare_id({*self._rig_ids, *roster.ids.values(), *ids.values()})
                if spare is None:
                    raise RequestError("there is no module id left to give: switch off some modules")
                ids[uid] = spare
        return {"changes": list(map(_change, await self._assign_ids(ids) if ids else []))}

    async def _undo(self, _request: verbs.UndoRequest) -> Plain:
        changes = self._journal.last()
        if not changes:
            raise RequestError("there is no change to undo")
        ids = {each.unique_id: each.before["module_id"] for each in changes if "module_id" in each.before}
        done = await self.configurator.assign_ids(ids, self._rig_ids) if ids else []
        for change in changes:
            settings = {name: value for name, value in change.before.items() if name != "module_id"}
            if settings:
                done.append(await self.configurator.write(change.unique_id, settings))
        self._journal.drop_last()
        return {"changes": list(map(_change, done))}

    async def _await_motion(self, request: verbs.MotionRequest) -> Plain:
        motion = await self._motion.next(request.seconds, request.continues)
        if motion is None:
            return {"module": None}
        found = [device for device in (await self._roster()).devices if device.module == motion.module]
        if len(found) != 1:
            raise RequestError(
                f"module id {motion.module} moved, and {len(found) or 'no'} devices with that id answer: "
                "separate them first (mocap-gateway modules assign does)"
            )
        return _named(found[0]) | {"sign": motion.sign}

    async def _backup(self, _request: verbs.BackupRequest) -> Plain:
        return {"modules": await read_backup(self.configurator, await self._discover())}

    async def _restore(self, request: verbs.RestoreRequest) -> Plain:
        if not self._client.allow_writes:
            raise WritesLockedError("restoring settings")
        roster = await self._discover()
        before = [
            Change(
                bytes.fromhex(uid),
                await self.configurator.read(bytes.fromhex(uid), settings),
                settings,
            )
            for uid, settings in request.modules.items()
            if bytes.fromhex(uid) in roster.ids
        ]
        restored = await self._recorded(
            before, lambda: restore_backup(self.configurator, request.modules, self._rig_ids)
        )
        return {
            "changes": list(map(_change, restored.changes)),
            "unchanged": [uid.hex() for uid in restored.unchanged],
            "absent": [uid.hex() for uid in restored.absent],
            "failures": {uid.hex(): reason for uid, reason in restored.failures.items()},
        }

    async def _card_list(self, request: verbs.CardListRequest) -> Plain:
        device = await self._find(request.device)
        files = await Card(self._client, device.unique_id).files()
        return _named(device) | {"files": [file._asdict() for file in files]}

    async def _card_start(self, request: verbs.CardStartRequest) -> Plain:
        device = await self._find(request.device)
        await self._client.ask(device.unique_id, Verb.START)
        return _named(device)

    async def _card_stop(self, request: verbs.CardStopRequest) -> Plain:
        device = await self._find(request.device)
        await self._client.ask(device.unique_id, Verb.STOP)
        return _named(device)

    async def _card_read(self, request: verbs.CardReadRequest) -> Plain:
        device = await self._find(request.device)
        data = await Card(self._client, device.unique_id).read(request.file, request.offset, request.length)
        return {"data": base64.b64encode(data).decode()}

    async def _card_erase(self, request: verbs.CardEraseRequest) -> Plain:
        device = await self._find(request.device)
        await Card(self._client, device.unique_id).erase(ALL_FILES if request.file is None else request.file)
        return _named(device)

    @property
    def _rig_ids(self) -> set[int]:
        """Ids that the rig gives, also to what is switched off."""
        local = {each.device for each in self._suit.local_devices if each.device is not None}
        return {*segments_of(self._suit).values(), *local}

    async def _assign_ids(self, ids: dict[bytes, int]) -> list[Change]:
        present = (await self._roster()).ids
        about = [
            Change(uid, {"module_id": present[uid]}, {"module_id": module})
            for uid, module in ids.items()
            if uid in present
        ]
        return await self._recorded(about, lambda: self.configurator.assign_ids(ids, self._rig_ids))

    async def _recorded(self, about: list[Change], change: Callable[[], Awaitable[_Done]]) -> _Done:
        """Change something, with what stood there before in the journal first."""
        if not self._client.allow_writes:
            raise WritesLockedError("changing settings")
        self._journal.record(about)
        try:
            return await change()
        except (CommandRefusedError, ValueError):
            self._journal.drop_last()  # nothing was changed
            raise

    async def _discover(self) -> Roster:
        return await self.configurator.discover()

    async def _roster(self) -> Roster:
        return self.configurator.roster or await self._discover()

    async def _find(self, name: str) -> Device:
        """From what is known, and where that does not tell, from a new discovery. Raises ``DeviceError``."""
        if self.configurator.roster is not None:
            try:
                return self.configurator.roster.find(name)
            except DeviceError:
                _log.debug("%s is not known yet", name)
        return (await self._discover()).find(name)


def _named(device: Device) -> Plain:
    return {"module": device.module, "unique_id": device.unique_id.hex()}


def _change(change: Change) -> Plain:
    return {
        "unique_id": change.unique_id.hex(),
        "before": dict(change.before),
        "after": dict(change.after),
    }


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    where = ".".join(map(str, problem["loc"]))
    return f"'{where}' {problem['msg'].lower()}" if where else problem["msg"].lower()
