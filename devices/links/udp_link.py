"""Datagrams of modules or relay units as a link: each datagram is one chunk."""

from __future__ import annotations

import asyncio
import functools
import logging
import socket
from collections.abc import AsyncIterator, Collection, Sequence
from typing import Any

from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.links.arrivals import Arrivals
from devices.links.link_counts import (
    ANCILLARY_SIZE,
    LinkCounts,
    LostBefore,
    SystemCount,
    ask_for_drops,
    reported_drops,
)
from devices.links.listening import Address, Network, Peers, listen_error, name_of

_log = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
# The usual 208 KiB hold only 92 small datagrams or so, a fraction of a second of a full suit.
_RECEIVE_BUFFER_BYTES = 4 * 1024 * 1024
_LARGEST_DATAGRAM = 65536
_DATAGRAMS_A_TURN = 64


class UdpLink:
    """Datagrams arriving at one port, from any number of senders: each chunk names its own.

    Bound to this computer alone unless another address is given. Who may be believed is not for the link
    to say: what is written goes to the senders that the writer names, one datagram each.
    """

    framing = Framing.BYTE_STREAM

    def __init__(
        self,
        host: str = LOOPBACK,
        port: int = 0,
        *,
        name: str | None = None,
        peers: Collection[Network] = (),
    ) -> None:
        """Prepare to receive; datagrams of ``peers`` are taken, others counted and dropped; empty: any."""
        self.name = name or f"udp://{host}:{port}"
        self.host = host
        self.port = port
        """Port asked for; 0 lets the system choose (see ``address``)."""
        self.counts = LinkCounts()
        self.peers = Peers(self.name, peers, self.counts, _log, "its datagrams are dropped")
        self._arrivals = Arrivals.never_opened(self.name)
        self._drops = SystemCount(self.counts, LostBefore.KERNEL_OVERFLOW)
        self._socket: socket.socket | None = None

    @property
    def address(self) -> tuple[str, int]:
        """Where datagrams are received: host and port. Raises ``LinkError`` while not open."""
        host, port, *_ = self._open_socket().getsockname()
        return str(host), int(port)

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
            raise listen_error("UDP", self.name, self.host, self.port, error) from error
        self._drops = SystemCount(self.counts, LostBefore.KERNEL_OVERFLOW)
        self._arrivals = Arrivals(self.name, counts=self.counts)
        loop.add_reader(self._socket, self._receive, self._socket)

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Send a datagram to each sender named. Raises ``LinkError`` when none is, or none can be sent to."""
        bound = self._open_socket()
        if not to:
            raise LinkError(f"{self.name}: nobody to write to until a module has sent something valid")
        failures: list[OSError] = []
        for sender in to:
            try:
                bound.sendto(data, _address_of(sender))
            except OSError as error:  # one that is gone must not keep it from the others
                failures.append(error)
        if len(failures) == len(to):
            raise LinkError(f"{self.name} did not send: {failures[0].strerror}") from failures[0]

    async def close(self) -> None:
        """Stop listening; iterating ends."""
        self._release(None)

    def _receive(self, bound: socket.socket) -> None:
        begun_ns = gateway_time_ns()
        for _ in range(_DATAGRAMS_A_TURN):
            try:
                data, ancillary, _, sender = bound.recvmsg(_LARGEST_DATAGRAM, ANCILLARY_SIZE)
            except BlockingIOError:
                self.counts.backlog_since_ns = None
                return
            except ConnectionRefusedError:
                continue  # the last sender does not listen; it may send all the same
            except OSError as error:
                self._release(LinkError(f"UDP socket was lost: {error}"))
                return
            if (dropped := reported_drops(ancillary)) is not None:
                self._drops.now(dropped)
            if self.peers.admits(sender[0]):
                self._arrivals.put(data, gateway_time_ns(), name_of(sender))
        self.counts.end_turn(begun_ns, bound)

    def _release(self, error: LinkError | None) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None
            self.counts.backlog_since_ns = None
            self._arrivals.end(error)

    def _open_socket(self) -> socket.socket:
        if self._socket is None:
            raise LinkError(f"{self.name} is not open")
        return self._socket


@functools.lru_cache(maxsize=512)
def _address_of(name: str) -> Address:
    """Return the address of a sender from its name."""
    host, _, port = name.rpartition(":")
    if not host.startswith("["):
        return host, int(port)
    host, _, scope = host[1:-1].partition("%")
    return host, int(port), 0, int(scope or 0)


def _bound(family: int, kind: int, protocol: int, _name: str, address: tuple[Any, ...]) -> socket.socket:
    """Return a socket bound there, which reports what the kernel had to drop. Raises ``OSError``."""
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
