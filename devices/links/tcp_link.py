"""TCP as a link: a connection to a relay unit, serial server or emulator, or a port of this computer.

``TcpLink`` connects; ``TcpListenLink`` is for programs that connect to the one that reads them.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
from collections.abc import AsyncIterator, Collection, Sequence

from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.links.arrivals import Arrivals
from devices.links.link_counts import LinkCounts
from devices.links.listening import Network, Peers, listen_error

CONNECT_TIMEOUT_S = 5.0
RECEIVE_BUFFER_BYTES = 1 << 20
"""Asked of the system, which gives less by default. After the gateway stood still for long, a sender waits
for room for a whole segment, or for a timer of up to two minutes: on loopback segments are as large as the
window of the default buffer, and the room that reading makes in it is less."""

# A peer that vanishes without a word (power, radio) is noticed after 5 + 3 × 2 s of silence.
_KEEPALIVE = (
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 5),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 2),
    (socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3),
)


def keep_alive(connected: socket.socket) -> None:
    """Have the system notice when the other side vanishes."""
    for level, option, value in _KEEPALIVE:
        connected.setsockopt(level, option, value)


def connect_error(host: str, port: int, error: OSError) -> LinkError:
    """Return the error of a connection that could not be made, with its remedy."""
    place = f"{host}:{port}"
    if isinstance(error, socket.gaierror):
        return LinkError(f"unknown host '{host}': correct the name or give its address")
    if isinstance(error, TimeoutError):
        return LinkError(f"{place} does not answer: check the address, the network and the firewall")
    if isinstance(error, ConnectionRefusedError):
        return LinkError(
            f"{place} refused the connection: start what should listen there, or correct the port"
        )
    if error.errno in (errno.EHOSTUNREACH, errno.ENETUNREACH):
        return LinkError(f"{place} is unreachable: connect this computer to the network of the device")
    return LinkError(f"{place} cannot be connected: {error.strerror or error}")


class TcpLink:
    """Bytes of one TCP connection that the gateway makes, without delay in either direction."""

    framing = Framing.BYTE_STREAM

    def __init__(
        self,
        host: str,
        port: int,
        *,
        name: str | None = None,
        connect_timeout: float = CONNECT_TIMEOUT_S,
    ) -> None:
        self.name = name or f"tcp://{host}:{port}"
        self.host = host
        self.port = port
        self._connect_timeout = connect_timeout
        self.counts = LinkCounts()
        self._arrivals = Arrivals.never_opened(self.name)
        self._connection: _Connection | None = None

    async def open(self) -> None:
        """Connect. Raises ``LinkError``: refused, not reachable, no such name, or too slow."""
        if self._connection is not None and not self._arrivals.has_ended:
            raise LinkError(f"{self.name} is already open")
        arrivals = Arrivals(self.name, counts=self.counts)
        connecting = asyncio.get_running_loop().create_connection(
            lambda: _Connection(arrivals, f"{self.host}:{self.port}"), self.host, self.port
        )
        try:
            async with asyncio.timeout(self._connect_timeout):
                _, self._connection = await connecting
        except OSError as error:  # TimeoutError and gaierror among them
            raise connect_error(self.host, self.port, error) from error
        self._arrivals = arrivals

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Send ``data``, waiting while the peer does not take it. Raises ``LinkError`` when it is gone."""
        if self._connection is None or self._arrivals.has_ended:
            raise self._arrivals.error or LinkError(f"{self.name} is closed")
        await self._connection.send(data)

    async def close(self) -> None:
        """Hang up; iterating ends."""
        if self._connection is not None:
            await self._connection.close()
            self._connection = None


class _Connection(asyncio.Protocol):
    """Stamps what arrives, and holds writers back while the peer does not take it."""

    def __init__(self, arrivals: Arrivals, place: str) -> None:
        self._arrivals = arrivals
        self._place = place
        self._transport: asyncio.Transport | None = None
        self._may_write = asyncio.Event()
        self._may_write.set()
        self._gone = asyncio.Event()

    async def send(self, data: bytes) -> None:
        """Write bytes, and wait while too much is pending.

        Raises ``LinkError`` once the connection is closed.
        """
        await self._may_write.wait()
        if self._transport is None or self._arrivals.has_ended:
            raise self._arrivals.error or LinkError(f"{self._place} closed the connection")
        # The wait afterwards slows the caller down while the other end does not read.
        self._transport.write(data)
        await self._may_write.wait()

    async def close(self) -> None:
        """Abort the connection, and wait until it is gone."""
        self._arrivals.end()
        if self._transport is not None:
            self._transport.abort()
            await self._gone.wait()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Set up a new connection's socket."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        connected = transport.get_extra_info("socket")
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        keep_alive(connected)

    def data_received(self, data: bytes) -> None:
        """Hand bytes over with the time of their arrival."""
        self._arrivals.put(data, gateway_time_ns())

    def connection_lost(self, error: Exception | None) -> None:
        """End the link, and wake the task that waits to write."""
        lost = LinkError(f"connection to {self._place} was lost: {error}") if error is not None else None
        self._arrivals.end(lost)
        self._gone.set()
        self._may_write.set()

    def pause_writing(self) -> None:
        """Keep ``send`` waiting: the system takes no more."""
        self._may_write.clear()

    def resume_writing(self) -> None:
        """Let ``send`` go on."""
        self._may_write.set()


_log = logging.getLogger(__name__)


class TcpListenLink:
    """Bytes of the caller that is connected, one at a time.

    While nobody is, the link stays open and silent. Who connects from the same address takes the place of
    the connection before, which may be one that has vanished; others are turned away until it ends.
    """

    framing = Framing.BYTE_STREAM

    def __init__(
        self, host: str, port: int = 0, *, name: str | None = None, peers: Collection[Network] = ()
    ) -> None:
        """Prepare to listen; ``peers`` may connect, others are counted and turned away; empty: any."""
        self.name = name or f"tcp://{host}:{port}?listen=1"
        self.host = host
        self.port = port
        """Port asked for; 0 lets the system choose (see ``address``)."""
        self.counts = LinkCounts()
        self.peers = Peers(self.name, peers, self.counts, _log, "it is turned away")
        self._arrivals = Arrivals.never_opened(self.name)
        self._server: asyncio.Server | None = None
        self._caller: _Caller | None = None

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens: host and port. Raises ``LinkError`` while not open."""
        if self._server is None:
            raise LinkError(f"{self.name} is not open")
        host, port, *_ = self._server.sockets[0].getsockname()
        return str(host), int(port)

    async def open(self) -> None:
        """Listen on the address. Raises ``LinkError``: taken, or none of this machine's."""
        if self._server is not None:
            raise LinkError(f"{self.name} is already open")
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(lambda: _Caller(self), self.host, self.port)
        except OSError as error:
            raise listen_error("TCP", self.name, self.host, self.port, error) from error
        self._arrivals = Arrivals(self.name, counts=self.counts)

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Send to the connected caller. Raises ``LinkError`` without one."""
        if self._caller is None:
            raise LinkError(f"{self.name}: nobody is connected to write to")
        self._caller.transport.write(data)

    async def close(self) -> None:
        """Stop listening and hang up; iterating ends."""
        if self._server is not None:
            self._server.close()
            self._server = None
        if self._caller is not None:
            self._caller.transport.abort()
            self._caller = None
        self._arrivals.end()

    def joined(self, caller: _Caller) -> bool:
        """Return whether a caller who connected may stay."""
        if self._server is None or not self.peers.admits(caller.host):
            return False
        if self._caller is not None:
            if self._caller.host != caller.host:
                self.counts.refused += 1
                _log.warning(
                    "%s: %s is turned away while %s is connected", self.name, caller.host, self._caller.host
                )
                return False
            # The same host again: its former connection is dead, though the system does not know yet.
            self._caller.transport.abort()
        self._caller = caller
        _log.info("%s: %s has connected", self.name, caller.host)
        return True

    def received(self, caller: _Caller, data: bytes) -> None:
        """Take what a caller sent, if it is the one that is connected."""
        if caller is self._caller:
            self._arrivals.put(data, gateway_time_ns())

    def left(self, caller: _Caller) -> None:
        """Note that a caller is gone."""
        if caller is self._caller:
            self._caller = None
            _log.info("%s: %s has hung up", self.name, caller.host)


class _Caller(asyncio.Protocol):
    """One connection that a caller made."""

    transport: asyncio.Transport

    def __init__(self, link: TcpListenLink) -> None:
        self._link = link
        self.host = ""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Set up the caller's socket, and hang up if the link does not want it."""
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self.host = str(transport.get_extra_info("peername")[0])
        connected = transport.get_extra_info("socket")
        # Commands are small and must not wait for more to be sent with them.
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        keep_alive(connected)
        if not self._link.joined(self):
            transport.abort()

    def data_received(self, data: bytes) -> None:
        """Hand bytes over to the link."""
        self._link.received(self, data)

    def connection_lost(self, error: Exception | None) -> None:
        """Report to the link that the caller is gone."""
        self._link.left(self)
