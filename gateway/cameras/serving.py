"""Heat maps of one camera over TCP: every receiver gets whole messages, and the newest when it is slow."""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

from devices.cameras.pictures import CameraError, open_pictures
from gateway.cameras.camera_process import CameraTask, instant_of, message_of
from gateway.cameras.person_follower import PersonFollower
from gateway.reconstruction.video.networks.network import load_network
from gateway.reconstruction.video.networks.person_detector import PersonDetector

_MOST_WAITING = 1 << 18
"""Bytes that a receiver may be behind; more, and it misses messages."""


@dataclass
class Served:
    """What became of the messages."""

    messages: int = 0
    sent: int = 0
    """Handed to receivers, each counted."""
    skipped: int = 0
    """That a receiver was too slow for."""


@dataclass
class _Receiver:
    connection: socket.socket
    waiting: bytearray = field(default_factory=bytearray)


class Sink(Protocol):
    """Where messages go."""

    served: Served

    def wait_for_first(self) -> None:
        """Until there is somebody to take them."""

    def offer(self, message: bytes) -> None:
        """Hand over one message; it never waits."""

    def close(self) -> None:
        """Hand over what is waiting, and end."""


def serve(task: CameraTask, sink: Sink, speed: float, begin_s: float | None = None) -> None:
    """Until the camera ends, or Ctrl-C. Raises ``CameraError``.

    begin_s: when a file begins, seconds since the epoch; None: when there is somebody to take it.
    """
    source = open_pictures(task.place, task.rate_hz)
    follower = PersonFollower(load_network(task.network), PersonDetector())
    with contextlib.closing(source), contextlib.closing(sink), contextlib.suppress(KeyboardInterrupt):
        if begin_s is not None:
            time.sleep(max(0.0, begin_s - time.time()))
        elif source.info.count is not None:
            sink.wait_for_first()
        begun = time.monotonic()
        for index, (time_ns, picture) in enumerate(source):
            if source.info.count is not None and speed > 0:
                time.sleep(max(0.0, begun + time_ns * 1e-9 / speed - time.monotonic()))
            sink.offer(message_of(follower, picture, task, *instant_of(task, source.info, index, time_ns)))


@contextlib.contextmanager
def listening(host: str, port: int) -> Iterator[socket.socket]:
    """A TCP port. Raises ``CameraError`` where it cannot be had."""
    try:
        listener = socket.create_server((host, port))
    except OSError as error:
        raise CameraError(f"tcp://{host}:{port} cannot be listened on: {error.strerror}") from error
    with listener:
        yield listener


class Outlet:
    """Messages to whoever is connected; offering never waits."""

    def __init__(self, listener: socket.socket) -> None:
        listener.setblocking(False)
        self._listener = listener
        self._receivers: list[_Receiver] = []
        self.served = Served()

    def wait_for_first(self) -> None:
        """Until somebody has connected."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._listener, selectors.EVENT_READ)
            while not self._receivers:
                selector.select(0.5)
                self._welcome()

    def offer(self, message: bytes) -> None:
        """To every receiver, unless it is too far behind."""
        self._welcome()
        self.served.messages += 1
        for receiver in self._receivers:
            if len(receiver.waiting) > _MOST_WAITING:
                self.served.skipped += 1
            else:
                receiver.waiting += message
                self.served.sent += 1
        self._receivers = [receiver for receiver in self._receivers if _pushed(receiver)]

    def close(self) -> None:
        """Send what is waiting, and hang up."""
        for receiver in self._receivers:
            receiver.connection.settimeout(5.0)
            with contextlib.suppress(OSError):
                receiver.connection.sendall(receiver.waiting)
            receiver.connection.close()
        self._receivers = []

    def _welcome(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                connection, _ = self._listener.accept()
                connection.setblocking(False)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._receivers.append(_Receiver(connection))


def _pushed(receiver: _Receiver) -> bool:
    """As much as the connection takes at once; False: it is gone."""
    try:
        taken = receiver.connection.send(receiver.waiting) if receiver.waiting else 0
    except BlockingIOError:
        return True
    except OSError:
        receiver.connection.close()
        return False
    del receiver.waiting[:taken]
    return True
