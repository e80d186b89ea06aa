"""Keeps what was sent and receives what it is given, for tests and benchmarks."""

from __future__ import annotations

from devices.emulators.transports.transport import OnReceive, ignore
from devices.link import Framing, gateway_time_ns


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
