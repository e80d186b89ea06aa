"""Libraries that can only block, read in a thread; what they give goes to the loop at once."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from typing import TypeVar

from devices.arrivals import Arrivals
from devices.link import LinkError, gateway_time_ns

T = TypeVar("T")


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
