"""The queue between a link's receive callback and the task that iterates the link."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Self

from devices.link import Chunk, LinkError
from devices.links.link_counts import LinkCounts

# More than a minute of the busiest serial line. A reader that is further behind has failed; keeping
# more would only trade memory for data that is too old to use.
LIMIT_BYTES = 8 * 1024 * 1024
HAND_OVER_S = 1e-3
"""Small chunks that come faster than this are handed over together: waking a reader costs several times what
most of them do."""
SMALL_BYTES = 512
"""Chunks below are small; a relay's batch of a whole suit is not."""


class Arrivals:
    """Chunks in the order they arrived, each with its time, for one reader; ``put`` never waits.

    The reader is woken at once after a pause and by a chunk that is not small, else ``HAND_OVER_S`` after it
    was woken last.
    When the reader is more than ``limit_bytes`` behind, the oldest chunks are dropped and counted.
    Chunks that arrived before the end are handed out before the end is reported.
    """

    def __init__(self, link: str, limit_bytes: int = LIMIT_BYTES, counts: LinkCounts | None = None) -> None:
        """Begin empty; ``counts`` are the link's, which go on from one connection to the next."""
        self._counts = counts or LinkCounts()
        self._link = link
        self._limit_bytes = limit_bytes
        self._chunks: deque[Chunk] = deque()
        self._waiting_bytes = 0
        self._has_ended = False
        self._error: LinkError | None = None
        self._reader: asyncio.Future[None] | None = None
        self._woken_s = 0.0  # on the event loop's clock
        self._alarm: asyncio.TimerHandle | None = None

    @classmethod
    def never_opened(cls, link: str) -> Self:
        """Return arrivals that raise ``LinkError`` when iterated, for a link that was never opened."""
        arrivals = cls(link)
        arrivals.end(LinkError(f"{link} is not open: call open() before reading"))
        return arrivals

    @property
    def has_ended(self) -> bool:
        """No more chunks will be put."""
        return self._has_ended

    @property
    def error(self) -> LinkError | None:
        """Why the link was lost; None while it is open and after an orderly end."""
        return self._error

    def put(self, data: bytes, arrived_ns: int, sender: str = "") -> None:
        """Add a chunk. After the end nothing is added."""
        if self._has_ended:
            return
        self._chunks.append(Chunk(data, arrived_ns, self._link, sender))
        self._waiting_bytes += len(data)
        self._counts.taken += len(data)
        self._counts.waiting += len(data)
        # The oldest go first, as poses live on the newest. A chunk larger than the limit still passes.
        while self._waiting_bytes > self._limit_bytes and len(self._chunks) > 1:
            oldest = self._chunks.popleft()
            self._waiting_bytes -= len(oldest.data)
            self._counts.behind += len(oldest.data)
            self._counts.waiting -= len(oldest.data)
        if self._reader is not None and not self._reader.done():
            self._hand_over(is_small=len(data) < SMALL_BYTES)

    def end(self, error: LinkError | None = None) -> None:
        """End the stream, with the reason when it was lost. The first call counts."""
        if self._has_ended:
            return
        self._has_ended = True
        self._error = error
        self._wake()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> Chunk:
        # What came before an error or the end is handed over first.
        while not self._chunks:
            if self._error is not None:
                raise self._error
            if self._has_ended:
                raise StopAsyncIteration
            self._reader = asyncio.get_running_loop().create_future()
            try:
                await self._reader
            finally:
                self._reader = None
        chunk = self._chunks.popleft()
        self._waiting_bytes -= len(chunk.data)
        self._counts.handed += len(chunk.data)
        self._counts.waiting -= len(chunk.data)
        return chunk

    def _hand_over(self, *, is_small: bool) -> None:
        """Wake the reader, now or when a millisecond has passed since it was woken last."""
        loop = asyncio.get_running_loop()
        due_s = self._woken_s + HAND_OVER_S
        if not is_small or loop.time() >= due_s:
            self._wake()
        elif self._alarm is None:
            self._alarm = loop.call_at(due_s, self._wake)

    def _wake(self) -> None:
        if self._alarm is not None:
            self._alarm.cancel()
            self._alarm = None
        if self._reader is not None and not self._reader.done():
            self._woken_s = self._reader.get_loop().time()
            self._reader.set_result(None)
