"""Poses as datagrams to one address."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Sequence
from typing import Protocol

from gateway.errors import OutputError
from gateway.frames import SkeletonFrame


class DatagramSender:
    """A socket and where it sends. output: whose it is, for errors."""

    def __init__(self, output: str, host: str, port: int) -> None:
        self._output = output
        self._host = host
        self._port = port
        self._socket: socket.socket | None = None
        self._address: tuple[object, ...] = ()

    async def open(self) -> None:
        """Find the address. Raises ``OutputError`` for a host that nobody knows."""
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)
        except OSError as error:
            raise OutputError(
                f"outputs.{self._output}: no such host '{self._host}' ({error.strerror}): correct host"
            ) from error
        family, kind, protocol, _, self._address = found[0]
        self._socket = socket.socket(family, kind, protocol)
        self._socket.setblocking(False)

    def send(self, datagrams: Sequence[bytes]) -> bool:
        """Send all; return whether the system took them.

        Raises ``OSError``, such as for a network that is away.
        """
        assert self._socket is not None
        try:
            for datagram in datagrams:
                self._socket.sendto(datagram, self._address)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Give the socket back."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class Encoder(Protocol):
    """Makes the datagrams of a frame."""

    def encode(self, frame: SkeletonFrame) -> list[bytes]:
        """Return the datagrams of a frame, in order of sending."""
        ...


class DatagramSink:
    """Sends what frames become to one address. name: of the output, for errors."""

    def __init__(self, name: str, host: str, port: int, encoder: Encoder) -> None:
        self._sender = DatagramSender(name, host, port)
        self._encoder = encoder

    async def open(self) -> None:
        """Find the address. Raises ``OutputError`` for a host that nobody knows."""
        await self._sender.open()

    def send(self, frame: SkeletonFrame) -> bool:
        """Send a frame; return whether the system took it.

        Raises ``OSError``, such as for a network that is away.
        """
        return self._sender.send(self._encoder.encode(frame))

    def close(self) -> None:
        """Give the socket back."""
        self._sender.close()
