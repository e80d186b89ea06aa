"""Messages of a broker, or of a cluster, for as long as somebody wants them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence

import aiomqtt

from gateway.contract.topics import Topics
from gateway.outputs.connection import MOST_MESSAGES, explain, first_to_end, unique_identifier
from gateway.outputs.failover import BrokerUnreachableError, ClusterConnection, Companions, follow_kept
from gateway.outputs.settings import MqttSettings

_log = logging.getLogger(__name__)

_A_TURN = 64
"""Messages; then the event loop has its turn."""


class Receiver:
    """Gives every message of some topics to a function. Belongs to one event loop."""

    def __init__(
        self,
        settings: MqttSettings,
        role: str,
        passing: Sequence[str],
        kept: Sequence[str],
        take: Callable[[aiomqtt.Message], None],
        most_messages: int = MOST_MESSAGES,
        *,
        reads_both: bool = True,
    ) -> None:
        """role: part of client identifiers. passing, kept: filters of what is published, and of what is
        retained. most_messages: so many wait to be read; then they are dropped, and counted. reads_both: two
        nodes of a cluster are read all the time, which is twice as much, and nothing is missed for long when
        one dies; else the second is subscribed to when it is needed, which a cluster that chooses a leader
        lets wait for some seconds."""
        self.is_connected = False
        self.subscribed = asyncio.Event()
        """Set for good once messages come in."""
        self.dropped = 0
        """Messages for which the reader was too slow."""
        self._settings = settings
        self._role = role
        self._passing, self._kept = passing, kept
        self._take_message = take
        self._reads_both = reads_both
        self._subscribed: aiomqtt.Client | None = None
        """Connection that stood by, on which all that passes is subscribed to."""
        self._refused = 0
        # Not the client_id of the settings: that is the gateway's own.
        self._echo = Topics(settings.base_topic, unique_identifier(role)).bridge_echo
        self._connection = ClusterConnection(
            settings, settings.port, role, self._echo, on_full=self._note_full, most_messages=most_messages
        )
        self._unreachable: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Receive for ever; a connection that is lost is made again, at another node where there is one.

        A message may come twice where two nodes of a cluster are read.
        Raises ``BrokerUnreachableError`` when no address lets us in at first.
        """
        receiving = self._connection.run(
            self._use,
            self._note_lost,
            asyncio.Event(),
            Companions(prepare=self._prepare, beside=self._use_beside, take=self._take),
        )
        parts = [receiving, self._until_unreachable()]
        if self._settings.failover:
            # On a connection of its own: a cluster that has lost its leader is slow to tell what it retains.
            parts.append(follow_kept(self._settings, self._role, self._kept, self._take_message))
        await first_to_end(*parts)

    async def _until_unreachable(self) -> None:
        await self._unreachable

    async def _use(self, client: aiomqtt.Client) -> None:
        filters = [(topic, 0) for topic in self._passing]
        if not self._settings.failover:
            filters += [(topic, 1) for topic in self._kept]
        if client is not self._subscribed:
            await client.subscribe(filters)
        self.is_connected = True
        self.subscribed.set()
        count = 0
        async for message in client.messages:
            self._take(message)
            # aiomqtt takes several turns of the event loop for each message, and a burst comes faster.
            while not client._queue.empty():
                self._take(client._queue.get_nowait())
                count += 1
                if count % _A_TURN == 0:
                    await asyncio.sleep(0)

    async def _prepare(self, client: aiomqtt.Client) -> None:
        self._subscribed = None
        if self._reads_both:
            await client.subscribe([(topic, 0) for topic in self._passing])
            self._subscribed = client

    def _use_beside(self, client: aiomqtt.Client | None) -> None:
        """Read another node too, as long as the nodes are apart."""
        if self._reads_both:
            return
        if client is not None:
            client._client.subscribe([(topic, 0) for topic in self._passing])
        elif self._connection.standby is not None:
            self._connection.standby._client.unsubscribe(list(self._passing))
        self._subscribed = client

    def _take(self, message: aiomqtt.Message) -> None:
        if not message.topic.value.startswith(self._echo):
            self._take_message(message)

    def _note_full(self) -> None:
        self.dropped += 1

    def _note_lost(self, error: Exception) -> None:
        self._refused += 1
        settings = self._connection.settings
        reason = explain(error, settings, settings.port)
        if not self.subscribed.is_set():
            if self._refused > len(self._settings.failover) and not self._unreachable.done():
                self._unreachable.set_exception(BrokerUnreachableError(reason))
        elif self.is_connected:
            _log.warning("%s; trying again", reason)
        self.is_connected = False
