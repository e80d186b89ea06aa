"""Libraries that can only block, read in a thread; what they give goes to the loop at once."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Callable
from typing import Generic, TypeVar

from devices.link import Chunk, LinkError, gateway_time_ns
from devices.links.arrivals import Arrivals
from devices.links.link_counts import LinkCounts

T = TypeVar("T")


class ThreadLink(ABC, Generic[T]):
    """A link by a library that can only block: opened, read and closed in threads."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.counts = LinkCounts()
        self._arrivals = Arrivals.never_opened(name)
        self._opened: T | None = None
        self._reader: ReaderThread | None = None

    async def open(self) -> None:
        """Open in a thread and begin to read. Raises ``LinkError``."""
        if self._opened is not None:
            raise LinkError(f"{self.name} is already open")
        self._opened = opened = await open_in_thread(self._open, self._close)
        self._arrivals = Arrivals(self.name, counts=self.counts)
        self._reader = ReaderThread(self.name, lambda: self._read(opened), self._arrivals)

    def __aiter__(self) -> AsyncIterator[Chunk]:
        return self._arrivals

    async def close(self) -> None:
        """End the reader, then what it read; does nothing on a closed link."""
        opened, reader = self._opened, self._reader
        # Before anything is awaited: a second close, or a write meanwhile, finds nothing.
        self._opened = self._reader = None
        self._arrivals.end()
        try:
            if reader is not None:
                await reader.stop()
        finally:
            if opened is not None:
                await asyncio.to_thread(self._close, opened)

    def _in_use(self) -> T:
        """Return what can be written to. Raises ``LinkError`` when it is closed or lost."""
        if self._opened is None or self._arrivals.has_ended:
            raise self._arrivals.error or LinkError(f"{self.name} is closed")
        return self._opened

    @abstractmethod
    def _open(self) -> T:
        """Return what was opened; may block. Raises ``LinkError``."""

    @abstractmethod
    def _read(self, opened: T) -> bytes:
        """Return what has arrived, after waiting briefly for the first of it."""

    @abstractmethod
    def _close(self, opened: T) -> None:
        """Give back what was opened; may block."""


class ReaderThread:
    """Calls ``read`` over and over and puts what it gives, stamped, into ``arrivals``.

    ``read`` waits briefly for data and gives ``b""`` when none came, so that stopping takes effect.
    Whatever it raises ends the arrivals as lost: drivers raise all kinds of exceptions.
    """

    def __init__(self, name: str, read: Callable[[], bytes], arrivals: Arrivals) -> None:
        self._name = name
        self._read = read
        self._arrivals = arrivals
        self._stopping = threading.Event()
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    async def stop(self) -> None:
        """Stop the thread; return when ``read`` will not be called again."""
        self._stopping.set()
        await asyncio.to_thread(self._thread.join)

    def _run(self) -> None:
        # The loop may be closed before the link was: then nobody is left to be woken.
        with contextlib.suppress(RuntimeError):
            while not self._stopping.is_set():
                try:
                    data = self._read()
                except Exception as error:
                    self._loop.call_soon_threadsafe(
                        self._arrivals.end, LinkError(f"{self._name} was lost: {error}")
                    )
                    return
                if data:
                    # Stamped after the last byte was taken: none seems to have come before it did.
                    arrived_ns = gateway_time_ns()
                    self._loop.call_soon_threadsafe(self._arrivals.put, data, arrived_ns)


async def open_in_thread(open_blocking: Callable[[], T], discard: Callable[[T], object]) -> T:
    """Return what ``open_blocking`` returns, opened without blocking the loop.

    A thread cannot be interrupted: when the caller is cancelled, what is opened after all is discarded.
    """
    opening = asyncio.ensure_future(asyncio.to_thread(open_blocking))

    def discard_result(done: asyncio.Future[T]) -> None:
        if not done.cancelled() and done.exception() is None:
            opening.get_loop().run_in_executor(None, discard, done.result())

    try:
        return await asyncio.shield(opening)
    except asyncio.CancelledError:
        opening.add_done_callback(discard_result)
        raise
