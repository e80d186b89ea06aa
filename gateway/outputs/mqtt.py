"""Skeleton frames to an MQTT broker.

``offer`` puts a frame into a short queue and returns. One task encodes and publishes; it outlives
every broker: it reconnects for ever, and counts what had to be dropped meanwhile.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Self

import aiomqtt
from aiomqtt.exceptions import MqttConnectError
from pydantic import TypeAdapter

from devices.link import gateway_time_ns
from gateway.body.skeleton import Skeleton
from gateway.frames import SkeletonFrame
from gateway.outputs.broker_process import BrokerProcess
from gateway.outputs.connection import (
    Backoff,
    broker_connection,
    end_tasks,
    explain,
    first_to_end,
    nap,
    unique_identifier,
    until_lost,
)
from gateway.outputs.home_assistant import discovery
from gateway.outputs.messages import (
    AccountBalance,
    BridgeHealth,
    BridgeInfo,
    BridgeState,
    Message,
    OutputCounters,
    UtcAnchor,
    describe_body,
    plain_json,
)
from gateway.outputs.pose_publications import PosePublications
from gateway.outputs.properties import JSON, properties_of
from gateway.outputs.retained import RetainedMessages
from gateway.outputs.settings import MqttSettings
from gateway.outputs.thinning import Thinning
from gateway.outputs.topics import BRIDGE_INFO, Topics

logger = logging.getLogger(__name__)

_ONLINE = BridgeState(state="online").payload()
_OFFLINE = BridgeState(state="offline").payload()

_FAREWELL_S = 1.5
"""Longest time to publish what is queued, say offline and disconnect."""
_DRAIN_S = 0.5
"""Part of it for the queue."""


class MqttOutput:
    """Publishes frames of one skeleton; an ``Output``. Belongs to one event loop.

    info: published on ``bridge/info``; its gateway name is the second level of the topics.
    others: counters of other outputs, to go with them.
    health: called for every ``bridge/health`` message, for the statistics to go with it.
    markers: names of the markers that the body has.
    Raises ``ValueError`` for a gateway name that cannot stand in a topic.
    """

    def __init__(
        self,
        settings: MqttSettings,
        skeleton: Skeleton,
        info: BridgeInfo,
        health: Callable[[], Mapping[str, object]] = dict,
        others: Callable[[], Mapping[str, OutputCounters]] = dict,
        markers: tuple[str, ...] = (),
    ) -> None:
        self.topics = Topics(settings.base_topic, info.gateway)
        self.is_connected = False
        self.port = settings.port
        """Port of the broker; with port 0 in the settings, the one that was found free."""
        self._settings = settings
        self._identifier = settings.client_id or unique_identifier(info.gateway)
        self._publications = PosePublications(settings, skeleton, self.topics, markers)
        self._properties = properties_of(settings.spoken_protocol, JSON)
        self._info = info
        self._utc: UtcAnchor | None = None
        self._retained = RetainedMessages(self._properties)
        self._retained.keep(self.topics.bridge_info, info.payload())
        self._retained.keep(self.topics.body, describe_body(skeleton).payload())
        self._retained.keep(self.topics.bridge_state, _ONLINE)
        if settings.home_assistant is not None:
            for topic, payload in discovery(settings.home_assistant, self.topics, info):
                self._retained.keep(topic, payload)
        self._health = health
        self._others = others
        self._health_due = 0.0
        self._thinning = Thinning(settings.pose_rate)
        self._relief = Thinning(None)
        self._queue: deque[SkeletonFrame] = deque()
        self._published = self._dropped = self._thinned = self._connections = 0
        self._in_hand = 0  # 1 while a pose is on its way to the broker
        self._complaints: set[str] = set()
        self._wake = asyncio.Event()
        self._stopping = asyncio.Event()
        self._broker: BrokerProcess | None = None
        self._task: asyncio.Task[None] | None = None
        self._started = time.monotonic()

    @property
    def counters(self) -> OutputCounters:
        """What became of the offered poses so far."""
        return OutputCounters(
            published=self._published,
            dropped=self._dropped,
            thinned=self._thinned,
            queued=len(self._queue) + self._in_hand,
            connections=self._connections,
        )

    @property
    def is_running(self) -> bool:
        """Whether its task lives, broker or not."""
        return self._task is not None and not self._task.done()

    def offer(self, frame: SkeletonFrame) -> None:
        """Take a frame for publishing. Never waits; the oldest queued frame gives way when full."""
        if not (self._thinning.admits(frame.time_ns) and self._relief.admits(frame.time_ns)):
            self._thinned += 1
            return
        if len(self._queue) == self._settings.queue_length:
            self._queue.popleft()
            self._dropped += 1
        self._queue.append(frame)
        self._wake.set()

    def relieve(self, poses_hz: float | None, *, has_segments: bool) -> None:
        """Publish less for a while: at most so many poses a second (None: as configured), and no single
        segments. What is not published counts as thinned."""
        self._relief = Thinning(poses_hz)
        self._publications.has_segments = has_segments

    def keep(self, topic: str, message: Message) -> None:
        """Have a message published below the gateway's topics, retained, again after every reconnection."""
        self._retained.keep(f"{self.topics.root}/{topic}", message.payload())

    def anchor(self, utc: UtcAnchor, *, is_step: bool) -> None:
        """Tell how gateway time stands to UTC: in every health message, and in ``bridge/info`` for a step."""
        self._utc = utc
        if is_step or self._info.utc is None:
            self._info = self._info.model_copy(update={"utc": utc})
            self.keep(BRIDGE_INFO, self._info)

    @property
    def info(self) -> BridgeInfo:
        """As it stands on ``bridge/info``."""
        return self._info

    def health(self) -> BridgeHealth:
        """As it would be published now."""
        statistics = plain_json(self._health())
        accounting = TypeAdapter(dict[str, AccountBalance]).validate_python(statistics.pop("accounting", {}))
        return BridgeHealth(
            t_ns=gateway_time_ns(),
            uptime_s=time.monotonic() - self._started,
            mqtt=self.counters,
            outputs=dict(self._others()),
            utc=self._utc,
            accounting=accounting,
            statistics=statistics,
        )

    async def start(self) -> None:
        """Begin to publish; returns before the broker is reached.

        Raises ``EmbeddedBrokerError`` when the embedded broker is asked for and cannot start.
        """
        if self._settings.broker == "embedded":
            self._broker = BrokerProcess(self._settings.port, self._settings.websocket_port)
            await self._broker.start()
            self.port = self._broker.port
        self._started = time.monotonic()
        self._task = asyncio.create_task(self._run(), name="mqtt output")

    async def stop(self) -> None:
        """Publish what is queued, say offline and disconnect: within 2 s, broker or not."""
        self._stopping.set()
        self._wake.set()
        if self._task is not None:
            if self.is_connected:
                await asyncio.wait({self._task}, timeout=_FAREWELL_S)
            await end_tasks(self._task)
            self._task = None
        if self._broker is not None:
            await self._broker.stop()
            self._broker = None

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()

    async def _run(self) -> None:
        """Connect and publish, for ever: nothing that goes wrong with a broker ends the output."""
        backoff, waited = Backoff(), 0.0
        will = aiomqtt.Will(self.topics.bridge_state, _OFFLINE, qos=1, retain=True)
        while not self._stopping.is_set():
            try:
                async with broker_connection(self._settings, self.port, self._identifier, will) as client:
                    waited = 0.0
                    # A publication may go on waiting for a connection that is lost already.
                    await first_to_end(until_lost(client), self._serve(client))
            except Exception as error:
                self._report_outage(error)
            self.is_connected = False
            waited = backoff.after(waited)
            await nap(waited, self._stopping)

    async def _serve(self, client: aiomqtt.Client) -> None:
        """Announce the gateway, then publish until stopped."""
        await self._announce(client)
        await first_to_end(self._retained.publish_for_ever(client), self._publish_poses(client))
        await self._farewell(client)

    async def _publish_poses(self, client: aiomqtt.Client) -> None:
        """And health, until stopped."""
        while not self._stopping.is_set():
            self._wake.clear()
            await self._publish_waiting(client)
            await nap(max(self._health_due - time.monotonic(), 0.0), self._wake)

    async def _announce(self, client: aiomqtt.Client) -> None:
        self._retained.begin_again()
        await self._retained.publish(client)
        # Poses from before the connection are of no use to anybody, but for the last one.
        while len(self._queue) > 1:
            self._queue.popleft()
            self._dropped += 1
        self._connections += 1
        self.is_connected = True
        self._complaints.clear()
        again = "connected" if self._connections == 1 else "connected again"
        where = f"{self._settings.host}:{self.port}"
        logger.info("%s to the MQTT broker at %s, publishing on %s", again, where, self.topics.root)

    async def _publish_waiting(self, client: aiomqtt.Client) -> None:
        if time.monotonic() >= self._health_due:
            self._health_due = time.monotonic() + self._settings.health_interval
            await self._publish_health(client)
            if self._broker is not None:
                # A client that subscribes to the embedded broker just while the birth message is on its
                # way has been seen to miss it.
                await client.publish(self.topics.bridge_state, _ONLINE, qos=1, retain=True)
        while self._queue:
            await self._publish_pose(client, self._queue.popleft())

    async def _publish_pose(self, client: aiomqtt.Client, frame: SkeletonFrame) -> None:
        try:
            outgoing = list(self._publications.of(frame))
        except Exception as error:
            self._dropped += 1
            self._complain("pose", f"a pose cannot be encoded ({error!r}): it is dropped")
            return
        self._in_hand = 1
        try:
            for topic, payload, properties in outgoing:
                await client.publish(topic, payload, properties=properties)
        except BaseException:
            self._dropped += 1
            raise
        else:
            self._published += 1
        finally:
            self._in_hand = 0

    async def _publish_health(self, client: aiomqtt.Client) -> None:
        try:
            health = self.health()
        except Exception as error:
            self._complain("statistics", f"the statistics cannot be published ({error!r})")
            return
        await client.publish(self.topics.bridge_health, health.payload(), properties=self._properties)

    async def _farewell(self, client: aiomqtt.Client) -> None:
        try:
            async with asyncio.timeout(_DRAIN_S):
                await self._retained.publish(client)
                await self._publish_waiting(client)
        except TimeoutError:
            logger.debug("%d poses were still queued at the end", len(self._queue))
        await client.publish(self.topics.bridge_state, _OFFLINE, qos=1, retain=True)

    def _report_outage(self, error: Exception) -> None:
        """One warning for a broker that is away, one more if it then refuses us."""
        if self.is_connected:
            where = f"{self._settings.host}:{self.port}"
            reason = error.__cause__ or error  # aiomqtt's own says only that it was lost
            self._complain("away", f"lost the MQTT broker at {where} ({reason}): trying to get it back")
        else:
            kind = "refusing" if isinstance(error, MqttConnectError) else "away"
            self._complain(kind, explain(error, self._settings, self.port))

    def _complain(self, kind: str, complaint: str) -> None:
        """A warning, once a kind until the next connection."""
        if kind not in self._complaints:
            self._complaints.add(kind)
            logger.warning("%s", complaint)
