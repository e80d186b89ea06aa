"""Poses over a TCP connection that the gateway makes, to a program that listens for them."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable

from devices.links.tcp_link import CONNECT_TIMEOUT_S, connect_error, keep_alive
from gateway.errors import OutputError
from gateway.frames import SkeletonFrame

_log = logging.getLogger(__name__)

AGAIN_S = 1.0
"""Between two attempts to connect, s."""
_SEND_BUFFER_BYTES = 32 * 1024
"""Asked of the system: with its default, a program that reads slowly would see poses seconds old."""

Encode = Callable[[SkeletonFrame], list[bytes]]
"""Makes the messages of a frame, which stand one after another in the stream."""


class StreamSink:
    """Connects, and again for ever where nobody listens or the connection ends. Belongs to one event loop.

    A frame is sent whole or not at all: while a part of an earlier one still waits, frames are dropped.
    """

    def __init__(self, name: str, host: str, port: int, encode: Encode) -> None:
        """name: of the output, for errors and the log."""
        self._name, self._host, self._port = name, host, port
        self._encode = encode
        self._connecting: asyncio.Task[None] | None = None
        self._transport: asyncio.WriteTransport | None = None

    async def open(self) -> None:
        """Begin to connect. Raises ``OutputError`` for a host that nobody knows."""
        loop = asyncio.get_running_loop()
        try:
            await loop.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM)
        except OSError as error:
            raise OutputError(
                f"outputs.{self._name}: no such host '{self._host}' ({error.strerror}): correct host"
            ) from error
        self._connecting = asyncio.create_task(self._keep_connected())

    def send(self, frame: SkeletonFrame) -> bool:
        """Send a frame; return whether somebody listens and took all that was sent before."""
        if self._transport is None or self._transport.get_write_buffer_size():
            return False
        self._transport.write(b"".join(self._encode(frame)))
        return True

    def close(self) -> None:
        """Hang up, and connect no more."""
        if self._connecting is not None:
            self._connecting.cancel()
            self._connecting = None
        if self._transport is not None:
            self._transport.abort()
            self._transport = None

    async def _keep_connected(self) -> None:
        loop, has_complained = asyncio.get_running_loop(), False
        while True:
            try:
                async with asyncio.timeout(CONNECT_TIMEOUT_S):
                    transport, connection = await loop.create_connection(_Connection, self._host, self._port)
            except OSError as error:  # TimeoutError among them
                if not has_complained:
                    why = connect_error(self._host, self._port, error)
                    _log.warning("output %s: %s; it is tried again and again", self._name, why)
                has_complained = True
            else:
                _log.info("output %s: connected to %s:%d", self._name, self._host, self._port)
                self._transport, has_complained = transport, False
                try:
                    await connection.gone.wait()
                finally:
                    self._transport = None
                    transport.abort()
                _log.warning("output %s: %s:%d has hung up", self._name, self._host, self._port)
            await asyncio.sleep(AGAIN_S)


class _Connection(asyncio.Protocol):
    """Notes when the other side has hung up; what it says is passed over."""

    def __init__(self) -> None:
        self.gone = asyncio.Event()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Have small messages leave at once, and a dead peer be noticed."""
        connected = transport.get_extra_info("socket")
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        keep_alive(connected)

    def connection_lost(self, error: Exception | None) -> None:
        """Note that the other side has hung up."""
        self.gone.set()
