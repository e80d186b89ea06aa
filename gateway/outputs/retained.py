"""Retained messages: the newest of each topic, sent beside the poses and never in their way."""

from __future__ import annotations

import asyncio
import itertools

import aiomqtt
from paho.mqtt.properties import Properties

_TOGETHER = 10
"""Messages whose acknowledgements are waited for at once, so that a distant broker does not take long."""


class RetainedMessages:
    """Keeps what stands on the broker's retained topics up to date. Belongs to one event loop.

    A message replaced before it was sent is never sent: a slow broker costs no memory. ``begin_again``
    has all of them sent anew, for a broker that may have forgotten.
    """

    def __init__(self, properties: Properties | None = None) -> None:
        """properties: of every message (MQTT 5)."""
        self._properties = properties
        self._newest: dict[str, bytes] = {}
        self._unsent: dict[str, None] = {}  # in order of keeping
        self._wake = asyncio.Event()

    def keep(self, topic: str, payload: bytes) -> None:
        """Have a message published with QoS 1 and retained. Never waits."""
        self._newest[topic] = payload
        self._unsent[topic] = None
        self._wake.set()

    def begin_again(self) -> None:
        """Nothing has been sent yet, on this connection."""
        self._unsent = dict.fromkeys(self._newest)

    async def publish(self, client: aiomqtt.Client) -> None:
        """Send what is not sent yet. Raises ``aiomqtt.MqttError``; what was not sent stays to be sent."""
        while self._unsent:
            together = list(itertools.islice(self._unsent, _TOGETHER))
            await asyncio.gather(*(self._send(client, topic) for topic in together))

    async def _send(self, client: aiomqtt.Client, topic: str) -> None:
        payload = self._newest[topic]
        await client.publish(topic, payload, qos=1, retain=True, properties=self._properties)
        if self._newest[topic] is payload:
            self._unsent.pop(topic, None)

    async def publish_for_ever(self, client: aiomqtt.Client) -> None:
        """Send whatever is kept from now on. Raises ``aiomqtt.MqttError``."""
        while True:
            self._wake.clear()
            await self.publish(client)
            await self._wake.wait()
