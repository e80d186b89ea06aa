"""A receiver with an Ethernet socket: a TCP server that gateways connect to."""

from __future__ import annotations

import asyncio

from devices.emulators.transports.transport import OnReceive, ignore
from devices.link import Framing

_HOST = "127.0.0.1"
_BUFFER_LIMIT = 64 * 1024


class TcpTransport:
    """Sends the same bytes to whoever is connected; clients come after one another or side by side.

    A client too slow for the stream misses whole chunks. What clients send is one stream to the suit,
    whoever sent it.
    """

    framing = Framing.BYTE_STREAM

    def __init__(self, port: int = 0) -> None:
        """Prepare to listen; port 0 takes a free one."""
        self.port = port
        """Port listened on, once open."""
        self.connections_made = 0
        """Clients accepted so far."""
        self._clients: set[asyncio.Transport] = set()
        self._server: asyncio.Server | None = None
        self.on_receive: OnReceive = ignore

    @property
    def url(self) -> str:
        """Where a host finds it, as a ``url`` of its configuration; empty while closed."""
        return f"tcp://{_HOST}:{self.port}" if self._server is not None else ""

    async def open(self) -> None:
        """Listen. Raises ``OSError`` when the port is taken."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Client(self), _HOST, self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    def offer(self, data: bytes) -> bool:
        """Send to every client that keeps up; False when there is none."""
        ready = [client for client in self._clients if client.get_write_buffer_size() < _BUFFER_LIMIT]
        for client in ready:
            if data:
                client.write(data)
        return bool(ready)

    def listen(self, on_receive: OnReceive) -> None:
        """Hand what any client sends to a callback."""
        self.on_receive = on_receive

    async def close(self) -> None:
        """Stop listening and disconnect after what was accepted is sent."""
        if self._server is not None:
            self._server.close()
            self._server = None
        for client in tuple(self._clients):
            client.close()

    def joined(self, client: asyncio.Transport) -> None:
        """Count a client that has connected."""
        self.connections_made += 1
        self._clients.add(client)

    def left(self, client: asyncio.Transport) -> None:
        """Forget a client that has gone."""
        self._clients.discard(client)


class _Client(asyncio.Protocol):
    def __init__(self, server: TcpTransport) -> None:
        self._server = server

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Report a client to the server."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._server.joined(transport)

    def data_received(self, data: bytes) -> None:
        """Hand the client's bytes on."""
        self._server.on_receive(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Report to the server that the client is gone."""
        self._server.left(self._transport)
