"""The way of a pose to a broker.

``offer`` encodes a frame and writes it to the broker's socket, if that takes it at once. Else it goes into a
short queue, which whoever keeps the connections (``gateway.outputs.mqtt``) has emptied; poses without a
broker are kept as late, where that is asked for. Every pose is counted once: published, dropped, thinned,
queued or late.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Coroutine, Iterator
from typing import Any

import aiomqtt
from paho.mqtt.properties import Properties

from gateway.contract.messages import OutputCounters
from gateway.frames import SkeletonFrame
from gateway.outputs.connection import publish_unawaited
from gateway.outputs.direct_publishing import DirectPublisher
from gateway.outputs.late_poses import LateOutlet
from gateway.outputs.output import Thinning
from gateway.outputs.own_topics import PublishRights
from gateway.outputs.pose_encoding import Outgoing, PosePublications
from gateway.outputs.queues import PoseQueue
from gateway.outputs.settings import MqttSettings

logger = logging.getLogger(__name__)

_POSES_A_TURN = 8
"""Of a burst; links are read in between."""


class PoseOutlet:
    """Takes poses, and publishes them over the connections that it is given. Belongs to one event loop."""

    def __init__(
        self,
        settings: MqttSettings,
        publications: PosePublications,
        rights: PublishRights,
        properties: Properties | None,
    ) -> None:
        """properties: of every message beside the poses (MQTT 5)."""
        self.is_connected = False
        self.late: LateOutlet | None = None
        """Keeps poses for which there is no broker, where that is asked for."""
        self.wake = asyncio.Event()
        """Set when a pose waits for ``publish_queue``."""
        self._has_properties = settings.protocol_in_use == "5"
        self._publications = publications
        self._rights = rights
        self._properties = properties
        self._thinning = Thinning(settings.pose_rate)
        self._relief = Thinning(None)
        self._queue = PoseQueue(settings.queue_length)
        self._published = self._dropped = self._thinned = self._connections = 0
        self._in_hand = 0  # 1 while a pose is on its way to the broker
        self._direct: DirectPublisher | None = None  # while poses may go out
        self._beside: DirectPublisher | None = None  # while two brokers of a cluster do not hear each other
        self._direct_in_turn = 0  # poses published at once since the event loop last had its turn
        self._has_complained = False

    @property
    def counters(self) -> OutputCounters:
        """What became of the offered poses so far."""
        return OutputCounters(
            published=self._published,
            dropped=self._dropped + self._queue.dropped,
            thinned=self._thinned,
            queued=len(self._queue) + self._in_hand,
            late=0 if self.late is None else self.late.kept,
            connections=self._connections,
        )

    def offer(self, frame: SkeletonFrame) -> None:
        """Take a frame for publishing. Never waits; where too many wait the oldest gives way."""
        if not (self._thinning.admits(frame.time_ns) and self._relief.admits(frame.time_ns)):
            self._thinned += 1
        elif self.late is not None and not self.is_connected:
            self._keep_late(frame)
        elif not self._published_at_once(frame):
            self._queue.put(frame)
            self.wake.set()

    def relieve(self, poses_hz: float | None, *, has_segments: bool) -> None:
        """Publish less for a while: at most so many poses a second (None: as configured), and no single
        segments. What is not published counts as thinned."""
        self._relief = Thinning(poses_hz)
        self._publications.has_segments = has_segments

    def publish_beside(self, topic: str, payload: bytes) -> bool:
        """Publish a message beside the poses, if the broker's socket takes it at once; whether it does.
        Nothing is kept."""
        direct = self._direct
        if direct is None or self._in_hand or not direct.is_free or topic in self._rights.refused:
            return False
        try:
            direct.publish([Outgoing(topic, payload, self._properties)])  # the client sends what is left
        except aiomqtt.MqttError:
            return False
        return True

    def keep_late_in(self, late: LateOutlet) -> None:
        """Have poses without a broker kept from now on."""
        self.late = late
        self._queue.on_overflow = self._keep_late

    def close(self) -> None:
        """Close what late poses are kept in."""
        if self.late is not None:
            self.late.poses.close()
            self.late = None

    def connected(self) -> None:
        """Note that poses can go out from now on."""
        # Poses from before the connection are of no use to anybody, but for the last one.
        self._queue.keep_newest()
        self._connections += 1
        self.is_connected = self._queue.has_broker = True
        self._has_complained = False

    def disconnected(self) -> None:
        """Note that no connection takes poses any more."""
        self.is_connected = self._queue.has_broker = False

    def keep_unsent(self) -> None:
        """Have what waits, or may not have arrived, sent later, where that is asked for."""
        if self.late is None:
            return
        self.late.poses.connection_lost()
        while self._queue:
            self._keep_late(self._queue.take())

    def publisher_on(self, client: aiomqtt.Client) -> DirectPublisher:
        """Return what writes to the socket of a connection."""
        return DirectPublisher(client, has_properties=self._has_properties)

    def publish_over_both(self, client: aiomqtt.Client | None) -> None:
        """Publish poses over a second connection too, from now on; None: no longer."""
        self._beside = None if client is None else self.publisher_on(client)
        if client is not None and self.late is not None:
            self.late.poses.connection_lost()  # nobody beyond the broker in use may have heard them

    @contextlib.contextmanager
    def over(self, client: aiomqtt.Client) -> Iterator[DirectPublisher]:
        """Use a connection; a pose that is on its way at the end is counted as dropped."""
        try:
            yield self.publisher_on(client)
        finally:
            self._direct = None
            self._count_unsent(self._in_hand)
            self._in_hand = 0

    @contextlib.contextmanager
    def open(self, direct: DirectPublisher) -> Iterator[None]:
        """Write poses to a connection's socket as soon as they are offered."""
        self._direct = direct
        try:
            yield
        finally:
            self._direct = None

    async def publish_queue(self, client: aiomqtt.Client, direct: DirectPublisher) -> None:
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

    def _published_at_once(self, frame: SkeletonFrame) -> bool:
        """Publish a frame if none waits and the broker's socket takes it; whether it is dealt with.

        It costs a third of waking a task for it, and poses need no turn of the loop to get out."""
        direct = self._direct
        if direct is None or self._queue or self._in_hand or not direct.is_free or self._rights.wants_answer:
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
            self.wake.set()
        return True

    def _begin_turn(self) -> None:
        self._direct_in_turn = 0

    def _keep_late(self, frame: SkeletonFrame) -> None:
        """Keep a pose to be sent later, where that is asked for."""
        if self.late is not None:
            self.late.keep(self._encoded(frame))

    def _hand_beside(self, outgoing: list[Outgoing]) -> None:
        """Hand what is about to be published to whatever else takes it: late poses, a second connection."""
        if self.late is not None:
            self.late.hold(outgoing)
        if self._beside is not None and self._beside.is_free:
            with contextlib.suppress(aiomqtt.MqttError):  # it is replaced by those who keep it
                self._beside.publish(outgoing)

    def _count_unsent(self, poses: int) -> None:
        """Count poses that a connection did not take; where late ones are kept, it was held."""
        if self.late is None:
            self._dropped += poses
        else:
            self.late.kept += poses

    def _encoded(self, frame: SkeletonFrame) -> list[Outgoing] | None:
        """Return the messages of a pose; None for one that cannot be encoded, which is dropped."""
        try:
            return self._publications.of(frame)
        except Exception as error:
            self._dropped += 1
            if not self._has_complained:
                self._has_complained = True
                logger.warning("a pose cannot be encoded (%r): it is dropped", error)
            return None

    async def _published_in_the_end(self, sending: Coroutine[Any, Any, bool]) -> None:
        """Wait until the pose in hand is out, and count what became of it."""
        with self._queue.waiting_for_broker():
            is_taken = await sending
        self._in_hand = 0
        self._published += is_taken
        self._dropped += not is_taken

    async def _send(self, client: aiomqtt.Client, direct: DirectPublisher, outgoing: list[Outgoing]) -> bool:
        """Publish the messages of a pose; whether the broker takes any of them, as far as it tells.

        Only QoS 1 is answered: now and then a pose goes out so, and while topics are refused no other does.
        The answer is waited for unless the one before was good.
        """
        self._hand_beside(outgoing)
        if not self._rights.is_due:
            direct.publish([each for each in outgoing if each.topic not in self._rights.refused])
            await direct.drained()
        else:
            self._rights.asked()
            for topic, payload, properties in outgoing:
                if self._rights.state == "allowed":
                    publish_unawaited(client, topic, payload, properties)
                else:
                    await client.publish(topic, payload, qos=1, properties=properties)
        return any(topic not in self._rights.refused for topic, *_ in outgoing)
