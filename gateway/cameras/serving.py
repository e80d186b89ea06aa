"""Heat maps of one camera over TCP: every receiver gets whole messages, and the newest when it is slow."""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Protocol

from devices.cameras.heat_map_messages import HeatMapReceiver, encode_heat_maps
from devices.cameras.orders import LONGEST
from devices.cameras.pictures import CameraError, Picture, open_pictures
from gateway.cameras.camera_process import CameraTask, instant_of, messages_of
from gateway.cameras.people_follower import FollowingCameras
from gateway.reconstruction.video.networks.person_detector import PersonDetector
from gateway.reconstruction.video.networks.weights import load_network
from gateway.recording.reading import open_recording

RECORDING = ".mcap"
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
    received: bytearray = field(default_factory=bytearray)
    """The beginning of a line of orders."""


class MessageSink(Protocol):
    """Where messages go."""

    served: Served

    def wait_for_first(self) -> None:
        """Wait until there is somebody to take them."""

    def offer(self, message: bytes) -> None:
        """Hand over the messages of one picture; it never waits."""

    def newest_line(self) -> bytes:
        """Return the last line of orders that came since this was asked; empty: none did."""

    def close(self) -> None:
        """Hand over what is waiting, and end."""


def serve(
    tasks: Sequence[CameraTask],
    sink: MessageSink,
    speed: float,
    begin_s: float | None = None,
    people: int = 1,
) -> None:
    """Serve a camera, or two side by side, until one ends, or Ctrl-C. Raises ``CameraError``.

    begin_s: when files begin, seconds since the epoch; None: when there is somebody to take them. people:
    that are followed at once.
    """
    is_recorded = Path(tasks[0].place).suffix == RECORDING
    source = _Recorded(tasks[0]) if is_recorded else _LookedAt(tasks, people)
    with contextlib.closing(source), contextlib.closing(sink), contextlib.suppress(KeyboardInterrupt):
        if begin_s is not None:
            time.sleep(max(0.0, begin_s - time.time()))
        elif not source.is_live:
            sink.wait_for_first()
        begun = time.monotonic()
        for time_ns, message in source:
            if not source.is_live and speed > 0:
                time.sleep(max(0.0, begun + time_ns * 1e-9 / speed - time.monotonic()))
            source.take(sink.newest_line())
            sink.offer(message())


class _LookedAt:
    """Pictures of cameras through the network."""

    def __init__(self, tasks: Sequence[CameraTask], people: int) -> None:
        self._tasks = tasks
        self._sources = [open_pictures(task.place, task.rate_hz) for task in tasks]
        self._cameras = FollowingCameras(
            [task.name for task in tasks], load_network(tasks[0].network), PersonDetector(), people
        )
        self.take = self._cameras.take
        self.is_live = self._sources[0].info.count is None

    def close(self) -> None:
        """Let go of files and devices."""
        for source in self._sources:
            source.close()

    def __iter__(self) -> Iterator[tuple[int, Callable[[], bytes]]]:
        """Yield when, ns after the first one, and what makes the messages then."""
        for index, shown in enumerate(zip(*self._sources, strict=False)):
            yield shown[0][0], partial(self._messages, index, shown)

    def _messages(self, index: int, shown: Sequence[tuple[int, Picture]]) -> bytes:
        seen = self._cameras.heat_maps([picture for _, picture in shown])
        # Two cameras of one process are of one instant: clocks of their own would tell them apart.
        instant = instant_of(self._tasks[0], self._sources[0].info, index, shown[0][0])
        return b"".join(
            messages_of(maps, task, *instant) for maps, task in zip(seen, self._tasks, strict=True)
        )


class _Recorded:
    """The heat maps that a recording of ``video solve`` has of one camera: no picture, no network."""

    is_live = False

    def __init__(self, task: CameraTask) -> None:
        recording = open_recording(Path(task.place))
        receiver = HeatMapReceiver()
        every = [each for chunk in recording.chunks() for each in receiver.receive(chunk.data)]
        self._messages = [each for each in every if each.camera == task.name]
        if not self._messages:
            known = ", ".join(sorted({each.camera for each in every})) or "none"
            raise CameraError(f"{task.place} has no camera '{task.name}' (its cameras: {known})")

    def take(self, line: bytes) -> None:
        """Do nothing: whom it shows was decided when it was made."""

    def close(self) -> None:
        """Do nothing: nothing is open."""

    def __iter__(self) -> Iterator[tuple[int, Callable[[], bytes]]]:
        """Yield when, ns after the first one, and the message."""
        first = self._messages[0].time_ns
        for each in self._messages:
            yield each.time_ns - first, partial(encode_heat_maps, each)


@contextlib.contextmanager
def listening(host: str, port: int) -> Iterator[socket.socket]:
    """Listen on a TCP port. Raises ``CameraError`` where it cannot be had."""
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
        """Wait until somebody has connected."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._listener, selectors.EVENT_READ)
            while not self._receivers:
                selector.select(0.5)
                self._welcome()

    def offer(self, message: bytes) -> None:
        """Hand messages to every receiver, unless it is too far behind."""
        self._welcome()
        self.served.messages += 1
        for receiver in self._receivers:
            if len(receiver.waiting) > _MOST_WAITING:
                self.served.skipped += 1
            else:
                receiver.waiting += message
                self.served.sent += 1
        self._receivers = [receiver for receiver in self._receivers if _pushed(receiver)]

    def newest_line(self) -> bytes:
        """Return the last line that came since this was asked, of whoever is connected the longest and tells
        any."""
        lines = [line for receiver in self._receivers if (line := _last_line(receiver))]
        return lines[0] if lines else b""

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


def _last_line(receiver: _Receiver) -> bytes:
    """Return the last whole line of what a receiver has sent; what is no line is thrown away."""
    with contextlib.suppress(OSError):
        while data := receiver.connection.recv(1 << 16):
            receiver.received += data
            del receiver.received[: -2 * LONGEST]
    whole, separator, rest = bytes(receiver.received).rpartition(b"\n")
    receiver.received[:] = rest
    return whole.rpartition(b"\n")[2] if separator else b""


def _pushed(receiver: _Receiver) -> bool:
    """Send as much as the connection takes at once; False: it is gone."""
    try:
        taken = receiver.connection.send(receiver.waiting) if receiver.waiting else 0
    except BlockingIOError:
        return True
    except OSError:
        receiver.connection.close()
        return False
    del receiver.waiting[:taken]
    return True
