"""A TCP port of this computer as a link, for programs that connect to the one that reads them."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import AsyncIterator, Collection, Sequence

from devices.arrivals import Arrivals
from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.link_counts import LinkCounts
from devices.listening import Network, Peers, listen_error
from devices.tcp_link import RECEIVE_BUFFER_BYTES, keep_alive

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
