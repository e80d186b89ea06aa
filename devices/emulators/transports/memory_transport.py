"""Keeps what was sent, for tests and benchmarks."""

from __future__ import annotations

from devices.link import Framing, gateway_time_ns


class MemoryTransport:
    """Collects chunks with the gateway time at which they were offered."""

    def __init__(self, framing: Framing = Framing.BYTE_STREAM, capacity: int | None = None) -> None:
        """capacity: refuse further chunks once so many are held (None: never)."""
        self.framing = framing
        self.chunks: list[tuple[int, bytes]] = []
        """Gateway time (ns) and bytes, in order."""
        self._capacity = capacity

    @property
    def url(self) -> str:
        return ""

    async def open(self) -> None:
        """Nothing to open."""

    def offer(self, data: bytes) -> bool:
        """Keep data, unless the capacity is used up."""
        if self._capacity is not None and len(self.chunks) >= self._capacity:
            return False
        if data:
            self.chunks.append((gateway_time_ns(), data))
        return True

    async def close(self) -> None:
        """Nothing to close."""
