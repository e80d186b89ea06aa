"""Two links joined in memory: for tests, and for modules emulated in the same process."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence

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
