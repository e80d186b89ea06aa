"""A suit whose links this process reads itself, for as long as a command of the user takes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Collection, Iterator, Mapping, Sequence

from devices.command_client import LISTENS_TO, CommandClient
from devices.endpoints import link_from_url
from devices.link import Chunk, Link, LinkError
from devices.reconnect import ReconnectingLink
from devices.replay_link import framings_of
from gateway.body.skeleton import WornSuit
from gateway.modules.journal import Journal
from gateway.modules.operations import ModuleOperations
from gateway.sources.module_table import ClockMode
from gateway.sources.stream import Stream

_LISTENED_S = 1.2
"""On UDP only those who were heard can be asked; modules that do not sample tell their health each second."""

_THROUGH_A_GATEWAY = (
    "; if that is a running gateway, ask it instead: --mqtt HOST:PORT (of its broker) in the place of --link"
)


@contextlib.asynccontextmanager
async def suit_session(
    urls: Mapping[str, str],
    suit: WornSuit,
    *,
    allow_writes: bool,
    journal: Journal,
    clock_mode: ClockMode = ClockMode.ESTIMATED,
) -> AsyncIterator[ModuleOperations]:
    """Open the links (URL by name) and read them until the end. Raises ``LinkError`` for one that is absent.

    A link that is lost later is opened again: a module on USB goes away when it restarts.
    """
    links = [ReconnectingLink(link_from_url(url, name=name), strict=True) for name, url in urls.items()]
    stream = Stream(clock_mode)
    client = CommandClient(links, allow_writes=allow_writes)
    connect_client(client, stream)
    async with contextlib.AsyncExitStack() as stack:
        readers = []
        for link in links:
            await _open(link)
            stack.push_async_callback(link.close)
            framings = framings_of(link.link)
            for name, framing in framings.items():
                stream.add_link(name, framing)
            readers.append(
                asyncio.create_task(_read(link, stream, framings.keys()), name=f"link {link.name}")
            )
        stack.push_async_callback(_end, readers)
        if any(url.startswith("udp:") for url in urls.values()):
            await asyncio.sleep(_LISTENED_S)
        yield ModuleOperations(stream, client, suit, journal)


def connect_client(client: CommandClient, stream: Stream) -> None:
    """Have a client told what a stream hears, and of whom."""
    client.senders = stream.senders
    for packet_class in LISTENS_TO:
        stream.listen(packet_class, client.take)


async def _open(link: ReconnectingLink) -> None:
    try:
        with _unsaid(logging.getLogger(ReconnectingLink.__module__)):
            await link.open()
    except LinkError as error:
        # A link says no more than a sentence why it was not opened.
        hint = _THROUGH_A_GATEWAY if " is busy" in str(error) else ""
        raise LinkError(f"{error}{hint}") from error


@contextlib.contextmanager
def _unsaid(logger: logging.Logger) -> Iterator[None]:
    """Without the warnings of a logger: what it warns of is raised here."""
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


async def _read(link: Link, stream: Stream, names: Collection[str]) -> None:
    async for item in link:
        if isinstance(item, Chunk) and item.link in names:
            stream.receive(item)


async def _end(readers: Sequence[asyncio.Task[None]]) -> None:
    for reader in readers:
        reader.cancel()
    await asyncio.gather(*readers, return_exceptions=True)
