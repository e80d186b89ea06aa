"""Modules on a wireless network: each sends datagrams from a socket of its own, and receives what comes."""

from __future__ import annotations

import asyncio
import socket

from devices.emulators.transports.transport import OnReceive, ignore
from devices.link import Framing

_LARGEST_DATAGRAM = 65536


class UdpTransport:
    """To one port of a gateway, which need not be there yet: datagrams that nobody takes are lost."""

    framing = Framing.BYTE_STREAM

    def __init__(self, port: int, host: str = "127.0.0.1", from_port: int = 0) -> None:
        """Send to the gateway's ``port``; ``from_port`` is the device's, where there is one alone; 0: any."""
        self.host = host
        self._from_port = from_port
        self.port = port
        self.on_receive: OnReceive = ignore
        self._sockets: dict[int | None, socket.socket] = {}
        self._is_open = False

    @property
    def url(self) -> str:
        """What the gateway listens on; empty while closed."""
        return f"udp://{self.host}:{self.port}" if self._is_open else ""

    async def open(self) -> None:
        """Begin; sockets are opened as devices begin to send.

        Raises ``OSError`` for a host without address.
        """
        try:
            await asyncio.get_running_loop().getaddrinfo(self.host, self.port, type=socket.SOCK_DGRAM)
        except UnicodeError as error:  # of names with parts that none may have
            raise OSError(f"{self.host}: {error}") from error
        self._is_open = True

    def offer(self, data: bytes) -> bool:
        """Send from no device; without bytes nothing is held back, and so there is nothing to move on."""
        return not data or self.offer_from(None, data)

    def offer_from(self, device: int | None, data: bytes) -> bool:
        """Send a datagram from a device's socket; False when the system does not take it."""
        if not self._is_open:
            return False
        try:
            self._socket_of(device).send(data)
        except OSError:  # nobody listens, or no room: the datagram is lost, as on the air
            return False
        return True

    def listen(self, on_receive: OnReceive) -> None:
        """Hand on what comes back, with the number of the device that it came to."""
        self.on_receive = on_receive

    async def close(self) -> None:
        """Close all sockets."""
        self._is_open = False
        loop = asyncio.get_running_loop()
        for opened in self._sockets.values():
            loop.remove_reader(opened)
            opened.close()
        self._sockets.clear()

    def _socket_of(self, device: int | None) -> socket.socket:
        opened = self._sockets.get(device)
        if opened is None:
            opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            opened.setblocking(False)
            if self._from_port:
                # Connected sockets share a port: each receives from the one that it speaks to.
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                opened.bind(("", self._from_port))
            opened.connect((self.host, self.port))
            asyncio.get_running_loop().add_reader(opened, self._receive, device, opened)
            self._sockets[device] = opened
        return opened

    def _receive(self, device: int | None, opened: socket.socket) -> None:
        try:
            data = opened.recv(_LARGEST_DATAGRAM)
        except OSError:  # nobody listens at the other end
            return
        self.on_receive(data, device)
