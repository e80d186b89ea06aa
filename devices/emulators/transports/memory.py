"""Suits in the process of their reader: two links joined in memory, or a list of what was sent."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Sequence

from devices.emulators.transports.transport import OnReceive, ignore
from devices.link import Chunk, Framing, LinkError, gateway_time_ns
from devices.links.arrivals import Arrivals
from devices.links.link_counts import LinkCounts


class LoopbackLink:
    """One end of a pair made by ``loopback_pair``.

    As on a wire, what is written while the other end is not open is lost. Closing one end ends the
    iteration of the other.
    """

    def __init__(self, name: str, framing: Framing, clock: Callable[[], int]) -> None:
        self.name = name
        self.framing = framing
        self._clock = clock
        self.counts = LinkCounts()
        self._arrivals = Arrivals.never_opened(name)
        self._is_open = False
        self._peer = self

    async def open(self) -> None:
        """Begin to take what the other end writes. Raises ``LinkError`` when it is open already."""
        if self._is_open:
            raise LinkError(f"{self.name} is already open")
        self._arrivals = Arrivals(self.name, counts=self.counts)
        self._is_open = True

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def write(self, data: bytes, to: Sequence[str] = ()) -> None:
        """Give ``data`` to the other end as one chunk, stamped now, and let its reader run."""
        if not self._is_open:
            raise self._arrivals.error or LinkError(f"{self.name} is closed")
        if self._peer._is_open:
            self._peer._arrivals.put(data, self._clock())
        await asyncio.sleep(0)

    async def close(self) -> None:
        """Close both ends, as a connection does."""
        if self._is_open:
            self._end(None)
            self._peer._end(None)

    def lose(self, reason: str) -> None:
        """Break the connection: both ends are lost, as when a cable is pulled."""
        for end in (self, self._peer):
            end._end(LinkError(f"{end.name} was lost: {reason}"))

    def _end(self, error: LinkError | None) -> None:
        self._is_open = False
        self._arrivals.end(error)


def loopback_pair(
    name: str = "loopback",
    far_name: str | None = None,
    *,
    framing: Framing = Framing.BYTE_STREAM,
    clock: Callable[[], int] = gateway_time_ns,
) -> tuple[LoopbackLink, LoopbackLink]:
    """Return two ends: what is written to one arrives at the other; ``clock`` stamps, ns of gateway time."""
    near = LoopbackLink(name, framing, clock)
    far = LoopbackLink(far_name or f"{name} (far end)", framing, clock)
    near._peer, far._peer = far, near
    return near, far


_MAX_WAITING = 1000
_REOPEN_S = 0.001


class LoopbackTransport:
    """Speaks through one end of ``loopback_pair``; the reader opens the other.

    The reader may come, go and come again. What is sent while it is away is lost.
    """

    def __init__(self, link: LoopbackLink) -> None:
        self.framing = link.framing
        self._link = link
        self._waiting: asyncio.Queue[bytes] = asyncio.Queue(_MAX_WAITING)
        self._on_receive: OnReceive = ignore
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def url(self) -> str:
        """Empty: only this process can reach it."""
        return ""

    async def open(self) -> None:
        """Open this end. Raises ``LinkError`` when it is open already."""
        await self._link.open()
        self._tasks = [asyncio.create_task(self._keep_writing()), asyncio.create_task(self._keep_reading())]

    def offer(self, data: bytes) -> bool:
        """Send; refused when the event loop has not come to send what was offered before."""
        if not self._tasks or self._waiting.full():
            return False
        if data:
            self._waiting.put_nowait(data)
        return True

    def listen(self, on_receive: OnReceive) -> None:
        """Hand what the other end writes to a callback."""
        self._on_receive = on_receive

    async def close(self) -> None:
        """Close this end; the other end's iteration ends."""
        for task in self._tasks:
            task.cancel()
        self._tasks = []
        await self._link.close()

    async def _keep_writing(self) -> None:
        while True:
            data = await self._waiting.get()
            with contextlib.suppress(LinkError):  # the reader has just gone
                await self._link.write(data)

    async def _keep_reading(self) -> None:
        while True:
            with contextlib.suppress(LinkError):
                async for chunk in self._link:
                    self._on_receive(chunk.data)
            # The other end was closed, and this one with it.
            await asyncio.sleep(_REOPEN_S)
            with contextlib.suppress(LinkError):
                await self._link.open()


class MemoryTransport:
    """Collects chunks with the gateway time at which they were offered."""

    def __init__(self, framing: Framing = Framing.BYTE_STREAM, capacity: int | None = None) -> None:
        """Hold chunks; refuse further ones once ``capacity`` are held (None: never)."""
        self.framing = framing
        self.chunks: list[tuple[int, bytes]] = []
        """Gateway time (ns) and bytes, in order."""
        self._capacity = capacity
        self._on_receive: OnReceive = ignore

    @property
    def url(self) -> str:
        """Empty: only this process can reach it."""
        return ""

    async def open(self) -> None:
        """Do nothing: there is nothing to open."""

    def offer(self, data: bytes) -> bool:
        """Keep data, unless the capacity is used up."""
        if self._capacity is not None and len(self.chunks) >= self._capacity:
            return False
        if data:
            self.chunks.append((gateway_time_ns(), data))
        return True

    def listen(self, on_receive: OnReceive) -> None:
        """Hand what comes by ``receive`` to a callback."""
        self._on_receive = on_receive

    def receive(self, data: bytes) -> None:
        """Be the host: send bytes, or CAN records, to the suit."""
        self._on_receive(data)

    async def close(self) -> None:
        """Do nothing: there is nothing to close."""
