"""A suit whose links this process reads itself, for as long as a command of the user takes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence

from devices.commands.command_client import LISTENS_TO, CommandClient
from devices.endpoints import link_from_url
from devices.link import SUIT, Chunk, Link, LinkBusyError, LinkError, SentChunk, gateway_time_ns
from devices.links.reconnect import LinkState, ReconnectingLink
from devices.replay_link import contents_of
from gateway.body.skeleton import WornSuit
from gateway.modules.journal import Journal
from gateway.modules.makers import MakersModules
from gateway.modules.operations import ModuleOperations
from gateway.sources.clock_mode import ClockMode
from gateway.sources.link_settings import LinkSettings
from gateway.sources.makers import OthersLinkSettings
from gateway.sources.module_table import ModuleTable
from gateway.sources.registry import carried_by, source_kind
from gateway.sources.source import Source, SourceContext
from gateway.sources.suit import SuitSource

_LOOK_S = 0.1
_LISTENED_S = 1.2
"""On UDP only those who were heard can be asked; modules that do not sample send their health each second."""
_FREED_S = 1.0
"""For so long a port may still be taken by a program that is just ending."""

_THROUGH_A_GATEWAY = (
    "; if that is a running gateway, ask it instead: --mqtt HOST:PORT (of its broker) in the place of -c or "
    "--link"
)


@contextlib.asynccontextmanager
async def suit_session(
    links: Sequence[LinkSettings],
    suit: WornSuit,
    *,
    allow_writes: bool,
    journal: Journal,
    clock_mode: ClockMode = ClockMode.ESTIMATED,
    needs_all: bool = True,
) -> AsyncIterator[ModuleOperations]:
    """Open the links of modules and read them until the end. Raises ``LinkError`` for one that is absent.

    needs_all: False: those that are absent are opened once they come, as long as any is there; recordings
    must be there all the same.

    A link that is lost later is opened again: a module on USB goes away when it restarts. Links with no
    modules at the other end are left alone.
    """
    asked = [link for link in links if source_kind(link.carries).has_modules]
    opened = {
        each.name: ReconnectingLink(link_from_url(each.url, name=each.name), strict=needs_all)
        for each in asked
    }
    modules = ModuleTable(clock_mode, is_compiled=False)  # done before kernels would be compiled
    context = SourceContext(suit, modules, links={link.name: link for link in links})
    sources = _Sources(context)
    client = CommandClient(
        # Only the gateway's own modules speak its commands; those of other makers are asked by ``makers``.
        [opened[link.name] for link in asked if link.carries == SUIT],
        allow_writes=allow_writes,
    )
    connect_client(client, sources.stream)
    makers = MakersModules(sources.sent)
    async with contextlib.AsyncExitStack() as stack:
        readers = []
        for each in asked:
            link = opened[each.name]
            await _open(link)
            # Closed in reverse order at the end, whatever fails in between.
            stack.push_async_callback(link.close)
            routes = sources.add(link, each.carries)
            for name, source in routes.items():
                if name == link.name:
                    makers.add_link(link, source)
            readers.append(asyncio.create_task(_read(link, routes), name=f"link {link.name}"))
        # One link that is there suffices: an absent one opens once its device is plugged in.
        there = [each for each in asked if opened[each.name].state is LinkState.UP]
        if asked and not there:
            down = [opened[each.name].status for each in asked]
            hint = _THROUGH_A_GATEWAY if any(status.is_busy for status in down) else ""
            raise LinkError("; ".join(status.reason for status in down) + hint)

        readers.append(asyncio.create_task(makers.talk(), name="talk"))
        stack.push_async_callback(_end, readers)
        await sources.wait_for_modules(there)
        yield ModuleOperations(sources.stream, client, suit, journal, makers)


class _Sources:
    """What reads the links, one of a kind."""

    def __init__(self, context: SourceContext) -> None:
        self._context = context
        self.stream = SuitSource(context.modules)
        self._routes: dict[str, Source] = {}
        self._sources: dict[str, Source] = {SUIT: self.stream}

    def sent(self, sent: SentChunk) -> None:
        """Take note of what was said to modules of others."""
        self._routes[sent.link].sent(sent)

    async def wait_for_modules(self, links: Sequence[LinkSettings]) -> None:
        """Wait for devices that send unasked, or that must be greeted first."""
        awaited = {
            module
            for link in links
            if isinstance(link, OthersLinkSettings) and source_kind(link.carries).greeted_in_s
            for module in link.modules
        }
        begun_ns = gateway_time_ns()
        if any(link.url.startswith("udp:") for link in links):
            await asyncio.sleep(_LISTENED_S)
        most_s = max((source_kind(link.carries).greeted_in_s for link in links), default=0.0)
        end_ns = begun_ns + round(most_s * 1e9)
        while awaited - self.stream.modules.keys() and gateway_time_ns() < end_ns:  # noqa: ASYNC110 - polled
            await asyncio.sleep(_LOOK_S)

    def add(self, link: ReconnectingLink, carries: str) -> dict[str, Source]:
        """Announce an open link; return what reads it, by the names that its chunks have."""
        routes = {}
        for name, content in contents_of(link.link, carries).items():
            carried = carried_by(content)
            if source_kind(carried).has_modules:
                if carried not in self._sources:
                    self._sources[carried] = source_kind(carried).make(self._context)
                routes[name] = self._sources[carried]
                routes[name].add_link(name, content)
        self._routes |= routes
        return routes


def connect_client(client: CommandClient, stream: SuitSource) -> None:
    """Pass what a stream receives, and from whom, on to a client."""
    client.senders = stream.senders
    for packet_class in LISTENS_TO:
        stream.listen(packet_class, client.take)


async def _open(link: ReconnectingLink) -> None:
    """Open a link; wait for a while if it is taken, since who had it may just be ending."""
    end_ns = gateway_time_ns() + round(_FREED_S * 1e9)
    while True:
        try:
            with _unlogged(logging.getLogger(ReconnectingLink.__module__)):
                return await link.open()
        except LinkBusyError as error:
            if gateway_time_ns() > end_ns:
                raise LinkBusyError(f"{error}{_THROUGH_A_GATEWAY}") from error
        await asyncio.sleep(_LOOK_S)


@contextlib.contextmanager
def _unlogged(logger: logging.Logger) -> Iterator[None]:
    """Silence the warnings of a logger meanwhile: what it would warn of is raised by the caller."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


async def _read(link: Link, routes: Mapping[str, Source]) -> None:
    async for item in link:
        if isinstance(item, Chunk) and item.link in routes:
            routes[item.link].receive(item)


async def _end(readers: Sequence[asyncio.Task[None]]) -> None:
    for reader in readers:
        reader.cancel()
    await asyncio.gather(*readers, return_exceptions=True)
