"""The other side of the broker: poses as they arrive, decoded and stamped.

::

    async with PoseSubscriber(settings) as poses:
        async for received in poses:
            print(received.gateway, received.pose.segments, received.latency_s)
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncIterator
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self

import aiomqtt
from pydantic import ValidationError

from devices.link import gateway_time_ns
from gateway.contract import topics
from gateway.contract.messages import (
    BodyMessage,
    BridgeHealth,
    BridgeInfo,
    BridgeState,
    MarkersMessage,
    PoseMessage,
)
from gateway.contract.topics import ANY_GATEWAY, Topics
from gateway.errors import GatewayError
from gateway.outputs.connection import (
    broker_back_off,
    broker_connection,
    end_tasks,
    explain,
    first_to_end,
    unique_identifier,
)
from gateway.outputs.failover import ClusterConnection, follow_kept
from gateway.outputs.settings import MqttSettings

logger = logging.getLogger(__name__)

_LONGEST_BACKLOG = 256
"""Poses kept for a reader that is slower than the stream; then the oldest is dropped."""


class BrokerUnreachableError(GatewayError, ConnectionError):
    """No broker there, or it refuses us. ``str(error)`` says which and what would do."""


@dataclass(frozen=True, slots=True)
class ReceivedPose:
    """A pose with when and from where it came."""

    gateway: str
    received_ns: int
    """Gateway time of arrival here, ns: comparable with ``t_ns`` on the gateway's machine only."""
    pose: PoseMessage
    payload: bytes
    """The message as it was published."""

    @property
    def latency_s(self) -> float:
        """From the instant of the pose to its arrival here, s."""
        return (self.received_ns - self.pose.t_ns) * 1e-9


class PoseSubscriber:
    """Receives the poses of one gateway, or of all below the base topic.

    Connects on entering, which raises ``BrokerUnreachableError``; a connection lost later is made again
    for ever. One reader iterates; what it does not take in time is dropped, oldest first.
    Messages are input from outside: what does not decode is counted, never raised.
    """

    def __init__(
        self, settings: MqttSettings, gateway: str = ANY_GATEWAY, *, with_markers: bool = False
    ) -> None:
        """with_markers: what became of markers is received too."""
        self.states: dict[str, Literal["online", "offline"]] = {}
        """Last known state of each gateway."""
        self.infos: dict[str, BridgeInfo] = {}
        self.bodies: dict[str, BodyMessage] = {}
        self.healths: dict[str, BridgeHealth] = {}
        self.markers: dict[str, MarkersMessage] = {}
        """The last of each gateway."""
        self.is_connected = False
        self.undecodable = 0
        """Messages that were not what their topic promises."""
        self.dropped = 0
        """Poses that the reader did not take in time."""
        self._with_markers = with_markers
        self._settings = settings
        self._topics = Topics(settings.base_topic, gateway)
        self._kept = (self._topics.bridge_state, self._topics.bridge_info, self._topics.body)
        self._passing = [self._topics.bridge_health, self._topics.pose]
        if with_markers:
            self._passing.append(self._topics.markers)
        self._backlog: deque[ReceivedPose] = deque()
        self._arrival = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        subscribed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._task = asyncio.create_task(self._receive_for_ever(subscribed), name="pose subscriber")
        try:
            await asyncio.wait({self._task, subscribed}, return_when=asyncio.FIRST_COMPLETED)
            if not subscribed.done():
                self._task.result()
            subscribed.result()
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._end()

    async def __aiter__(self) -> AsyncIterator[ReceivedPose]:
        while True:
            while self._backlog:
                yield self._backlog.popleft()
            self._arrival.clear()
            await self._arrival.wait()

    async def _end(self) -> None:
        if self._task is not None:
            await end_tasks(self._task)
            self._task = None

    async def _receive_for_ever(self, subscribed: asyncio.Future[None]) -> None:
        if self._settings.failover:
            await self._receive_from_cluster(subscribed)
            return
        back_off = broker_back_off()
        port = self._settings.port
        while True:
            try:
                # Not the client_id of the settings: that is the gateway's own.
                identifier = unique_identifier("subscriber")
                async with broker_connection(self._settings, port, identifier) as client:
                    await self._subscribe(client)
                    back_off.reset()
                    if not subscribed.done():
                        subscribed.set_result(None)
                    await self._receive(client)
            except Exception as error:
                reason = explain(error, self._settings, port)
                if not subscribed.done():
                    subscribed.set_exception(BrokerUnreachableError(reason))
                    return
                if self.is_connected:
                    logger.warning("%s; trying again", reason)
            self.is_connected = False
            await asyncio.sleep(back_off.next_delay())

    async def _receive_from_cluster(self, subscribed: asyncio.Future[None]) -> None:
        connection = ClusterConnection(self._settings, self._settings.port, "subscriber")
        refused = 0

        async def use(client: aiomqtt.Client) -> None:
            await client.subscribe([(topic, 0) for topic in self._passing])
            self.is_connected = True
            if not subscribed.done():
                subscribed.set_result(None)
            await self._receive(client)

        def lost(error: Exception) -> None:
            nonlocal refused
            refused += 1
            settings = connection.settings
            reason = explain(error, settings, settings.port)
            if not subscribed.done() and refused > len(self._settings.failover):
                subscribed.set_exception(BrokerUnreachableError(reason))
            elif self.is_connected:
                logger.warning("%s; going on with another node", reason)
            self.is_connected = False

        await first_to_end(
            connection.run(use, None, lost, asyncio.Event()),
            follow_kept(self._settings, "subscriber", self._kept, self._read),
        )

    async def _subscribe(self, client: aiomqtt.Client) -> None:
        await client.subscribe([(topic, 1) for topic in self._kept] + [(topic, 0) for topic in self._passing])
        self.is_connected = True

    async def _receive(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            self._read(message)
            # aiomqtt takes several turns of the event loop for each message, and a burst comes faster.
            while not client._queue.empty():
                self._read(client._queue.get_nowait())
                if len(self._backlog) == _LONGEST_BACKLOG:
                    await asyncio.sleep(0)  # let the reader take them

    def _read(self, message: aiomqtt.Message) -> None:
        arrived_ns = gateway_time_ns()
        # Some brokers send what was not asked for: see ``embedded_broker``.
        address = self._topics.split(message.topic.value)
        if address is None or not isinstance(message.payload, bytes):
            return
        try:
            self._take(*address, message, message.payload, arrived_ns)
        except ValidationError as error:
            self.undecodable += 1
            logger.debug("%s: %s", message.topic, error)

    def _take(
        self, gateway: str, topic: str, message: aiomqtt.Message, payload: bytes, arrived_ns: int
    ) -> None:
        if not payload and topic in {topics.BRIDGE_STATE, topics.BRIDGE_INFO, topics.BODY}:
            for known in (self.states, self.infos, self.bodies, self.healths, self.markers):
                known.pop(gateway, None)  # taken off the broker
            return
        match topic:
            case topics.POSE if not message.retain:
                pose = PoseMessage.model_validate_json(payload)
                if len(self._backlog) == _LONGEST_BACKLOG:
                    self._backlog.popleft()
                    self.dropped += 1
                self._backlog.append(ReceivedPose(gateway, arrived_ns, pose, payload))
                self._arrival.set()
            case topics.MARKERS if self._with_markers:
                self.markers[gateway] = MarkersMessage.model_validate_json(payload)
            case topics.BRIDGE_STATE:
                self.states[gateway] = BridgeState.model_validate_json(payload).state
            case topics.BRIDGE_INFO:
                self.infos[gateway] = BridgeInfo.model_validate_json(payload)
            case topics.BRIDGE_HEALTH:
                self.healths[gateway] = BridgeHealth.model_validate_json(payload)
            case topics.BODY:
                self.bodies[gateway] = BodyMessage.model_validate_json(payload)
