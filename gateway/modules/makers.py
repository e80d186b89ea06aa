"""Modules of other makers, asked in their own protocols over links that a source reads."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from devices.commands.device_errors import DeviceError, NoAnswerError, UnfinishedError
from devices.link import Link, LinkError, SentChunk, gateway_time_ns
from gateway.frames import FusedReading, InertialBatch
from gateway.sources.makers import (
    TALK_S,
    Description,
    MakersCommands,
    MakersDevice,
    MakersSource,
    SampleWatcher,
    SettingAdvice,
)
from gateway.sources.registry import source_kind
from gateway.sources.source import Source

_ATTEMPTS = 3
_ANSWER_S = 0.5
_LATE_S = 3.0
"""For answers to a question that was asked more than once: a busy machine gives all of them later still."""
_WRITE_S = 1.0
_IDLE_S = 1.0

_Found = TypeVar("_Found")


class MakersModule(NamedTuple):
    """A device that answered."""

    module: int
    link: str
    description: Description
    line: MakersLine
    commands: MakersCommands

    @property
    def unique_id(self) -> str:
        """Its serial number."""
        return self.description.unique_id

    def is_meant(self, name: str) -> bool:
        """Return whether it goes by a module id or the beginning of a serial number."""
        wanted = name.strip().lower()
        return wanted == str(self.module) or (len(wanted) > 3 and self.unique_id.startswith(wanted))


class ReceivedCounts(NamedTuple):
    """What came over a link."""

    received: int
    """Packets of the module, by now on any link."""
    dropped: Mapping[str, int]
    """Messages that could not be read, by reason."""
    samples: int
    """Raw, of all modules on the link."""
    orientations: int
    """Fused on board, likewise."""


class MakersLine:
    """The way to the device on one link, and back."""

    def __init__(
        self, link: Link, source: MakersSource, module: int, on_sent: Callable[[SentChunk], None]
    ) -> None:
        self.module = module
        """Number of the device in the rig."""
        self._link, self._source, self._on_sent = link, source, on_sent

    @property
    def device(self) -> MakersDevice:
        """What is known of the device, and of those that share its link."""
        return self._source.devices[self._link.name]

    async def send(self, data: bytes) -> None:
        """Write to the device. Raises ``LinkError``."""
        device = self.device
        to = device.command_address(self.module)
        self._on_sent(await _written(self._link, device.framed(data), to))

    async def request(self, data: bytes, meant: Callable[[Any], _Found | None], what: str) -> _Found:
        """Write until a message comes for which ``meant`` returns something, and return that.

        Raises ``LinkError``, and ``NoAnswerError`` where none comes.
        """
        # The listener runs in the task that reads the link: the queue brings its finding to this one.
        answers: asyncio.Queue[_Found] = asyncio.Queue()

        def take(message: Any) -> None:
            found = meant(message)
            if found is not None:
                answers.put_nowait(found)

        # Listening begins before the question is sent, so that a quick answer is not missed.
        self._source.listen(self._link.name, self.module, take)
        try:
            for repeated in range(_ATTEMPTS):
                await self.send(data)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(_ANSWER_S):
                        found = await answers.get()
                    # Answers to the attempts before may still come, and would be taken for answers to the
                    # next question.
                    await _passed_over(answers, repeated)
                    return found
        finally:
            self._source.stop_listening(self._link.name, self.module, take)
        raise NoAnswerError(
            f"the device on link '{self._link.name}' does not answer '{what}' (asked {_ATTEMPTS} times): is "
            "it switched on, and does it take commands there?"
        )


async def _passed_over(answers: asyncio.Queue[_Found], n: int) -> None:
    """Wait for so many answers more, as far as they come: to a question repeated too early there are several,
    and where they do not say to what, the next question would take them for its own."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_LATE_S):
            for _ in range(n):
                await answers.get()


class MakersModules:
    """All devices of other makers that take commands."""

    def __init__(self, on_sent: Callable[[SentChunk], None] = lambda _sent: None) -> None:
        """Begin without links; ``on_sent`` is called with everything that was written to one."""
        self._on_sent = on_sent
        self._sources: dict[str, MakersSource] = {}
        self._links: dict[str, Link] = {}
        self._lines: dict[tuple[str, int], tuple[MakersCommands, MakersLine]] = {}
        self._known: dict[tuple[str, int], MakersModule] = {}

    def add_link(self, link: Link, source: Source) -> None:
        """Announce a link, and the source that reads it; one that takes no commands is passed over."""
        if isinstance(source, MakersSource):
            self._sources[link.name], self._links[link.name] = source, link
            commands = source_kind(source.carries).commands
            if commands is not None:
                for module in source.devices[link.name].modules:
                    line = MakersLine(link, source, module, self._on_sent)
                    self._lines[link.name, module] = commands, line

    async def talk(self) -> None:
        """Say for ever what those on the links await: greetings, heartbeats, pings."""
        while True:
            await asyncio.sleep(TALK_S if self._sources else _IDLE_S)
            for name, source in self._sources.items():
                for data, to in source.devices[name].due(gateway_time_ns()):
                    with contextlib.suppress(LinkError):
                        self._on_sent(await _written(self._links[name], data, to))

    @contextlib.contextmanager
    def watched(self, watch: SampleWatcher) -> Iterator[None]:
        """Call ``watch`` with all samples meanwhile."""
        sources = list(dict.fromkeys(self._sources.values()))
        for source in sources:
            source.watchers.append(watch)
        try:
            yield
        finally:
            for source in sources:
                source.watchers.remove(watch)

    @property
    def has_links(self) -> bool:
        """Whether there is any such link."""
        return bool(self._sources)

    @property
    def links(self) -> Mapping[str, Link]:
        """Those links, by name."""
        return self._links

    async def discover(self) -> list[MakersModule]:
        """Return those that say who they are, by module id."""
        found = await asyncio.gather(*map(self._describe, self._lines))
        self._known = {(module.link, module.module): module for module in found if module is not None}
        return sorted(self._known.values(), key=lambda module: module.module)

    @property
    def without_commands(self) -> dict[int, str]:
        """What those that take none are, by module id: the configuration's word for them."""
        return {
            module: source.carries
            for link, source in self._sources.items()
            if source_kind(source.carries).commands is None
            for module in source.devices[link].modules
        }

    async def find(self, name: str) -> MakersModule | None:
        """Return the device of a module id or the beginning of a serial number; None: no such one.

        Raises ``DeviceError`` where several are meant, or the one that is does not answer.
        """
        found = _meant(self._known.values(), name)
        # A module id of the configuration has a line of its own, which is asked before all are searched.
        for link, module in self._lines:
            if found is None and name.strip() == str(module):
                found = await self._asked((link, module))
        return found or _meant(await self.discover(), name)

    def modules_of(self, link: str) -> tuple[int, ...]:
        """Return the numbers of the devices on a link."""
        return self._sources[link].devices[link].modules

    def received(self, link: str) -> ReceivedCounts:
        """Return what came over a link."""
        source, device = self._sources[link], self._sources[link].devices[link]
        records = (source.modules.records.get(module) for module in device.modules)
        received = sum(record.received for record in records if record is not None)
        return ReceivedCounts(received, device.dropped, device.made[InertialBatch], device.made[FusedReading])

    async def advice(self, rate_hz: float) -> list[tuple[str, SettingAdvice]]:
        """Return what would be better otherwise in the devices' settings, with the link of each; of those
        that answer. rate_hz: of the poses."""
        found = [
            (link, each)
            for link, source in self._sources.items()
            for each in source.devices[link].findings(rate_hz)
        ]
        for module in await self.discover():
            settings = await module.commands.read(module.line)
            advice = module.commands.advice(module.module, settings, rate_hz)
            found += [(module.link, each) for each in advice]
        return found

    async def _describe(self, which: tuple[str, int]) -> MakersModule | None:
        try:
            return await self._asked(which)
        except (DeviceError, LinkError):
            return None

    async def _asked(self, which: tuple[str, int]) -> MakersModule:
        commands, line = self._lines[which]
        link, module = which
        return MakersModule(module, link, await commands.describe(line), line, commands)


async def _written(link: Link, data: bytes, to: str) -> SentChunk:
    """Write to a device on a link, the only one there if no address is given. Raises ``LinkError``."""
    sent = SentChunk(data, gateway_time_ns(), link.name)
    try:
        async with asyncio.timeout(_WRITE_S):
            await link.write(data, [to] if to else [])
    except TimeoutError:
        raise LinkError(f"{link.name} takes nothing: is the device there?") from None
    return sent


def _meant(modules: Iterable[MakersModule], name: str) -> MakersModule | None:
    found = [module for module in modules if module.is_meant(name)]
    if len(found) > 1:
        several = " and ".join(f"{module.unique_id} on link '{module.link}'" for module in found)
        raise DeviceError(f"'{name}' means {several}: name one by its serial number")
    return found[0] if found else None


async def changed(module: MakersModule, settings: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write settings; return what stood there before, as far as that can be read, and after.

    Raises ``UnfinishedError`` where some of it was written when something failed, or it is not known whether:
    it says what stands there now, and how to go back.
    """
    before = await module.commands.read(module.line)
    try:
        after = await module.commands.write(module.line, settings)
    # It says already what stands in the device now.
    except UnfinishedError:
        raise
    except (DeviceError, LinkError) as error:
        left = await _left_by_failure(module, settings, before)
        if left is None:
            raise
        raise UnfinishedError(f"{error}; {left}") from error
    return {name: before.get(name) for name in settings}, after


async def _left_by_failure(
    module: MakersModule, settings: Mapping[str, Any], before: Mapping[str, Any]
) -> str | None:
    """Return what a write that failed has changed, for people; None: nothing."""
    # What is left behind can only be read: the write failed at an unknown place.
    try:
        now = await module.commands.read(module.line)
    except (DeviceError, LinkError):
        return (
            f"whether any of it was written is not known, because the device does not answer: `mocap-gateway "
            f"modules show {module.module}` tells, once it does; before, it was {_typed(settings, before)}"
        )
    changed_names = [name for name in settings if now.get(name) != before.get(name)]
    known = [name for name in changed_names if name in before]
    if not changed_names:
        return None
    found = f"written all the same: {_typed(changed_names, now)}"
    if not known:
        return found
    back = f"mocap-gateway modules set {module.module} {_typed(known, before)} --allow-writes"
    return f"{found}; `{back}` takes that back"


def _typed(names: Iterable[str], values: Mapping[str, Any]) -> str:
    """Return settings as a user would type them."""
    return " ".join(f"{name}={_as_typed(values.get(name))}" for name in names)


def _as_typed(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(str, value))
    return str(value).lower() if isinstance(value, bool) else str(value)
