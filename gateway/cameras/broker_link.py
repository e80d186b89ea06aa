"""Heat maps of cameras over MQTT as a link.

One message on a topic is one picture's heat-map messages (``devices.cameras.heat_map_messages``), at QoS 0:
an old picture is worth nothing. Orders (``devices.cameras.orders``) go to ``ORDERS`` below each camera's
topic. The link uses the broker of the gateway's own settings, and so its credentials.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from urllib.parse import unquote, urlsplit

import aiomqtt

from devices.cameras.heat_map_messages import camera_of
from devices.endpoints import EndpointError, link_from_url
from devices.link import Chunk, Framing, Link, LinkError, gateway_time_ns
from devices.links.arrivals import Arrivals
from devices.links.link_counts import LinkCounts
from gateway.contract.topics import CAMERA
from gateway.outputs.connection import broker_connection, end_tasks, explain, unique_identifier
from gateway.outputs.settings import MqttSettings
from gateway.sources.link_settings import LinkSettings

SCHEME = "mqtt"
ORDERS = "orders"
"""Below a camera's topic."""
_MOST_CAMERAS = 64


def link_of(link: LinkSettings, mqtt: MqttSettings, port: Callable[[], int]) -> Link:
    """Return the link, not yet open, of a configuration. port: of the broker, once it is known. Raises
    ``EndpointError``, which names the link and its setting."""
    try:
        return _link_of(link, mqtt, port)
    except (EndpointError, ValueError) as error:
        raise EndpointError(f"link '{link.name}': url: {error}") from None


def _link_of(link: LinkSettings, mqtt: MqttSettings, port: Callable[[], int]) -> Link:
    parts = urlsplit(link.url)
    if parts.scheme != SCHEME:
        return link_from_url(link.url, name=link.name)
    topic = unquote(parts.path).removeprefix("/")
    if parts.netloc or not topic or parts.query:
        raise EndpointError(
            f"{link.url}: the broker is that of the section 'mqtt': write {SCHEME}:///TOPIC, such as "
            f"{SCHEME}:///{CAMERA.format(camera='cam01')}"
        )
    return BrokerLink(topic, mqtt, port, link.name)


class BrokerLink:
    """The heat maps on one topic, or on all that a filter such as ``mocap_cameras/+`` takes in."""

    framing = Framing.BYTE_STREAM

    def __init__(self, topic: str, settings: MqttSettings, port: Callable[[], int], name: str) -> None:
        self.name = name
        self.counts = LinkCounts()
        self.topic = topic
        """Or filter."""
        self._settings = settings
        self._port = port
        self._arrivals = Arrivals.never_opened(name)
        self._task: asyncio.Task[None] | None = None
        self._client: aiomqtt.Client | None = None
        self._topics: set[str] = set()
        """Of the cameras that were heard."""

    async def open(self) -> None:
        """Connect and subscribe. Raises ``LinkError`` with what is wrong with the broker."""
        self._arrivals = Arrivals(self.name, counts=self.counts)
        subscribed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._task = asyncio.create_task(self._receive(self._arrivals, subscribed), name=f"link {self.name}")
        await asyncio.wait({self._task, subscribed}, return_when=asyncio.FIRST_COMPLETED)
        if self._arrivals.error is not None:
            raise self._arrivals.error

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Tell the cameras that were heard where people will be. Raises ``LinkError`` while there is no
        broker."""
        if self._client is None:
            raise LinkError(f"{self.name}: there is no broker")
        try:
            for topic in sorted(self._topics)[:_MOST_CAMERAS]:
                await self._client.publish(f"{topic}/{ORDERS}", data, qos=0)
        except aiomqtt.MqttError as error:
            raise LinkError(f"{self.name}: {error}") from error

    async def close(self) -> None:
        """Disconnect; iterating ends."""
        self._arrivals.end()
        if self._task is not None:
            await end_tasks(self._task)
            self._task = None

    async def _receive(self, arrivals: Arrivals, subscribed: asyncio.Future[None]) -> None:
        port = self._port()
        try:
            async with broker_connection(self._settings, port, unique_identifier("cameras")) as client:
                await client.subscribe(self.topic, 0)
                self._client = client
                subscribed.set_result(None)
                async for message in client.messages:
                    self._take(arrivals, message)
        except Exception as error:
            arrivals.end(LinkError(explain(error, self._settings, port)))
        finally:
            self._client = None

    def _take(self, arrivals: Arrivals, message: aiomqtt.Message) -> None:
        """Pass on what is a picture of now: a retained one is not, and brokers may send other topics too."""
        payload = message.payload
        if not isinstance(payload, bytes) or message.retain or not message.topic.matches(self.topic):
            return
        if camera_of(payload) is not None:  # or it would take bytes of the next camera's along
            self._topics.add(message.topic.value)
            arrivals.put(payload, gateway_time_ns())
