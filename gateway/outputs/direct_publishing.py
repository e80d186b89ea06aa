"""Messages of QoS 0 from the gateway to the broker's socket, past the bookkeeping of the client.

For each message the client takes locks, makes a future and two objects of properties, and wakes the event
loop twice; that costs several times the writing. What the system does not take at once is put at the end of
the client's own queue, so that the order holds and nothing blocks.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import aiomqtt
from paho.mqtt.client import MQTTMessageInfo
from paho.mqtt.enums import MessageType
from paho.mqtt.properties import Properties

from gateway.outputs.pose_encoding import Outgoing

_PUBLISH = 0x30
"""First byte of a message of QoS 0 that is not retained."""


class DirectPublisher:
    """Publishes on one connection. The properties of a topic are those of its first message."""

    def __init__(self, client: aiomqtt.Client, *, has_properties: bool) -> None:
        """has_properties: the connection speaks MQTT 5."""
        self._client = client
        self._paho = client._client
        self._has_properties = has_properties
        self._heads: dict[str, bytes] = {}
        self._rest: _Rest | None = None

    @property
    def is_free(self) -> bool:
        """Whether the system has taken all that was published so far."""
        return not self._paho.want_write()

    def publish(self, messages: Sequence[Outgoing]) -> bool:
        """Hand messages to the system in one piece; whether it took all of it. Never waits.

        What it did not take goes out when it can: see ``drained``. Raises ``aiomqtt.MqttError`` where the
        connection is lost.
        """
        data = b"".join(map(self._packet, messages))
        sent = 0
        if self.is_free:
            try:
                sent = self._paho._sock_send(data)
            except BlockingIOError:
                sent = 0  # the socket takes nothing now: all of it waits below
            except OSError as error:
                raise aiomqtt.MqttError(f"the connection was lost: {error}") from error
        if sent == len(data):
            return True
        self._rest = _Rest(self._paho._mid_generate())
        self._paho._packet_queue(MessageType.PUBLISH, data[sent:], self._rest.mid, 0, self._rest)
        return False

    async def drained(self) -> bool:
        """Wait until the system has taken all that was published here, and return True.

        Raises ``aiomqtt.MqttError`` where that takes longer than the client's time-out.
        """
        if self._rest is not None:
            try:
                async with asyncio.timeout(self._client.timeout):
                    await self._rest.is_sent.wait()
            except TimeoutError:
                raise aiomqtt.MqttError("the broker does not read") from None
            self._rest = None
        return True

    def _packet(self, message: Outgoing) -> bytes:
        topic, payload, properties = message
        head = self._heads.get(topic)
        if head is None:
            head = self._heads[topic] = self._head(topic, properties)
        return b"".join((_PUBLISH.to_bytes(), _variable_length(len(head) + len(payload)), head, payload))

    def _head(self, topic: str, properties: Properties | None) -> bytes:
        """Return all between length and payload."""
        name = topic.encode()
        head = len(name).to_bytes(2) + name
        if not self._has_properties:
            return head
        return head + (b"\0" if properties is None else properties.pack())  # type: ignore[no-untyped-call]


class _Rest(MQTTMessageInfo):
    """What the client holds of messages that the system did not take at once."""

    def __init__(self, mid: int) -> None:
        super().__init__(mid)
        self.is_sent = asyncio.Event()

    def _set_as_published(self) -> None:
        super()._set_as_published()
        self.is_sent.set()


def _variable_length(length: int) -> bytes:
    """Encode a remaining length: seven bits a byte, the lowest first (MQTT 3.1.1, section 2.2.3)."""
    encoded = bytearray()
    while length > 0x7F:
        encoded.append(length & 0x7F | 0x80)
        length >>= 7
    encoded.append(length)
    return bytes(encoded)
