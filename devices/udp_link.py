"""Datagrams of modules or relay units as a link: each datagram is one chunk."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import AsyncIterator
from typing import Any

from devices.arrivals import Arrivals
from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.link_counts import (
    ANCILLARY_SIZE,
    LinkCounts,
    LostBefore,
    SystemCount,
    ask_for_drops,
    told_drops,
)

LOOPBACK = "127.0.0.1"
# The usual 208 KiB hold only 92 small datagrams or so, a fraction of a second of a full suit.
_RECEIVE_BUFFER_BYTES = 4 * 1024 * 1024
_LARGEST_DATAGRAM = 65536
_DATAGRAMS_A_TURN = 64


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
        self.counts = LinkCounts()
        self._arrivals = Arrivals.never_opened(self.name)
        self._drops = SystemCount(self.counts, LostBefore.KERNEL_OVERFLOW)
        self._socket: socket.socket | None = None
        self._latest_sender: tuple[Any, ...] | None = None

    @property
    def address(self) -> tuple[str, int]:
        """Where datagrams are received: host and port. Raises ``LinkError`` while not open."""
        host, port, *_ = self._open_socket().getsockname()
        return str(host), int(port)

    @property
    def dropped_bytes(self) -> int:
        """Bytes dropped since opening because the reader was too far behind."""
        return self._arrivals.dropped_bytes

    async def open(self) -> None:
        """Listen on the address. Raises ``LinkError``: taken, or none of this machine's."""
        if self._socket is not None:
            raise LinkError(f"{self.name} is already open")
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(
                self.host, self.port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
            )
            self._socket = _bound(*found[0])
        except OSError as error:
            raise self._open_error(error) from error
        self._drops = SystemCount(self.counts, LostBefore.KERNEL_OVERFLOW)
        self._arrivals = Arrivals(self.name, counts=self.counts)
        loop.add_reader(self._socket, self._receive, self._socket)

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes) -> None:
        """Send one datagram to the latest sender. Raises ``LinkError`` when nobody sent one yet."""
        bound = self._open_socket()
        if self._latest_sender is None:
            raise LinkError(f"{self.name}: nobody to write to until a first datagram has come")
        try:
            bound.sendto(data, self._latest_sender)
        except OSError as error:
            raise LinkError(f"{self.name} did not send: {error.strerror}") from error

    async def close(self) -> None:
        """Stop listening; iterating ends."""
        self._release(None)

    def _receive(self, bound: socket.socket) -> None:
        for _ in range(_DATAGRAMS_A_TURN):
            try:
                data, ancillary, _, sender = bound.recvmsg(_LARGEST_DATAGRAM, ANCILLARY_SIZE)
            except BlockingIOError:
                return
            except ConnectionRefusedError:
                continue  # the last sender does not listen; it may send all the same
            except OSError as error:
                self._release(LinkError(f"UDP socket was lost: {error}"))
                return
            if (dropped := told_drops(ancillary)) is not None:
                self._drops.now(dropped)
            self._arrivals.put(data, gateway_time_ns())
            self._latest_sender = sender

    def _release(self, error: LinkError | None) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None
            self._latest_sender = None
            self._arrivals.end(error)

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise LinkError(f"{self.name} is not open")
        return self._socket

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


def _bound(family: int, kind: int, protocol: int, _name: str, address: tuple[Any, ...]) -> socket.socket:
    """A socket that receives there, and tells what the kernel had to drop. Raises OSError."""
    made = socket.socket(family, kind, protocol)
    try:
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        ask_for_drops(made)
        made.bind(address)
    except OSError:
        made.close()
        raise
    return made
