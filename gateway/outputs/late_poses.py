"""Poses that no broker took: kept in a file, and published later on a topic of their own.

A pose is handed to a connection long before anybody knows that it is dead. So poses are held in memory until
the broker has answered a question that came after them; when the connection is lost, those that are not
confirmed go to the file, and all that come while there is none. Some of them may have arrived after all: a
late pose has the ``instance`` and ``seq`` of the live one, so that whoever joins the two counts none twice.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

import aiomqtt
from paho.mqtt.properties import Properties

from devices.link import gateway_time_ns
from gateway.contract.topics import Topics
from gateway.errors import OutputError
from gateway.outputs.pose_encoding import Outgoing
from gateway.outputs.settings import LateSettings
from gateway.support.whole_files import write_whole

CONFIRMED_S = 0.5
"""An answer confirms what was published so long before: the broker has passed that on to its cluster too."""
LONGEST_UNCONFIRMED = 5000
"""Poses held in memory."""
_TOGETHER = 10
"""Late poses whose acknowledgements are waited for at once."""
_MB = 1_000_000
_LONGEST_LINE = _MB
"""Bytes: see ``connection.LARGEST_MESSAGE``."""
_log = logging.getLogger(__name__)


class LatePoses:
    """The poses of one gateway that are to be sent later, oldest first. Belongs to one event loop.

    What an earlier run of the gateway has left is sent too.
    """

    def __init__(self, path: Path, instance: str, most_mb: float) -> None:
        """Open or make the file. Raises ``OutputError`` with what stands against it."""
        self.kept = 0
        """Poses written to the file."""
        self.sent = 0
        self.left_out = 0
        """Poses for which there was no room."""
        self._path = path
        self._mark = b',"instance":"%b"' % instance.encode()
        self._most_bytes = round(most_mb * _MB)
        self._unconfirmed: deque[tuple[float, bytes]] = deque(maxlen=LONGEST_UNCONFIRMED)
        self._taken = self._given = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: BinaryIO = path.open("a+b", buffering=0)
        except OSError as error:
            raise OutputError(
                f"mqtt.late.folder: {path} cannot be written ({error.strerror}): name a folder of your own"
            ) from error
        self._size = self._file.seek(0, os.SEEK_END)
        self._drop_torn_line()

    def _drop_torn_line(self) -> None:
        """Cut off a last line that a power cut has torn: what is kept next must not join it."""
        begin = max(self._size - _LONGEST_LINE, 0)
        self._file.seek(begin)
        self._size = begin + self._file.read().rfind(b"\n") + 1
        self._file.truncate(self._size)

    def _write(self, data: bytes) -> None:
        """Append. Raises ``OSError`` where not all of it can be; the file is then as it was."""
        try:
            if self._file.write(data) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            self._file.truncate(self._size)
            raise
        self._size += len(data)

    @property
    def has_some(self) -> bool:
        """Whether poses wait in the file."""
        return self._taken < self._size

    def published(self, payload: bytes) -> None:
        """Hold a pose (a JSON object) that was handed to a connection, until it is confirmed."""
        self._unconfirmed.append((time.monotonic(), payload))

    def confirmed(self, asked_s: float) -> None:
        """Let go of what was published well before an instant (``time.monotonic()``, s)."""
        while self._unconfirmed and self._unconfirmed[0][0] < asked_s - CONFIRMED_S:
            self._unconfirmed.popleft()

    def connection_lost(self) -> None:
        """Keep what is not confirmed."""
        for _, payload in self._unconfirmed:
            self.keep(payload)
        self._unconfirmed.clear()

    def keep(self, payload: bytes) -> None:
        """Write a pose (a JSON object) to the file; one for which there is no room is counted."""
        line = payload[:-1] + self._mark + b"}\n"
        if self._size + len(line) > self._most_bytes:
            self._leave_out("mqtt.late.most_mb is reached")
            return
        try:
            self._write(line)
        except OSError as error:
            self._leave_out(str(error.strerror))
            return
        self.kept += 1

    def _leave_out(self, reason: str) -> None:
        self.left_out += 1
        if self.left_out == 1:
            _log.warning("%s: poses are not kept to be sent later: %s", self._path, reason)

    def next(self, most: int, sent_ns: int) -> list[bytes]:
        """Return the next poses as they are published, ``sent_ns`` in each; ``done`` says they are out."""
        self._file.seek(self._taken)
        lines = [self._file.readline() for _ in range(most)]
        self._given = sum(map(len, lines))
        mark = b',"sent_ns":%d}' % sent_ns
        # A line that a power cut has torn is no object, and is left out.
        return [line[:-2] + mark for line in lines if line.startswith(b"{") and line.endswith(b"}\n")]

    def done(self, number: int) -> None:
        """Note that the broker has taken those of ``next``; the file is emptied when all are out."""
        self._taken += self._given
        self.sent += number
        if not self.has_some:
            self._file.truncate(0)
            self._size = self._taken = 0

    def close(self) -> None:
        """Keep what is not confirmed no longer; the file loses what was sent."""
        if self._taken:
            self._file.seek(self._taken)
            rest = self._file.read()
            write_whole(self._path, rest)
        self._file.close()


class LateOutlet:
    """Keeps the poses of one gateway, as they would be published, and publishes those that are late."""

    def __init__(
        self, settings: LateSettings, topics: Topics, instance: str, properties: Properties | None
    ) -> None:
        """properties: of every message (MQTT 5). Raises ``OutputError`` where nothing can be kept."""
        self.kept = 0
        """Poses that were kept and not handed to a connection before."""
        self.poses = LatePoses(settings.folder / f"{topics.gateway}.late.jsonl", instance, settings.most_mb)
        self._topics = topics
        self._properties = properties
        self._interval_s = _TOGETHER / settings.rate

    def keep(self, outgoing: Sequence[Outgoing] | None) -> None:
        """Keep the pose among the messages of a frame to be sent later."""
        for each in outgoing or ():
            if each.topic == self._topics.pose:
                self.poses.keep(each.payload)
                self.kept += 1

    def hold(self, outgoing: Sequence[Outgoing]) -> None:
        """Hold the pose among what is about to be published, in case the connection is dead already."""
        for each in outgoing:
            if each.topic == self._topics.pose:
                self.poses.published(each.payload)

    async def send(self, client: aiomqtt.Client, may_send: Callable[[], bool | None]) -> None:
        """Publish what was kept beside the live poses; returns when that wants another connection.

        may_send: whether now; None: over another connection. Raises ``aiomqtt.MqttError``.
        """
        while True:
            may = may_send() if self.poses.has_some else False
            if may is None:
                return
            if may:
                poses = self.poses.next(_TOGETHER, gateway_time_ns())
                publishing = (
                    client.publish(self._topics.late_pose, pose, qos=1, properties=self._properties)
                    for pose in poses
                )
                await asyncio.gather(*publishing)
                self.poses.done(len(poses))
            await asyncio.sleep(self._interval_s)
