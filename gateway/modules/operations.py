"""The verbs carried out on a suit whose links this process reads."""

from __future__ import annotations

import asyncio
import base64
import logging
from collections.abc import Awaitable, Callable, Collection, Mapping
from typing import Any, TypeVar

from devices.commands.card import Card
from devices.commands.command_client import CommandClient
from devices.commands.configure import Change, Configurator
from devices.commands.device_backup import Restored, read_backup, restore_backup
from devices.commands.device_errors import DeviceError, UnfinishedError, UnknownDeviceError, WritesLockedError
from devices.commands.roster import Device, Roster, plan_moves, spare_id
from devices.commands.setting_values import encoded_setting
from devices.link import Link, LinkError, gateway_time_ns
from devices.links.reconnect import LinkState, ReconnectingLink
from firmware_protocol import Defect
from firmware_protocol.commands import ALL_FILES, Verb
from firmware_protocol.messages import DEVICE_INFO_INTERVAL_S
from gateway.body.skeleton import WornSuit
from gateway.contract import requests
from gateway.contract.messages import plain_json
from gateway.errors import GatewayError
from gateway.modules.journal import Entry, Journal, JournalError
from gateway.modules.makers import MakersModule, MakersModules, changed
from gateway.modules.motion import MotionWatch
from gateway.modules.summary import SampleCounts, count_samples, segments_of, summarise
from gateway.sources.suit import SuitSource

_log = logging.getLogger(__name__)

Plain = dict[str, Any]
"""JSON values."""

_Done = TypeVar("_Done")

_DESCRIBED_NS = round((DEVICE_INFO_INTERVAL_S + 1.0) * 1e9)
"""By then every device has said who it is."""

_LOOK_S = 0.05

_WAITING = frozenset({"list", "motion"})
"""Verbs that wait for what modules send on their own; they take their turn where they ask modules."""


class RequestError(GatewayError):
    """A request that cannot be meant, or cannot be done. ``str(error)`` says what would do."""


class ModuleOperations:
    """All verbs of ``requests.MODULE_REQUESTS``, asked for at any time.

    What speaks with modules is done one after another, in order. Waiting for samples or for a motion is not:
    that goes on beside it.
    """

    def __init__(
        self,
        stream: SuitSource,
        client: CommandClient,
        suit: WornSuit,
        journal: Journal,
        makers: MakersModules | None = None,
    ) -> None:
        """Offer the verbs; modules of ``makers`` can be listed, identified, read and set, and no more."""
        self.makers = makers or MakersModules()
        self.configurator = Configurator(client)
        self._stream = stream
        self._client = client
        self._suit = suit
        self._journal = journal
        self._motion = MotionWatch(stream)
        self._turn = asyncio.Lock()
        self._began_ns = gateway_time_ns()
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
    def stream(self) -> SuitSource:
        """What the suit's links say."""
        return self._stream

    def unverified(self, link: str) -> Mapping[Defect, int]:
        """Return what a signed link dropped for its signatures, by reason."""
        found = self._client.links[link]
        return found.counts.unverified if isinstance(found, ReconnectingLink) else {}

    async def perform(self, verb: str, data: Mapping[str, Any]) -> Plain:
        """Do what a verb asks. Raises ``GatewayError``, ``DeviceError`` or ``LinkError``."""
        request = requests.asked("modules", verb, data)
        try:
            # These wait for what modules send: in turn, all others would wait with them.
            if verb in _WAITING:
                answer = await self._verbs[verb](request)
            else:
                async with self._turn:
                    answer = await self._verbs[verb](request)
        except ValueError as error:
            raise RequestError(str(error)) from error
        return plain_json(answer)

    async def _list(self, request: requests.ListRequest) -> Plain:
        before = count_samples(self._stream, gateway_time_ns())
        (roster, makers), before = await asyncio.gather(
            self._in_turn(self._discover_all), self._counted_from(before, request.listen_s)
        )
        await self._await_descriptions({device.module for device in roster.devices} | makers.keys())
        after = count_samples(self._stream, gateway_time_ns())
        listed = summarise(roster, self._stream, self._suit, before, after, makers)
        return {
            **listed.model_dump(mode="json"),
            "allows_writes": self._client.allow_writes,
            "assigns": self._has_own,
            "without_commands": sorted(self.makers.without_commands),
            "absent": _absent(self._client.links) | _absent(self.makers.links),
        }

    async def _counted_from(self, before: SampleCounts, listen_s: float) -> SampleCounts:
        """Wait; return the counts at the begin, or half-way where modules were heard only since.

        Some give no samples until their interval is known.
        """
        await asyncio.sleep(0.5 * listen_s)
        half_way = count_samples(self._stream, gateway_time_ns())
        await asyncio.sleep(0.5 * listen_s)
        return before if before.samples.keys() >= half_way.samples.keys() else half_way

    async def _await_descriptions(self, known: Collection[int]) -> None:
        """Wait, as long as one may take, for what those that answer no commands say of themselves."""
        modules = self._stream.modules
        while gateway_time_ns() < self._began_ns + _DESCRIBED_NS:
            if all(record.info for module, record in modules.items() if module not in known):
                return
            await asyncio.sleep(_LOOK_S)

    async def _identify(self, request: requests.IdentifyRequest) -> Plain:
        if (other := await self.makers.find(request.device)) is not None:
            await other.commands.identify(other.line, request.seconds)
            return _named(other)
        device = await self._find(request.device)
        await self.configurator.identify(device.unique_id, request.seconds)
        return _named(device)

    async def _read(self, request: requests.ReadRequest) -> Plain:
        if (other := await self.makers.find(request.device)) is not None:
            return _named(other) | {"settings": await other.commands.read(other.line)}
        device = await self._find(request.device)
        return _named(device) | {"settings": await self.configurator.read_all(device.unique_id)}

    async def _set(self, request: requests.SetRequest) -> Plain:
        self._refuse_unless_allowed("changing settings")
        if (other := await self.makers.find(request.device)) is not None:
            before, after = await changed(other, request.settings)
            return _named(other) | {"before": before, "after": after}
        device = await self._find(request.device)
        uid, settings = device.unique_id, request.settings
        for name, value in settings.items():
            encoded_setting(name, value)
        if "module_id" in settings:
            # Refuses, naming it, an id that another device has.
            plan_moves((await self._discover()).ids, {uid: settings["module_id"]})  # type: ignore[dict-item]
        written = await self._recorded({uid: settings}, lambda: self.configurator.write(uid, settings))
        return _named(device) | {"before": dict(written.before), "after": dict(written.after)}

    async def _assign(self, request: requests.AssignRequest) -> Plain:
        self._refuse_others("giving numbers")
        changes = await self._assign_ids({bytes.fromhex(uid): module for uid, module in request.ids.items()})
        return {"changes": list(map(_change, changes))}

    async def _separate(self, _request: requests.SeparateRequest) -> Plain:
        self._refuse_others("giving numbers")
        roster = await self._discover()
        ids: dict[bytes, int] = {}
        for conflict in roster.conflicts:
            # The first of those that share an id keeps it.
            for uid in conflict.unique_ids[1:]:
                spare = spare_id({*self._rig_ids, *roster.ids.values(), *ids.values()})
                if spare is None:
                    raise RequestError("there is no module id left to give: switch off some modules")
                ids[uid] = spare
        return {"changes": list(map(_change, await self._assign_ids(ids) if ids else []))}

    async def _undo(self, _request: requests.UndoRequest) -> Plain:
        self._refuse_others("taking changes back")
        entry = await asyncio.to_thread(self._journal.last)
        if entry is None:
            raise RequestError("there is no change to undo")
        self._refuse_unless_allowed("taking changes back")
        earlier = {change.unique_id.hex(): change.before for change in entry.changes}
        restored = await restore_backup(self.configurator, earlier, self._rig_ids, may_share=True)
        await self._settle(entry, await self._left_over(entry.changes, restored))
        return _restored(restored)

    async def _await_motion(self, request: requests.MotionRequest) -> Plain:
        self._refuse_others("waiting to see which one moves")
        motion = await self._motion.next(request.seconds, request.continues)
        if motion is None:
            return {"module": None}
        roster = await self._in_turn(self._roster)
        found = [device for device in roster.devices if device.module == motion.module]
        if len(found) != 1:
            raise RequestError(
                f"module id {motion.module} moved, and {len(found) or 'no'} devices with that id answer: "
                "separate them first (mocap-gateway modules assign does)"
            )
        return _named(found[0]) | {"sign": motion.sign}

    async def _backup(self, _request: requests.BackupRequest) -> Plain:
        self._refuse_others("saving settings")
        return {"modules": await read_backup(self.configurator, await self._discover())}

    async def _restore(self, request: requests.RestoreRequest) -> Plain:
        self._refuse_others("restoring settings")
        self._refuse_unless_allowed("restoring settings")
        wanted = {bytes.fromhex(text): settings for text, settings in request.modules.items()}
        present = await self.configurator.present_ids(wanted)
        present_settings = {uid: settings for uid, settings in wanted.items() if uid in present}
        backup = {uid.hex(): settings for uid, settings in present_settings.items()}
        restored = await self._recorded(
            present_settings, lambda: restore_backup(self.configurator, backup, self._rig_ids)
        )
        restored.absent += [uid for uid in wanted if uid not in present]
        return _restored(restored)

    async def _card_list(self, request: requests.CardListRequest) -> Plain:
        device = await self._find(request.device)
        files = await Card(self._client, device.unique_id).files()
        return _named(device) | {"files": [file._asdict() for file in files]}

    async def _card_start(self, request: requests.CardStartRequest) -> Plain:
        device = await self._find(request.device)
        await self._client.request(device.unique_id, Verb.START)
        return _named(device)

    async def _card_stop(self, request: requests.CardStopRequest) -> Plain:
        device = await self._find(request.device)
        await self._client.request(device.unique_id, Verb.STOP)
        return _named(device)

    async def _card_read(self, request: requests.CardReadRequest) -> Plain:
        device = await self._find(request.device)
        data = await Card(self._client, device.unique_id).read(request.file, request.offset, request.length)
        return {"data": base64.b64encode(data).decode()}

    async def _card_erase(self, request: requests.CardEraseRequest) -> Plain:
        device = await self._find(request.device)
        await Card(self._client, device.unique_id).erase(ALL_FILES if request.file is None else request.file)
        return _named(device)

    @property
    def _rig_ids(self) -> set[int]:
        """Ids that the rig gives, also to what is switched off."""
        local = {each.device for each in self._suit.local_devices if each.device is not None}
        return {*segments_of(self._suit).values(), *local}

    def _refuse_others(self, action: str) -> None:
        """Raise ``RequestError`` where there are modules of other makers alone."""
        if not self._has_own:
            raise RequestError(
                f"{action} is for modules of our own; modules of other makers are numbered by 'module' at "
                "their links, and `modules show` and `modules set` tell and change their settings"
            )

    async def _assign_ids(self, ids: dict[bytes, int]) -> list[Change]:
        self._refuse_unless_allowed("changing module ids")
        wanted = {uid: {"module_id": module} for uid, module in ids.items()}
        return await self._recorded(wanted, lambda: self.configurator.assign_ids(ids, self._rig_ids))

    async def _recorded(
        self, wanted: Mapping[bytes, Mapping[str, Any]], work: Callable[[], Awaitable[_Done]]
    ) -> _Done:
        """Change something, with what stood there before in the journal until it is taken back.

        Of what fails the journal keeps what the modules hold all the same.
        Raises ``JournalError``, before anything is sent, where that cannot be kept.
        """
        # The journal is written first: whatever ends this process, what stood there before can be put back.
        planned = await self.configurator.plan(wanted)
        if not planned:
            return await work()
        entry = await asyncio.to_thread(self._journal.record, planned)
        try:
            done = await work()
        except (DeviceError, LinkError, ValueError) as error:
            # Only what the modules hold now belongs into the journal; the rest was never changed.
            left = await self.configurator.committed(planned)
            await self._settle(entry, left)
            if left and not isinstance(error, UnfinishedError):
                modules = ", ".join(change.unique_id.hex() for change in left)
                raise UnfinishedError(
                    f"{error}; changed all the same, or perhaps: {modules}; `modules undo` takes that back"
                ) from error
            raise
        if isinstance(done, Restored) and (done.failures or done.absent):
            unfinished = {*done.failures, *done.absent}
            finished = [change for change in planned if change.unique_id not in unfinished]
            failed = [change for change in planned if change.unique_id in done.failures]
            await self._settle(entry, [*finished, *await self.configurator.committed(failed)])
        return done

    async def _left_over(self, changes: Collection[Change], restored: Restored) -> list[Change]:
        """Return what of some changes still stands in modules that were not heard, or failed."""
        absent = [change for change in changes if change.unique_id in restored.absent]
        failed = [change for change in changes if change.unique_id in restored.failures]
        return [*absent, *await self.configurator.committed(failed)]

    async def _settle(self, entry: Entry, changes: Collection[Change]) -> None:
        """Keep of an entry what the modules hold. Where that fails it stays whole, which undoes as well."""
        try:
            await asyncio.to_thread(self._journal.settle, entry, changes)
        except JournalError as error:
            _log.warning("the last change stays in the journal as it was planned: %s", error)

    def _refuse_unless_allowed(self, action: str) -> None:
        if not self._client.allow_writes:
            raise WritesLockedError(action)

    async def _in_turn(self, work: Callable[[], Awaitable[_Done]]) -> _Done:
        async with self._turn:
            return await work()

    async def _discover(self) -> Roster:
        return await self.configurator.discover()

    async def _discover_all(self) -> tuple[Roster, dict[int, MakersModule]]:
        """Return who answers: our own, and those of others by module id."""
        others = {module.module: module for module in await self.makers.discover()}
        has_answer = len(_absent(self._client.links)) < len(self._client.links) or not self.makers.has_links
        return await self._discover() if has_answer else Roster(()), others

    @property
    def _has_own(self) -> bool:
        """Whether there is a link on which modules of our own may be, or none at all."""
        return bool(self._client.links) or not self.makers.has_links

    async def _roster(self) -> Roster:
        return self.configurator.roster or await self._discover()

    async def _find(self, name: str) -> Device:
        """Return a device that is known, or else from a new discovery. Raises ``DeviceError``."""
        if self.configurator.roster is not None:
            try:
                return self.configurator.roster.find(name)
            except DeviceError:
                _log.debug("%s is not known yet", name)
        if not self._has_own:
            mute = {str(module): carries for module, carries in self.makers.without_commands.items()}
            if (carries := mute.get(name.strip())) is not None:
                raise UnknownDeviceError(
                    f"module {name} takes no commands, as nothing does that speaks {carries}; to see which "
                    "it is, shake it and watch `mocap-gateway view`"
                )
            there = ", ".join(f"{other.module} ({other.unique_id})" for other in await self.makers.discover())
            raise UnknownDeviceError(f"no device '{name}' answers; there are: {there or 'none'}")
        return (await self._discover()).find(name)


def _absent(links: Mapping[str, Link]) -> dict[str, str]:
    """Return why those links are not open that are kept open, by name."""
    kept = {name: link for name, link in links.items() if isinstance(link, ReconnectingLink)}
    return {name: link.status.reason for name, link in kept.items() if link.state is LinkState.DOWN}


def _named(device: Device | MakersModule) -> Plain:
    uid = device.unique_id
    return {"module": device.module, "unique_id": uid if isinstance(uid, str) else uid.hex()}


def _change(change: Change) -> Plain:
    return {
        "unique_id": change.unique_id.hex(),
        "before": dict(change.before),
        "after": dict(change.after),
    }


def _restored(restored: Restored) -> Plain:
    return {
        "changes": list(map(_change, restored.changes)),
        "unchanged": [uid.hex() for uid in restored.unchanged],
        "absent": [uid.hex() for uid in restored.absent],
        "failures": {uid.hex(): reason for uid, reason in restored.failures.items()},
    }
