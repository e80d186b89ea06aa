"""People before cameras: where they will be, for the cameras; of several, a service of its own for each, from
when they enter until they have left."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Coroutine, Sequence
from typing import Any

from devices.link import Chunk, Link, LinkError
from devices.links.reconnect import ReconnectingLink
from gateway.body.skeleton import WornSuit
from gateway.cameras.live_crowd import LiveCrowd
from gateway.errors import SettingsError
from gateway.reconstruction.video.reconstructor import VideoReconstructor
from gateway.service.further_bodies import HandedLink, beside
from gateway.settings import GatewaySettings
from gateway.sources.link_settings import LinkSettings
from gateway.sources.registry import NO_CAMERAS

log = logging.getLogger(__name__)

CARRIES = "heat_maps"
LINK = "cameras"
_LONGEST_END_S = 5.0
"""For the services of people to say that they end."""

Serve = Callable[
    [GatewaySettings, WornSuit, Sequence[Link]], tuple[VideoReconstructor, Coroutine[Any, Any, None]]
]
"""Makes a person's service: what solves them in it, and what runs it until it is cancelled."""


class OrdersToCameras:
    """Writes the newest orders to every link that heat maps come by, and waits for none: what a link does not
    take is left out."""

    def __init__(self, links: Sequence[ReconnectingLink]) -> None:
        self._links = links
        self._writing: dict[str, asyncio.Task[None]] = {}

    def send(self, line: bytes) -> None:
        """Hand a line of orders to every link that has taken the one before. Needs a running event loop."""
        for link in self._links:
            before = self._writing.get(link.name)
            if before is None or before.done():
                self._writing[link.name] = asyncio.create_task(_write(link, line), name=f"orders {link.name}")


class PeopleBeforeCameras:
    """Starts a service for whoever enters, hands on their heat maps, and ends it when they have left.

    Belongs to one event loop.
    """

    def __init__(
        self, settings: GatewaySettings, suit: WornSuit, serve: Serve, send: Callable[[bytes], None]
    ) -> None:
        """Begin with nobody. suit: with the cameras; the lengths of its body do not count, everybody is
        measured. send: hands orders to the cameras. Raises ``SettingsError`` for a suit without cameras."""
        if suit.video is None:
            raise SettingsError(f"people: {NO_CAMERAS}")
        assert settings.people is not None
        self._settings, self._serve, self._send = settings, serve, send
        self.crowd = LiveCrowd(suit.video, settings.people)
        self.broker_port = settings.mqtt.port
        """Of the broker that the first service has started or found."""
        self._present: dict[int, tuple[HandedLink, asyncio.Task[None]]] = {}
        self._ending: dict[int, asyncio.Task[None]] = {}

    def take(self, chunk: Chunk) -> None:
        """Take heat maps of any camera."""
        for instant in self.crowd.receive(chunk):
            for number, messages in instant.messages.items():
                self._present[number][0].hand(Chunk(b"".join(messages), chunk.arrived_ns, LINK))
            for number in instant.left:  # some are back at once
                self._end(number)
            for number, suit in instant.entered.items():
                self._begin(number, suit)
            self._send(instant.orders)

    async def close(self) -> None:
        """End everybody's service."""
        for number in list(self._present):
            self._end(number)
        if self._ending:
            await asyncio.wait(self._ending.values(), timeout=_LONGEST_END_S)

    def statistics(self) -> dict[str, object]:
        """Return counters for the health message."""
        return {"people": self.crowd.statistics()}

    def _begin(self, number: int, suit: WornSuit) -> None:
        settings = self._settings_of(number)
        link = HandedLink(LINK)
        solver, service = self._serve(settings, suit, [link])
        self.crowd.solved_by(number, solver)
        serving = asyncio.create_task(_after(self._ending.pop(number, None), service), name=settings.gateway)
        self._present[number] = link, serving
        log.info("person %d has entered: '%s'", number, settings.gateway)

    def _end(self, number: int) -> None:
        _, serving = self._present.pop(number)
        serving.cancel()
        self._ending[number] = serving
        serving.add_done_callback(lambda done: self._forget(number, done))
        log.info("person %d has left", number)

    def _forget(self, number: int, done: asyncio.Task[None]) -> None:
        if self._ending.get(number) is done:
            del self._ending[number]

    def _settings_of(self, number: int) -> GatewaySettings:
        first = next(link for link in self._settings.links if link.carries == CARRIES)
        links = [LinkSettings(name=LINK, url=first.url, carries=CARRIES)]
        settings = beside(self._settings, str(number), links, self.broker_port)
        # without their places, all would stand on one spot
        mqtt = settings.mqtt.model_copy(update={"include": settings.mqtt.include | {"position"}})
        return settings.model_copy(update={"people": None, "mqtt": mqtt})


async def _after(former: asyncio.Task[None] | None, service: Coroutine[Any, Any, None]) -> None:
    """Run the service of somebody who is back once the one before has taken its leave: they share topics."""
    try:
        if former is not None:
            await asyncio.wait([former])
    except asyncio.CancelledError:
        service.close()
        raise
    await service


async def _write(link: ReconnectingLink, line: bytes) -> None:
    with contextlib.suppress(LinkError):  # the link's own state tells that it is down
        await link.write(line)
