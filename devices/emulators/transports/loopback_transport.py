"""The far end of a loopback link, for a suit in the same process as its reader."""

from __future__ import annotations

import asyncio
import contextlib

from devices.emulators.loopback_link import LoopbackLink
from devices.emulators.transports.transport import OnReceive, ignore
from devices.link import LinkError

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
