"""Datagrams of modules or relay units as a link: each datagram is one chunk."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import AsyncIterator
from typing import Any

from devices.arrivals import Arrivals
from devices.link import Chunk, Framing, LinkError, gateway_time_ns

LOOPBACK = "127.0.0.1"
# The usual 208 KiB hold only 92 small datagrams or so, a fraction of a second of a full suit.
_RECEIVE_BUFFER_BYTES = 4 * 1024 * 1024


class UdpLink:
    """Datagrams arriving at one port, from any sender.

    Bound to this computer alone unless another address is given. What is written goes to the
    sender of the latest datagram.
    """

    framing = Framing.BYTE_STREAM

    def __init__(self, host: str = LOOPBACK, port: int = 0, *, name: str | None = None) -> None:
        self.name = name or f"udp://{host}:{port}"
        self.host = host
        self.port = port
        """Port asked for; 0 lets the system choose (see ``address``)."""
        self._arrivals = Arrivals.never_opened(self.name)
        self._receiver: _Receiver | None = None

    @property
    def address(self) -> tuple[str, int]:
        """Where datagrams are received: host and port. Raises ``LinkError`` while not open."""
        host, port, *_ = self._open_receiver().transport.get_extra_info("sockname")
        return str(host), int(port)

    @property
    def dropped_bytes(self) -> int:
        """Bytes dropped since opening because the reader was too far behind."""
        return self._arrivals.dropped_bytes

    async def open(self) -> None:
        """Listen on the address. Raises ``LinkError``: taken, or none of this machine's."""
        if self._receiver is not None:
            raise LinkError(f"{self.name} is already open")
        arrivals = Arrivals(self.name)
        try:
            _, self._receiver = await asyncio.get_running_loop().create_datagram_endpoint(
                lambda: _Receiver(arrivals), local_addr=(self.host, self.port)
            )
        except OSError as error:
            raise self._open_error(error) from error
        self._arrivals = arrivals

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes) -> None:
        """Send one datagram to the latest sender. Raises ``LinkError`` when nobody sent one yet."""
        receiver = self._open_receiver()
        if receiver.latest_sender is None:
            raise LinkError(f"{self.name}: nobody to write to until a first datagram has come")
        receiver.transport.sendto(data, receiver.latest_sender)

    async def close(self) -> None:
        """Stop listening; iterating ends."""
        if self._receiver is not None:
            self._receiver.transport.close()
            self._receiver = None
            self._arrivals.end()

    def _open_receiver(self) -> _Receiver:
        if self._receiver is None:
            raise LinkError(f"{self.name} is not open")
        return self._receiver

    def _open_error(self, error: OSError) -> LinkError:
        if isinstance(error, socket.gaierror):
            return LinkError(
                f"unknown host '{self.host}': give an address of this computer, or 0.0.0.0 for all"
            )
        if error.errno == errno.EADDRINUSE:
            return LinkError(f"UDP port {self.port} is in use: stop the other program or choose another port")
        if error.errno == errno.EADDRNOTAVAIL:
            return LinkError(
                f"{self.host} is not an address of this computer: use one that is, or 0.0.0.0 for all"
            )
        if error.errno == errno.EACCES:
            return LinkError(f"UDP port {self.port} is reserved for the system: choose one above 1023")
        return LinkError(f"{self.name} cannot be opened: {error.strerror or error}")


class _Receiver(asyncio.DatagramProtocol):
    transport: asyncio.DatagramTransport

    def __init__(self, arrivals: Arrivals) -> None:
        self.latest_sender: tuple[Any, ...] | None = None
        self._arrivals = arrivals

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        self.transport = transport
        bound = transport.get_extra_info("socket")
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)

    def datagram_received(self, data: bytes, address: tuple[Any, ...]) -> None:
        self._arrivals.put(data, gateway_time_ns())
        self.latest_sender = address

    def connection_lost(self, error: Exception | None) -> None:
        self._arrivals.end(LinkError(f"UDP socket was lost: {error}") if error is not None else None)
