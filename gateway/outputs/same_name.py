"""Another gateway of our name at the broker: told by its messages, and left the name where that is wished."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

import aiomqtt
from paho.mqtt.subscribeoptions import SubscribeOptions

from gateway.contract.topics import Topics
from gateway.errors import OutputError
from gateway.outputs.own_topics import TwinWatch
from gateway.outputs.settings import MqttSettings

_RETAINED_S = 0.5
"""Time for what a broker keeps to come after a subscription."""


class NameTaken(OutputError):
    """Another gateway has our name, and we are not to publish beside it."""


class NameGuard:
    """Watches the topics of one gateway. Belongs to one event loop."""

    def __init__(self, settings: MqttSettings, topics: Topics, instance: str) -> None:
        """instance: our own id."""
        self._settings = settings
        self._topics = topics
        self._twins = TwinWatch(topics, instance)
        self._taken: asyncio.Future[None] | None = None

    @property
    def twin(self) -> str | None:
        """Instance of another gateway of the same name that was heard lately."""
        return self._twins.twin

    def begin(self) -> None:
        """Begin to be of use; wants a running event loop."""
        self._taken = asyncio.get_running_loop().create_future()

    async def until_taken(self) -> None:
        """Wait for ever, unless ``watch`` finds the name taken. Raises ``NameTaken`` then."""
        assert self._taken is not None, "not started"
        await asyncio.shield(self._taken)

    async def watch(self, client: aiomqtt.Client, where: str, *, is_first: bool) -> None:
        """Subscribe to what tells of another gateway of our name.

        where: address of the broker. is_first: nothing was published yet. Raises ``NameTaken`` where there
        is one and the settings say ``refuse``.
        """
        if self._settings.same_name == "ignore":
            return
        for topic in self._twins.watched:
            if self._settings.protocol_in_use == "5":
                await client.subscribe(topic, options=SubscribeOptions(qos=1, noLocal=True))
            else:
                await client.subscribe(topic, qos=1)
        if self._settings.same_name == "refuse" and is_first:
            await self._make_sure_to_be_alone(client, where)

    async def _make_sure_to_be_alone(self, client: aiomqtt.Client, where: str) -> None:
        await self._listen_for(client, _RETAINED_S, lambda: self._twins.is_suspected)
        if self._twins.is_suspected:
            beat_s = 2 * self._settings.health_interval + _RETAINED_S
            await self._listen_for(client, beat_s, lambda: self.twin is not None)
        if self.twin is not None:
            error = NameTaken(
                f"another gateway named '{self._topics.gateway}' publishes at "
                f"{where} (instance {self.twin}): give one of them another name "
                "(gateway: …), or stop it"
            )
            assert self._taken is not None
            self._taken.set_exception(error)
            raise error

    async def _listen_for(
        self, client: aiomqtt.Client, seconds: float, is_enough: Callable[[], bool]
    ) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                async for message in client.messages:
                    self.take(message)
                    if is_enough():
                        return

    def take(self, message: aiomqtt.Message) -> bool:
        """Take a message; return whether our own state and info must be published anew."""
        payload = message.payload if isinstance(message.payload, bytes) else b""
        return self._twins.take(message.topic.value, payload, is_retained=message.retain)
