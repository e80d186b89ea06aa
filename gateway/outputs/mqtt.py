"""Skeleton frames to an MQTT broker: the connections, and what a gateway publishes beside its poses.

One task outlives every broker: it connects, again for ever, announces the gateway, gives the connection to
the poses (``PoseOutlet``), publishes health, and says goodbye.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import Callable, Coroutine, Mapping
from contextlib import AbstractAsyncContextManager
from types import TracebackType
from typing import Any, Self

import aiomqtt
from aiomqtt.exceptions import MqttConnectError
from pydantic import TypeAdapter

from devices.link import gateway_time_ns
from gateway.body.skeleton import Skeleton
from gateway.contract.messages import (
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
from gateway.contract.properties import JSON, properties_of
from gateway.contract.topics import BRIDGE_INFO, Topics
from gateway.frames import SkeletonFrame
from gateway.outputs.broker_process import BrokerProcess
from gateway.outputs.connection import (
    TIMEOUT_S,
    broker_connection,
    check_admittance,
    check_files,
    end_tasks,
    explain,
    first_to_end,
    nap,
    reason_of,
    unique_identifier,
)
from gateway.outputs.direct_publishing import DirectPublisher
from gateway.outputs.failover import (
    BrokerTurns,
    ClusterConnection,
    Companions,
    keep_asking,
    keep_connected,
)
from gateway.outputs.home_assistant import discovery
from gateway.outputs.late_poses import LateOutlet
from gateway.outputs.own_topics import PublishRights
from gateway.outputs.pose_encoding import PosePublications
from gateway.outputs.pose_outlet import PoseOutlet
from gateway.outputs.queues import RetainedMessages
from gateway.outputs.same_name import NameGuard, NameTaken
from gateway.outputs.settings import MqttSettings

logger = logging.getLogger(__name__)

_ONLINE = BridgeState(state="online").payload()
_OFFLINE = BridgeState(state="offline").payload()

_FAREWELL_S = 1.5
"""Longest time to publish what is queued, say offline and disconnect."""
_ELECTION_S = 12.0
"""Longest wait for a cluster that has lost its leader. A connection that is given up before it was let in
leaves a will behind: the broker then says offline of a gateway that is there."""
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
        self.leaves_nothing = False
        """Whether what is retained is taken off the broker at the end."""
        self.port = settings.port
        """Port of the broker; with port 0 in the settings, the one that was found free."""
        self._settings = settings
        self._identifier = settings.client_id or unique_identifier(info.gateway)
        self._properties = properties_of(settings.protocol_in_use, JSON)
        self.instance = secrets.token_hex(8)
        """Another one for every output that is made: tells gateways of one name apart."""
        self.rights = PublishRights(are_reported=settings.protocol_in_use == "5")
        self._name = NameGuard(settings, self.topics, self.instance)
        self._info = info = info.model_copy(update={"instance": self.instance})
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
        publications = PosePublications(settings, skeleton, self.topics, markers)
        self._poses = PoseOutlet(settings, publications, self.rights, self._properties)
        self._turns = BrokerTurns(settings, settings.port)
        self._cluster: ClusterConnection | None = None  # where there is a cluster
        self._is_announced = asyncio.Event()
        self._complaints: set[str] = set()
        self._stopping = asyncio.Event()
        self._broker: BrokerProcess | None = None
        self._successor: MqttOutput | None = None
        self._task: asyncio.Task[None] | None = None
        self._started = time.monotonic()

    @property
    def counters(self) -> OutputCounters:
        """What became of the offered poses so far."""
        return self._poses.counters

    @property
    def is_connected(self) -> bool:
        """Whether a broker takes poses."""
        return self._poses.is_connected

    @property
    def is_running(self) -> bool:
        """Whether its task lives, broker or not."""
        return self._task is not None and not self._task.done()

    @property
    def twin(self) -> str | None:
        """Instance of another gateway of the same name that was heard lately."""
        return self._name.twin

    async def until_name_is_taken(self) -> None:
        """Wait for ever, unless another gateway has the name and the settings say ``refuse``.

        Raises ``OutputError`` then.
        """
        await self._name.until_taken()

    def offer(self, frame: SkeletonFrame) -> None:
        """Take a frame for publishing. Never waits; where too many wait the oldest gives way."""
        self._poses.offer(frame)

    def relieve(self, poses_hz: float | None, *, has_segments: bool) -> None:
        """Publish less for a while: see ``PoseOutlet``."""
        self._poses.relieve(poses_hz, has_segments=has_segments)

    def publish_beside(self, topic: str, payload: bytes) -> bool:
        """Publish a message beside the poses, below the gateway's topics, if the broker's socket takes it at
        once; whether it does. Nothing is kept."""
        return self._poses.publish_beside(f"{self.topics.root}/{topic}", payload)

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
        """Return the health message as it would be published now."""
        statistics = plain_json(self._health())
        accounting = TypeAdapter(dict[str, AccountBalance]).validate_python(statistics.pop("accounting", {}))
        return BridgeHealth(
            t_ns=gateway_time_ns(),
            instance=self.instance,
            uptime_s=time.monotonic() - self._started,
            mqtt=self.counters,
            publishing=self.rights.state,
            refused_topics=tuple(self.rights.refused),
            same_name=self.twin,
            outputs=dict(self._others()),
            utc=self._utc,
            accounting=accounting,
            statistics=statistics,
        )

    async def prepare(self, former: MqttOutput | None = None) -> None:
        """Do all that can fail before publishing begins: start an embedded broker, read files, see whether
        an external broker lets us in.

        former: the output that this one is to follow. An embedded broker that suits both goes on, and is
        handed over when the former stops. Raises ``OutputError`` or ``CredentialError``.
        """
        settings = self._settings
        check_files(settings)
        if settings.broker == "embedded":
            await self._prepare_broker(former)
        elif former is not None and settings.door != former._settings.door:
            await check_admittance(settings, self.port)

    async def _prepare_broker(self, former: MqttOutput | None) -> None:
        wanted = _broker_of(self._settings)
        running = None if former is None else former._broker
        if former is not None and running is not None and wanted.asked == running.asked:
            former._successor = self
            return
        held = set() if running is None else {running.port, running.websocket_port} - {None}
        if not held & {wanted.port, wanted.websocket_port}:  # or they are free only once the former has ended
            await wanted.start()
            self._broker = wanted

    async def release(self, former: MqttOutput | None = None) -> None:
        """Undo ``prepare`` of an output that is not to start after all."""
        if former is not None and former._successor is self:
            former._successor = None
        await self._end_broker()

    async def start(self) -> None:
        """Begin to publish; returns before the broker is reached.

        Raises ``EmbeddedBrokerError`` when the embedded broker is asked for and cannot start, ``OutputError``
        when late poses cannot be kept.
        """
        if self._settings.broker == "embedded":
            if self._broker is None:
                self._broker = _broker_of(self._settings)
                await self._broker.start()
            self.port = self._broker.port
        if self._settings.late is not None:
            late = LateOutlet(self._settings.late, self.topics, self.instance, self._properties)
            self._poses.keep_late_in(late)
        self._turns = BrokerTurns(self._settings, self.port)
        self._started = time.monotonic()
        self._name.begin()
        self._task = asyncio.create_task(self._run(), name="mqtt output")

    async def stop(self) -> None:
        """Publish what is queued, say offline and disconnect: within 2 s, broker or not."""
        self._stopping.set()
        self._poses.wake.set()
        if self._task is not None:
            if self.is_connected:
                await asyncio.wait({self._task}, timeout=_FAREWELL_S)
            if not self._task.done():
                self._poses.keep_unsent()
            await end_tasks(self._task)
            self._task = None
        self._poses.close()
        if self._successor is not None:
            self._successor._broker, self._broker = self._broker, None
        await self._end_broker()

    async def _end_broker(self) -> None:
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
        if not self._settings.failover:
            await self._run_main()
            return
        self._cluster = ClusterConnection(
            self._settings,
            self.port,
            self._info.gateway,
            self.topics.bridge_echo,
            on_answer=self.rights.answered,
        )
        poses = asyncio.create_task(self._run_poses(self._cluster), name="poses to the cluster")
        try:
            await self._run_main()
        finally:
            await asyncio.wait({poses}, timeout=_DRAIN_S if self._stopping.is_set() else 0)
            await end_tasks(poses)

    async def _run_poses(self, connection: ClusterConnection) -> None:
        """Publish poses alone, over connections on which nothing has to wait for the cluster to agree."""
        await self._is_announced.wait()  # or others would hear poses of a gateway that they do not know
        late = self._poses.late
        await connection.run(
            self._publish_poses_alone,
            self._lost_poses_connection,
            self._stopping,
            Companions(None if late is None else late.poses.confirmed, beside=self._poses.publish_over_both),
        )

    async def _publish_poses_alone(self, client: aiomqtt.Client) -> None:
        self._note_connection()
        self._poses.publish_over_both(None)
        with self._poses.over(client) as direct, self._poses.open(direct):
            while not self._stopping.is_set():
                self._poses.wake.clear()
                await self._poses.publish_queue(client, direct)
                await self._poses.wake.wait()
            await self._poses.publish_queue(client, direct)

    def _lost_poses_connection(self, error: Exception) -> None:
        self._report_outage(error)
        self._poses.keep_unsent()
        self._poses.disconnected()

    async def _run_main(self) -> None:
        with contextlib.suppress(NameTaken):
            await keep_connected(
                self._turns, self._main_connection, self._use_main, self._lost_main, self._stopping
            )
        if self._cluster is None:
            self._poses.disconnected()

    def _main_connection(self) -> AbstractAsyncContextManager[aiomqtt.Client]:
        """Return that of state, health and names; where there is no cluster, of poses too."""
        if self._cluster is not None and self.is_connected and not self._turns.has_failed:
            self._turns.use(self._cluster.settings)
        settings = self._turns.settings
        return broker_connection(
            settings,
            settings.port,
            self._identifier,
            aiomqtt.Will(self.topics.bridge_state, _OFFLINE, qos=1, retain=True),
            on_answer=self.rights.answered,
            timeout_s=TIMEOUT_S if self._cluster is None else _ELECTION_S,
        )

    async def _use_main(self, client: aiomqtt.Client) -> None:
        self.rights.begin_again()
        is_first = not self._poses.counters.connections
        await self._name.watch(client, self._where, is_first=is_first)
        # A publication may go on waiting for a connection that is lost already.
        await first_to_end(self._listen(client), self._serve(client), *self._watch(client))

    def _lost_main(self, error: Exception) -> None:
        """Note that a connection was lost. Raises ``NameTaken``, which is no loss."""
        if isinstance(error, NameTaken):
            raise error
        if self._cluster is not None:
            logger.debug("%s: what is retained waits: %s", self._turns.settings.port, error)
            return
        self._report_outage(error)
        self._poses.keep_unsent()
        self._poses.disconnected()

    def _watch(self, client: aiomqtt.Client) -> list[Coroutine[Any, Any, None]]:
        """Return what goes on beside publishing where a silent broker is to be noticed soon."""
        parts: list[Coroutine[Any, Any, None]] = []
        if (late := self._poses.late) is not None:
            parts.append(late.send(client, self._may_send_late))
            if self._cluster is None:
                parts.append(keep_asking(client, self._settings.answer_within, late.poses.confirmed))
        return parts

    def _may_send_late(self) -> bool | None:
        """Return whether late poses are to go out now; None: over another broker, to which live ones go."""
        if self._cluster is None:
            return self.is_connected
        if self.is_connected and self._cluster.settings != self._turns.settings:
            return None
        return self.is_connected and not self._cluster.is_apart

    async def _listen(self, client: aiomqtt.Client) -> None:
        """Listen for others of this name until the connection ends. Raises ``aiomqtt.MqttError`` if lost."""
        async for message in client.messages:
            if self._name.take(message) and not self._stopping.is_set():
                self._retained.keep(self.topics.bridge_info, self._info.payload())
                self._retained.keep(self.topics.bridge_state, _ONLINE)

    async def _serve(self, client: aiomqtt.Client) -> None:
        """Announce the gateway, then publish until stopped."""
        if self._cluster is not None:
            await self._serve_beside_poses(client)
            return
        await self._announce(client)
        with self._poses.over(client) as direct:
            await first_to_end(self._retained.publish_for_ever(client), self._publish_poses(client, direct))
            await self._farewell(client, direct)

    async def _serve_beside_poses(self, client: aiomqtt.Client) -> None:
        """Announce the gateway and tell how it fares, until stopped; poses have connections of their own."""
        self._retained.begin_again()
        await self._retained.publish(client)
        self._is_announced.set()
        await first_to_end(self._retained.publish_for_ever(client), self._publish_health_regularly(client))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_DRAIN_S):
                await self._retained.publish(client)
        await self._publish_offline(client)

    async def _publish_offline(self, client: aiomqtt.Client) -> None:
        """Publish the state, and take off the broker what is not to stay."""
        await client.publish(self.topics.bridge_state, _OFFLINE, qos=1, retain=True)
        for topic in self._retained.topics if self.leaves_nothing else ():
            await client.publish(topic, b"", qos=1, retain=True)

    async def _publish_health_regularly(self, client: aiomqtt.Client) -> None:
        """Publish health every few seconds until stopped."""
        while not self._stopping.is_set():
            await self._publish_health(client)
            await nap(self._settings.health_interval, self._stopping)

    async def _publish_poses(self, client: aiomqtt.Client, direct: DirectPublisher) -> None:
        """Publish poses, and health, until stopped."""
        with self._poses.open(direct):
            while not self._stopping.is_set():
                self._poses.wake.clear()
                await self._publish_waiting(client, direct)
                await nap(max(self._health_due - time.monotonic(), 0.0), self._poses.wake)

    async def _announce(self, client: aiomqtt.Client) -> None:
        self._retained.begin_again()
        await self._retained.publish(client)
        self._note_connection()

    def _note_connection(self) -> None:
        """Note that poses can go out from now on."""
        self._poses.connected()
        self._complaints.clear()
        again = "connected" if self._poses.counters.connections == 1 else "connected again"
        logger.info("%s to the MQTT broker at %s, publishing on %s", again, self._where, self.topics.root)

    async def _publish_waiting(self, client: aiomqtt.Client, direct: DirectPublisher) -> None:
        if time.monotonic() >= self._health_due:
            self._health_due = time.monotonic() + self._settings.health_interval
            await self._publish_health(client)
            if self._broker is not None:
                # A client that subscribes to the embedded broker just while the birth message is on its
                # way has been seen to miss it.
                await client.publish(self.topics.bridge_state, _ONLINE, qos=1, retain=True)
        await self._poses.publish_queue(client, direct)

    async def _publish_health(self, client: aiomqtt.Client) -> None:
        try:
            health = self.health()
        except Exception as error:
            self._complain("statistics", f"the statistics cannot be published ({error!r})")
            return
        await client.publish(self.topics.bridge_health, health.payload(), properties=self._properties)

    async def _farewell(self, client: aiomqtt.Client, direct: DirectPublisher) -> None:
        try:
            async with asyncio.timeout(_DRAIN_S):
                await self._retained.publish(client)
                await self._publish_waiting(client, direct)
        except TimeoutError:
            logger.debug("%d poses were still queued at the end", self._poses.counters.queued)
        await self._publish_offline(client)

    def _report_outage(self, error: Exception) -> None:
        """Warn once of a broker that is away, and once more if it then refuses us."""
        if self.is_connected:
            where = self._where
            reason = reason_of(error.__cause__ or error)  # aiomqtt's own says only that it was lost
            self._complain("away", f"lost the MQTT broker at {where} ({reason}): trying to get it back")
        else:
            # A broker may come back with another certificate, too.
            refuses = isinstance(error, MqttConnectError) or "SSL" in reason_of(error)
            kind = "refusing" if refuses else "away"
            self._complain(kind, explain(error, self._door, self._door.port))

    @property
    def _where(self) -> str:
        """Address of the broker in use."""
        return f"{self._door.host}:{self._door.port}"

    @property
    def _door(self) -> MqttSettings:
        """Settings of the broker that poses go to."""
        return self._turns.settings if self._cluster is None else self._cluster.settings

    def _complain(self, kind: str, complaint: str) -> None:
        """Warn, once a kind until the next connection."""
        if kind not in self._complaints:
            self._complaints.add(kind)
            logger.warning("%s", complaint)


def _broker_of(settings: MqttSettings) -> BrokerProcess:
    """Return the embedded broker that a configuration asks for. Raises ``CredentialError``."""
    return BrokerProcess(
        settings.port, settings.websocket_port, settings.websocket_origins, settings.read_websocket_token()
    )
