"""What waits for a broker: poses, of which only the newest are kept, and retained messages."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections import deque
from collections.abc import Callable, Iterator

import aiomqtt
from paho.mqtt.properties import Properties

from gateway.frames import SkeletonFrame

LONGEST_BURST = 512
"""Poses kept for a broker that takes them: five seconds' worth at 100 Hz, for a machine that paused."""
LONGEST_HOLD_S = 0.1
"""A publication, or a queued pose, that waited for the broker for longer shows a slow one."""


class PoseQueue:
    """A bounded queue that tells a burst of our own from a broker that is slow.

    The measure is the time that publications spent waiting for the broker while a pose was queued. Where the
    process itself paused, poses come many at once and the broker takes them as quickly.
    """

    def __init__(self, length: int, clock: Callable[[], float] = time.monotonic) -> None:
        """length: poses kept while the broker is slow or away; clock in s."""
        self.dropped = 0
        """Poses that gave way to newer ones, and that nobody was given."""
        self.on_overflow: Callable[[SkeletonFrame], None] | None = None
        """Given the poses that give way, oldest first. None: they are dropped."""
        self._has_broker = False
        self._length = length
        self._clock = clock
        self._poses: deque[tuple[SkeletonFrame, float]] = deque()
        self._waited_s = 0.0
        self._waiting_since: float | None = None

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def has_broker(self) -> bool:
        """Tell whether somebody takes poses out; set by the owner. Without, only the newest are kept."""
        return self._has_broker

    @has_broker.setter
    def has_broker(self, has_broker: bool) -> None:
        self._has_broker = has_broker
        if not has_broker:
            self._shorten(self._length)

    def put(self, frame: SkeletonFrame) -> None:
        """Add a pose; the oldest give way where there are too many. Never waits."""
        waiting_s = 0.0 if self._waiting_since is None else self._clock() - self._waiting_since
        waited_s = self._waited_s + waiting_s
        self._poses.append((frame, waited_s))
        longest_s = max(waiting_s, waited_s - self._poses[0][1])
        is_held_up = not self._has_broker or longest_s > LONGEST_HOLD_S
        self._shorten(self._length if is_held_up else max(self._length, LONGEST_BURST))

    def take(self) -> SkeletonFrame:
        """Take out the oldest pose. Raises ``IndexError`` when there is none."""
        return self._poses.popleft()[0]

    def keep_newest(self) -> None:
        """Drop all poses but the newest."""
        self._shorten(1)

    @contextlib.contextmanager
    def waiting_for_broker(self) -> Iterator[None]:
        """Count the time spent within as the broker's."""
        since = self._waiting_since = self._clock()
        try:
            yield
        finally:
            self._waited_s += self._clock() - since
            self._waiting_since = None

    def _shorten(self, length: int) -> None:
        while len(self._poses) > length:
            frame, _ = self._poses.popleft()
            if self.on_overflow is None:
                self.dropped += 1
            else:
                self.on_overflow(frame)


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

    @property
    def topics(self) -> list[str]:
        """All on which something is kept."""
        return list(self._newest)

    def begin_again(self) -> None:
        """Forget what was sent: this connection is a new one."""
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
