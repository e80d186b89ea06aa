"""Wakes an event loop at an instant, far more precisely than its own timers do.

The timers of the default event loop are as coarse as a millisecond. A thread that sleeps is woken within
some tens of microseconds, and hands over at once; what the loop is busy with comes on top.
"""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Callable

from devices.link import gateway_time_ns

_LONGEST_NAP_S = 0.25
"""So that the thread notices that it is no longer wanted."""


class PreciseAlarm:
    """One thread for one event loop. ``close`` it when it is no longer needed."""

    def __init__(self, clock_ns: Callable[[], int] = gateway_time_ns) -> None:
        self._clock_ns = clock_ns
        self._loop = asyncio.get_running_loop()
        self._wanted: queue.SimpleQueue[tuple[int, asyncio.Event] | None] = queue.SimpleQueue()
        self._is_closed = False
        threading.Thread(target=self._wait_for_alarms, name="precise alarm", daemon=True).start()

    async def wait_until(self, instant_ns: int) -> None:
        """Sleep until a gateway time; one that has passed only gives way to other tasks."""
        if instant_ns <= self._clock_ns():
            await asyncio.sleep(0)
            return
        reached = asyncio.Event()
        self._wanted.put((instant_ns, reached))
        await reached.wait()

    def close(self) -> None:
        """End the thread; who still waits is not woken."""
        self._is_closed = True
        self._wanted.put(None)

    def _wait_for_alarms(self) -> None:
        while (wanted := self._wanted.get()) is not None:
            instant_ns, reached = wanted
            while not self._is_closed and (left_ns := instant_ns - self._clock_ns()) > 0:
                time.sleep(min(left_ns * 1e-9, _LONGEST_NAP_S))
            if self._is_closed or self._loop.is_closed():
                return
            self._loop.call_soon_threadsafe(reached.set)
