"""Poses as UDP datagrams: sent, never waited for."""

from __future__ import annotations

import asyncio
import socket
from typing import Protocol

from gateway.errors import OutputError
from gateway.frames import SkeletonFrame


class Encoder(Protocol):
    """Makes the datagrams of a frame."""

    def encode(self, frame: SkeletonFrame) -> list[bytes]: ...


class DatagramSink:
    """Sends to one address. name: of the output, for errors."""

    def __init__(self, name: str, host: str, port: int, encoder: Encoder) -> None:
        self._name = name
        self._host = host
        self._port = port
        self._encoder = encoder
        self._socket: socket.socket | None = None
        self._address: tuple[object, ...] = ()

    async def open(self) -> None:
        """Find the address. Raises ``OutputError`` for a host that nobody knows."""
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise OutputError(
                f"outputs.{self._name}: no such host '{self._host}' ({error.strerror}): correct host"
            ) from error
        family, kind, protocol, _, self._address = found[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)

    def send(self, frame: SkeletonFrame) -> bool:
        """Whether the system took all datagrams. Raises ``OSError``, such as for a network that is away."""
        assert self._socket is not None
        try:
            for datagram in self._encoder.encode(frame):
                self._socket.sendto(datagram, self._address)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Give the socket back."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
