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
from gateway.outputs.connection import end_tasks
from gateway.outputs.pose_order import PoseOrder
from gateway.outputs.receiving import Receiver
from gateway.outputs.settings import MqttSettings

logger = logging.getLogger(__name__)

_LONGEST_BACKLOG = 256
"""Poses kept for a reader that is slower than the stream; then the oldest is dropped."""


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
    for ever, at another node of a cluster where there is one. One reader iterates; what it does not take in
    time is dropped, oldest first. Messages are input from outside: what does not decode is counted, never
    raised.
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
        self.undecodable = 0
        """Messages that were not what their topic promises."""
        self.dropped = 0
        """Poses that the reader did not take in time."""
        self.overtaken = 0
        """Poses that came when a newer one of their gateway had come: left out."""
        self._with_markers = with_markers
        self._settings = settings
        self._topics = Topics(settings.base_topic, gateway)
        self._kept = (self._topics.bridge_state, self._topics.bridge_info, self._topics.body)
        self._passing = [self._topics.bridge_health, self._topics.pose]
        if with_markers:
            self._passing.append(self._topics.markers)
        self._backlog: deque[ReceivedPose] = deque()
        self._orders: dict[str, PoseOrder] = {}
        self._arrival = asyncio.Event()
        self._receiver: Receiver | None = None
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        receiver = self._receiver = Receiver(
            self._settings, "subscriber", self._passing, self._kept, self._read
        )
        self._task = asyncio.create_task(receiver.run(), name="pose subscriber")
        waiting = asyncio.ensure_future(receiver.subscribed.wait())
        try:
            await asyncio.wait({self._task, waiting}, return_when=asyncio.FIRST_COMPLETED)
            waiting.cancel()
            if self._task.done():
                self._task.result()
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._end()

    @property
    def is_connected(self) -> bool:
        """Whether there is a broker at the moment."""
        return self._receiver is not None and self._receiver.is_connected

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
                if not self._orders.setdefault(gateway, PoseOrder()).is_new(pose.seq, pose.t_ns):
                    self.overtaken += 1
                    return
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
                self.infos[gateway] = info = BridgeInfo.model_validate_json(payload)
                self._orders.setdefault(gateway, PoseOrder()).note_instance(info.instance)
            case topics.BRIDGE_HEALTH:
                self.healths[gateway] = BridgeHealth.model_validate_json(payload)
            case topics.BODY:
                self.bodies[gateway] = BodyMessage.model_validate_json(payload)
