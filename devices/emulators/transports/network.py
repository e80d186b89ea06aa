"""Suits on a network: a receiver with a TCP server, modules that send datagrams, either with a key.

Modules that have a key sign what they send, and obey nothing that is not signed.
"""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path
from urllib.parse import quote

from devices.emulators.transports.transport import OnReceive, ignore
from devices.link import Framing
from devices.links.signed_link import read_key
from firmware_protocol import DELIMITER, RELAY
from firmware_protocol.signing import SignedFrames

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


class _Ends:
    """The signing end of each device: all begin at 0, as modules do that have no clock and store nothing."""

    def __init__(self, key_file: Path) -> None:
        """Read the key. Raises ``ValueError`` as ``read_key`` does."""
        self.parameter = f"?key_file={quote(str(key_file.absolute()))}"
        self._key = read_key(key_file)
        self._of_devices: dict[int | None, SignedFrames] = {}

    def of(self, device: int | None) -> SignedFrames:
        """Return the frames of a device by its number; None: of the one that sends for all."""
        number = RELAY if device is None else device
        return self._of_devices.setdefault(device, SignedFrames(self._key, signer=number + 1))


class SignedTcpTransport(TcpTransport):
    """The whole suit behind one connection, signed."""

    def __init__(self, key_file: Path, port: int = 0) -> None:
        """Prepare to listen, with a key. Raises ``ValueError`` as ``read_key`` does."""
        super().__init__(port)
        self._ends = _Ends(key_file)
        self._partial = b""

    @property
    def url(self) -> str:
        """As of a TCP transport, with the key's file."""
        return super().url and super().url + self._ends.parameter

    def offer(self, data: bytes) -> bool:
        """Sign and send the wire frames that this completes."""
        frames, delimiter, partial = (self._partial + data).rpartition(DELIMITER)
        if not super().offer(self._ends.of(None).sign(frames + delimiter)):
            return False
        self._partial = partial
        return True

    def listen(self, on_receive: OnReceive) -> None:
        """Hand on what the host signed."""
        super().listen(lambda data, device=None: on_receive(self._ends.of(None).feed(data), device))


class SignedUdpTransport(UdpTransport):
    """Each device from an address of its own, and as a signer of its own."""

    def __init__(self, key_file: Path, port: int, host: str = "127.0.0.1") -> None:
        """Prepare to send, with a key. Raises ``ValueError`` as ``read_key`` does."""
        super().__init__(port, host)
        self._ends = _Ends(key_file)

    @property
    def url(self) -> str:
        """As of a UDP transport, with the key's file."""
        return super().url and super().url + self._ends.parameter

    def offer_from(self, device: int | None, data: bytes) -> bool:
        """Sign the wire frames of a datagram and send it."""
        return super().offer_from(device, self._ends.of(device).sign(data))

    def listen(self, on_receive: OnReceive) -> None:
        """Hand on what the host signed."""
        super().listen(lambda data, device=None: on_receive(self._ends.of(device).open(data), device))
