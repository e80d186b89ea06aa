"""Skeleton frames to an MQTT broker.

``offer`` encodes a frame and writes it to the broker's socket, if that takes it at once. Else it goes into a
short queue, which one task empties; that task outlives every broker: it reconnects for ever, and counts what
had to be dropped meanwhile.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping
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
    publish_unawaited,
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
from gateway.outputs.output import Thinning
from gateway.outputs.own_topics import PublishRights
from gateway.outputs.pose_encoding import Outgoing, PosePublications
from gateway.outputs.queues import PoseQueue, RetainedMessages
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


_PROBE_INTERVAL_S = 2.0
"""Between two poses that the broker is to answer for."""
_POSES_A_TURN = 8
"""Of a burst; links are read in between."""


def _door(settings: MqttSettings) -> dict[str, object]:
    """Settings that decide whether a broker lets us in."""
    names = {"host", "port", "failover", "username", "password_file", "tls", "protocol"}
    return {"broker": settings.broker, **settings.model_dump(include=names)}


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
        self.leaves_nothing = False
        """Whether what is retained is taken off the broker at the end."""
        self.port = settings.port
        """Port of the broker; with port 0 in the settings, the one that was found free."""
        self._settings = settings
        self._identifier = settings.client_id or unique_identifier(info.gateway)
        self._publications = PosePublications(settings, skeleton, self.topics, markers)
        self._properties = properties_of(settings.protocol_in_use, JSON)
        self.instance = secrets.token_hex(8)
        """Another one for every output that is made: tells gateways of one name apart."""
        self.rights = PublishRights(are_reported=settings.protocol_in_use == "5")
        self._name = NameGuard(settings, self.topics, self.instance)
        self._probe_due = 0.0
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
        self._thinning = Thinning(settings.pose_rate)
        self._relief = Thinning(None)
        self._queue = PoseQueue(settings.queue_length)
        self._late: LateOutlet | None = None
        self._turns = BrokerTurns(settings, settings.port)
        self._poses: ClusterConnection | None = None  # where there is a cluster
        self._is_announced = asyncio.Event()
        self._published = self._dropped = self._thinned = self._connections = 0
        self._in_hand = 0  # 1 while a pose is on its way to the broker
        self._direct: DirectPublisher | None = None  # while poses may go out
        self._beside: DirectPublisher | None = None  # while two brokers of a cluster do not hear each other
        self._direct_in_turn = 0  # poses published at once since the event loop last had its turn
        self._complaints: set[str] = set()
        self._wake = asyncio.Event()
        self._stopping = asyncio.Event()
        self._broker: BrokerProcess | None = None
        self._successor: MqttOutput | None = None
        self._task: asyncio.Task[None] | None = None
        self._started = time.monotonic()

    @property
    def counters(self) -> OutputCounters:
        """What became of the offered poses so far."""
        return OutputCounters(
            published=self._published,
            dropped=self._dropped + self._queue.dropped,
            thinned=self._thinned,
            queued=len(self._queue) + self._in_hand,
            late=0 if self._late is None else self._late.kept,
            connections=self._connections,
        )

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
        if not (self._thinning.admits(frame.time_ns) and self._relief.admits(frame.time_ns)):
            self._thinned += 1
        elif self._late is not None and not self.is_connected:
            self._keep_late(frame)
        elif not self._published_at_once(frame):
            self._queue.put(frame)
            self._wake.set()

    def _published_at_once(self, frame: SkeletonFrame) -> bool:
        """Publish a frame if none waits and the broker's socket takes it; whether it is dealt with.

        It costs a third of waking a task for it, and poses need no turn of the loop to get out."""
        direct = self._direct
        if direct is None or self._queue or self._in_hand or not direct.is_free or self._is_probing:
            return False
        if self._direct_in_turn == _POSES_A_TURN:
            return False
        self._direct_in_turn += 1
        if self._direct_in_turn == _POSES_A_TURN:
            asyncio.get_running_loop().call_soon(self._begin_turn)
        outgoing = self._encoded(frame)
        if outgoing is None:
            return True
        self._hand_beside(outgoing)
        try:
            is_taken = direct.publish(outgoing)
        except aiomqtt.MqttError:
            self._count_unsent(1)
            self._direct = None  # the connection is lost, and its task about to hear of it
            return True
        if is_taken:
            self._published += 1
        else:
            self._in_hand = 1
            self._wake.set()
        return True

    def publish_beside(self, topic: str, payload: bytes) -> bool:
        """Publish a message beside the poses, below the gateway's topics, if the broker's socket takes it at
        once; whether it does. Nothing is kept."""
        direct, topic = self._direct, f"{self.topics.root}/{topic}"
        if direct is None or self._in_hand or not direct.is_free or topic in self.rights.refused:
            return False
        try:
            direct.publish([Outgoing(topic, payload, self._properties)])  # the client sends what is left
        except aiomqtt.MqttError:
            return False
        return True

    def _keep_late(self, frame: SkeletonFrame) -> None:
        """Keep a pose to be sent later, where that is asked for."""
        if self._late is not None:
            self._late.keep(self._encoded(frame))

    def _hand_beside(self, outgoing: list[Outgoing]) -> None:
        """Hand what is about to be published to whatever else takes it: late poses, a second connection."""
        if self._late is not None:
            self._late.hold(outgoing)
        if self._beside is not None and self._beside.is_free:
            with contextlib.suppress(aiomqtt.MqttError):  # it is replaced by those who keep it
                self._beside.publish(outgoing)

    def _begin_turn(self) -> None:
        self._direct_in_turn = 0

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
        elif former is not None and _door(settings) != _door(former._settings):
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
            self._late = LateOutlet(self._settings.late, self.topics, self.instance, self._properties)
            self._queue.on_overflow = self._keep_late
        self._turns = BrokerTurns(self._settings, self.port)
        self._started = time.monotonic()
        self._name.begin()
        self._task = asyncio.create_task(self._run(), name="mqtt output")

    async def stop(self) -> None:
        """Publish what is queued, say offline and disconnect: within 2 s, broker or not."""
        self._stopping.set()
        self._wake.set()
        if self._task is not None:
            if self.is_connected:
                await asyncio.wait({self._task}, timeout=_FAREWELL_S)
            if not self._task.done():
                self._keep_unsent()
            await end_tasks(self._task)
            self._task = None
        if self._late is not None:
            self._late.poses.close()
            self._late = None
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
        self._poses = ClusterConnection(
            self._settings,
            self.port,
            self._info.gateway,
            self.topics.bridge_echo,
            on_answer=self.rights.answered,
        )
        poses = asyncio.create_task(self._run_poses(self._poses), name="poses to the cluster")
        try:
            await self._run_main()
        finally:
            await asyncio.wait({poses}, timeout=_DRAIN_S if self._stopping.is_set() else 0)
            await end_tasks(poses)

    async def _run_poses(self, connection: ClusterConnection) -> None:
        """Publish poses alone, over connections on which nothing has to wait for the cluster to agree."""
        await self._is_announced.wait()  # or others would hear poses of a gateway that they do not know
        await connection.run(
            self._publish_poses_alone,
            self._lost_poses_connection,
            self._stopping,
            Companions(
                None if self._late is None else self._late.poses.confirmed, beside=self._publish_beside
            ),
        )

    def _publish_beside(self, client: aiomqtt.Client | None) -> None:
        """Publish poses over a second connection too, from now on; None: no longer."""
        self._beside = None if client is None else self._direct_publisher(client)
        if client is not None and self._late is not None:
            self._late.poses.connection_lost()  # nobody beyond the broker in use may have heard them

    async def _publish_poses_alone(self, client: aiomqtt.Client) -> None:
        self._note_connection()
        self._beside = None
        with self._handing_over(client) as direct:
            self._direct = direct
            while not self._stopping.is_set():
                self._wake.clear()
                await self._publish_queue(client, direct)
                await self._wake.wait()
            await self._publish_queue(client, direct)

    def _direct_publisher(self, client: aiomqtt.Client) -> DirectPublisher:
        return DirectPublisher(client, has_properties=self._settings.protocol_in_use == "5")

    @contextlib.contextmanager
    def _handing_over(self, client: aiomqtt.Client) -> Iterator[DirectPublisher]:
        """Give what hands poses to a connection; one that is on its way at the end is counted as dropped."""
        try:
            yield self._direct_publisher(client)
        finally:
            self._direct = None
            self._count_unsent(self._in_hand)
            self._in_hand = 0

    def _count_unsent(self, poses: int) -> None:
        """Count poses that a connection did not take; where late ones are kept, it was held."""
        if self._late is None:
            self._dropped += poses
        else:
            self._late.kept += poses

    def _lost_poses_connection(self, error: Exception) -> None:
        self._report_outage(error)
        self.is_connected = self._queue.has_broker = False
        self._keep_unsent()

    async def _run_main(self) -> None:
        with contextlib.suppress(NameTaken):
            await keep_connected(
                self._turns, self._main_connection, self._use_main, self._lost_main, self._stopping
            )
        if self._poses is None:
            self.is_connected = self._queue.has_broker = False

    def _main_connection(self) -> AbstractAsyncContextManager[aiomqtt.Client]:
        """Return that of state, health and names; where there is no cluster, of poses too."""
        if self._poses is not None and self.is_connected and not self._turns.has_failed:
            self._turns.use(self._poses.settings)
        settings = self._turns.settings
        return broker_connection(
            settings,
            settings.port,
            self._identifier,
            aiomqtt.Will(self.topics.bridge_state, _OFFLINE, qos=1, retain=True),
            on_answer=self.rights.answered,
            timeout_s=TIMEOUT_S if self._poses is None else _ELECTION_S,
        )

    async def _use_main(self, client: aiomqtt.Client) -> None:
        self.rights.begin_again()
        self._probe_due = 0.0
        await self._name.watch(client, self._where, is_first=not self._connections)
        # A publication may go on waiting for a connection that is lost already.
        await first_to_end(self._listen(client), self._serve(client), *self._watch(client))

    def _lost_main(self, error: Exception) -> None:
        """Raises ``NameTaken``, which is no loss."""
        if isinstance(error, NameTaken):
            raise error
        if self._poses is not None:
            logger.debug("%s: what is retained waits: %s", self._turns.settings.port, error)
            return
        self._report_outage(error)
        self._keep_unsent()
        self.is_connected = self._queue.has_broker = False

    def _watch(self, client: aiomqtt.Client) -> list[Coroutine[Any, Any, None]]:
        """Return what goes on beside publishing where a silent broker is to be noticed soon."""
        parts: list[Coroutine[Any, Any, None]] = []
        if self._late is not None:
            parts.append(self._late.send(client, self._may_send_late))
            if self._poses is None:
                parts.append(keep_asking(client, self._settings.answer_within, self._late.poses.confirmed))
        return parts

    def _may_send_late(self) -> bool | None:
        """Whether late poses are to go out now; None: over another broker, to which live ones go."""
        if self._poses is None:
            return self.is_connected
        if self.is_connected and self._poses.settings != self._turns.settings:
            return None
        return self.is_connected and not self._poses.is_apart

    def _keep_unsent(self) -> None:
        """Have what waits, or may not have arrived, sent later, where that is asked for."""
        if self._late is None:
            return
        self._late.poses.connection_lost()
        while self._queue:
            self._keep_late(self._queue.take())

    async def _listen(self, client: aiomqtt.Client) -> None:
        """Until the connection ends; raises ``aiomqtt.MqttError`` when it was lost."""
        async for message in client.messages:
            if self._name.take(message) and not self._stopping.is_set():
                self._retained.keep(self.topics.bridge_info, self._info.payload())
                self._retained.keep(self.topics.bridge_state, _ONLINE)

    async def _serve(self, client: aiomqtt.Client) -> None:
        """Announce the gateway, then publish until stopped."""
        if self._poses is not None:
            await self._serve_beside_poses(client)
            return
        await self._announce(client)
        with self._handing_over(client) as direct:
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
        """Until stopped."""
        while not self._stopping.is_set():
            await self._publish_health(client)
            await nap(self._settings.health_interval, self._stopping)

    async def _publish_poses(self, client: aiomqtt.Client, direct: DirectPublisher) -> None:
        """And health, until stopped."""
        self._direct = direct
        try:
            while not self._stopping.is_set():
                self._wake.clear()
                await self._publish_waiting(client, direct)
                await nap(max(self._health_due - time.monotonic(), 0.0), self._wake)
        finally:
            self._direct = None

    async def _announce(self, client: aiomqtt.Client) -> None:
        self._retained.begin_again()
        await self._retained.publish(client)
        self._note_connection()

    def _note_connection(self) -> None:
        """Note that poses can go out from now on."""
        # Poses from before the connection are of no use to anybody, but for the last one.
        self._queue.keep_newest()
        self._connections += 1
        self.is_connected = self._queue.has_broker = True
        self._complaints.clear()
        again = "connected" if self._connections == 1 else "connected again"
        logger.info("%s to the MQTT broker at %s, publishing on %s", again, self._where, self.topics.root)

    async def _publish_waiting(self, client: aiomqtt.Client, direct: DirectPublisher) -> None:
        if time.monotonic() >= self._health_due:
            self._health_due = time.monotonic() + self._settings.health_interval
            await self._publish_health(client)
            if self._broker is not None:
                # A client that subscribes to the embedded broker just while the birth message is on its
                # way has been seen to miss it.
                await client.publish(self.topics.bridge_state, _ONLINE, qos=1, retain=True)
        await self._publish_queue(client, direct)

    async def _publish_queue(self, client: aiomqtt.Client, direct: DirectPublisher) -> None:
        """Publish the poses that wait."""
        count = 0
        if self._in_hand:
            await self._published_in_the_end(direct.drained())
        while self._queue:
            outgoing = self._encoded(self._queue.take())
            if outgoing is not None:
                self._in_hand = 1
                await self._published_in_the_end(self._send(client, direct, outgoing))
            count += 1
            if count % _POSES_A_TURN == 0:
                await asyncio.sleep(0)

    def _encoded(self, frame: SkeletonFrame) -> list[Outgoing] | None:
        """Return the messages of a pose; None for one that cannot be encoded, which is dropped."""
        try:
            return self._publications.of(frame)
        except Exception as error:
            self._dropped += 1
            self._complain("pose", f"a pose cannot be encoded ({error!r}): it is dropped")
            return None

    async def _published_in_the_end(self, sending: Coroutine[Any, Any, bool]) -> None:
        """Wait until the pose in hand is out, and count what became of it."""
        with self._queue.waiting_for_broker():
            is_taken = await sending
        self._in_hand = 0
        self._published += is_taken
        self._dropped += not is_taken

    @property
    def _is_probing(self) -> bool:
        """Whether the next pose is one that the broker has to answer for, or some topics are refused."""
        rights = self.rights
        return rights.are_reported and (bool(rights.refused) or time.monotonic() >= self._probe_due)

    async def _send(self, client: aiomqtt.Client, direct: DirectPublisher, outgoing: list[Outgoing]) -> bool:
        """Publish the messages of a pose; whether the broker takes any of them, as far as it tells.

        Only QoS 1 is answered: now and then a pose goes out so, and while topics are refused no other does.
        The answer is waited for unless the one before was good.
        """
        self._hand_beside(outgoing)
        is_probe = self.rights.are_reported and time.monotonic() >= self._probe_due
        if not is_probe:
            direct.publish([each for each in outgoing if each.topic not in self.rights.refused])
            await direct.drained()
        else:
            self._probe_due = time.monotonic() + _PROBE_INTERVAL_S
            for topic, payload, properties in outgoing:
                if self.rights.state == "allowed":
                    publish_unawaited(client, topic, payload, properties)
                else:
                    await client.publish(topic, payload, qos=1, properties=properties)
        return any(topic not in self.rights.refused for topic, *_ in outgoing)

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
            logger.debug("%d poses were still queued at the end", len(self._queue))
        await self._publish_offline(client)

    def _report_outage(self, error: Exception) -> None:
        """One warning for a broker that is away, one more if it then refuses us."""
        if self.is_connected:
            where = self._where
            reason = error.__cause__ or error  # aiomqtt's own says only that it was lost
            self._complain("away", f"lost the MQTT broker at {where} ({reason}): trying to get it back")
        else:
            kind = "refusing" if isinstance(error, MqttConnectError) else "away"
            self._complain(kind, explain(error, self._door, self._door.port))

    @property
    def _where(self) -> str:
        """Address of the broker in use."""
        return f"{self._door.host}:{self._door.port}"

    @property
    def _door(self) -> MqttSettings:
        """Settings of the broker that poses go to."""
        return self._turns.settings if self._poses is None else self._poses.settings

    def _complain(self, kind: str, complaint: str) -> None:
        """A warning, once a kind until the next connection."""
        if kind not in self._complaints:
            self._complaints.add(kind)
            logger.warning("%s", complaint)


def _broker_of(settings: MqttSettings) -> BrokerProcess:
    """The embedded broker that a configuration asks for. Raises ``CredentialError``."""
    return BrokerProcess(
        settings.port, settings.websocket_port, settings.websocket_origins, settings.read_websocket_token()
    )
