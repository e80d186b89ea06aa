"""Modules of other makers, asked in their own words over links that somebody reads."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

from devices.device_errors import DeviceError, NoAnswerError
from devices.link import Link, LinkError, SentChunk, gateway_time_ns
from gateway.sources.makers import Advice, Description, MakersCommands, MakersSource
from gateway.sources.registry import source_kind
from gateway.sources.source import Source

_ATTEMPTS = 3
_ANSWER_S = 0.5
_WRITE_S = 1.0

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
        """Whether it goes by a module id or the beginning of a serial number."""
        wanted = name.strip().lower()
        return wanted == str(self.module) or (len(wanted) > 3 and self.unique_id.startswith(wanted))


class Heard(NamedTuple):
    """What came over a link."""

    received: int
    """Packets of the module, by now on any link."""
    dropped: Mapping[str, int]
    """Messages that could not be read, by reason."""


class MakersLine:
    """The way to the device on one link, and back."""

    def __init__(self, link: Link, source: MakersSource, on_sent: Callable[[SentChunk], None]) -> None:
        self._link, self._source, self._on_sent = link, source, on_sent

    async def tell(self, data: bytes) -> None:
        """Write to the device. Raises ``LinkError``."""
        to = self._source.devices[self._link.name].command_address()
        sent = SentChunk(data, gateway_time_ns(), self._link.name)
        try:
            async with asyncio.timeout(_WRITE_S):
                await self._link.write(data, [to] if to else [])
        except TimeoutError:
            raise LinkError(f"{self._link.name} takes nothing: is the device there?") from None
        self._on_sent(sent)

    async def ask(self, data: bytes, meant: Callable[[Any], _Found | None], what: str) -> _Found:
        """Write until a message comes for which ``meant`` returns something, and return that.

        Raises ``LinkError``, and ``NoAnswerError`` where none comes.
        """
        answered: asyncio.Future[_Found] = asyncio.get_running_loop().create_future()

        def take(message: Any) -> None:
            found = meant(message)
            if found is not None and not answered.done():
                answered.set_result(found)

        self._source.listen(self._link.name, take)
        try:
            for _ in range(_ATTEMPTS):
                await self.tell(data)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(_ANSWER_S):
                        return await asyncio.shield(answered)
        finally:
            self._source.stop_listening(self._link.name, take)
        raise NoAnswerError(
            f"the device on link '{self._link.name}' does not answer '{what}' (asked {_ATTEMPTS} times): is "
            "it switched on, and does it take commands there?"
        )


class MakersModules:
    """All devices of other makers that take commands."""

    def __init__(self, on_sent: Callable[[SentChunk], None] = lambda _sent: None) -> None:
        """on_sent: told of everything that was written to a link."""
        self._on_sent = on_sent
        self._sources: dict[str, MakersSource] = {}
        self._lines: dict[str, tuple[MakersSource, MakersCommands, MakersLine]] = {}
        self._known: dict[str, MakersModule] = {}

    def add_link(self, link: Link, source: Source) -> None:
        """Announce a link, and the source that reads it; one that takes no commands is passed over."""
        if isinstance(source, MakersSource):
            self._sources[link.name] = source
            commands = source_kind(source.carries).commands
            if commands is not None:
                line = MakersLine(link, source, self._on_sent)
                self._lines[link.name] = source, commands, line

    @property
    def has_links(self) -> bool:
        """Whether there is any such link."""
        return bool(self._sources)

    async def discover(self) -> list[MakersModule]:
        """Return those that say who they are, by module id."""
        found = await asyncio.gather(*map(self._describe, self._lines))
        self._known = {module.link: module for module in found if module is not None}
        return sorted(self._known.values(), key=lambda module: module.module)

    async def find(self, name: str) -> MakersModule | None:
        """Return the device of a module id or the beginning of a serial number; None: no such one.

        Raises ``DeviceError`` where several are meant, or the one that is does not answer.
        """
        found = _meant(self._known.values(), name)
        for link, (source, *_) in self._lines.items():
            if found is None and name.strip() == str(source.devices[link].module):
                found = await self._asked(link)
        return found or _meant(await self.discover(), name)

    def heard(self, link: str) -> Heard:
        """Return what came over a link."""
        source, device = self._sources[link], self._sources[link].devices[link]
        record = source.modules.records.get(device.module)
        return Heard(0 if record is None else record.received, device.dropped)

    async def advice(self, rate_hz: float) -> list[tuple[str, Advice]]:
        """Return what would be better otherwise in the devices' settings, with the link of each; of those
        that answer. rate_hz: of the poses."""
        found = []
        for module in await self.discover():
            settings = await module.commands.read(module.line)
            told = module.commands.advice(module.module, settings, rate_hz)
            found += [(module.link, each) for each in told]
        return found

    async def _describe(self, link: str) -> MakersModule | None:
        try:
            return await self._asked(link)
        except (DeviceError, LinkError):
            return None

    async def _asked(self, link: str) -> MakersModule:
        source, commands, line = self._lines[link]
        description = await commands.describe(line)
        return MakersModule(source.devices[link].module, link, description, line, commands)


def _meant(modules: Iterable[MakersModule], name: str) -> MakersModule | None:
    found = [module for module in modules if module.is_meant(name)]
    if len(found) > 1:
        several = " and ".join(f"{module.unique_id} on link '{module.link}'" for module in found)
        raise DeviceError(f"'{name}' means {several}: name one by its serial number")
    return found[0] if found else None


async def changed(module: MakersModule, settings: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write settings; return what stood there before, as far as that can be read, and after."""
    stood = await module.commands.read(module.line)
    after = await module.commands.write(module.line, settings)
    return {name: stood.get(name) for name in settings}, after
