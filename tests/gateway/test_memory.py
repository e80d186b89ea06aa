"""Threads and heaps of a process that runs for weeks."""

from __future__ import annotations

import asyncio
import threading

from gateway.memory import POOL_THREADS, bound_memory


def _pool_threads() -> set[str]:
    return {thread.name for thread in threading.enumerate() if thread.name.startswith("gateway_")}


async def test_all_threads_of_the_pool_are_there_from_the_start():
    assert not _pool_threads()
    bound_memory()
    begun = _pool_threads()
    assert len(begun) == POOL_THREADS
    barrier = threading.Barrier(POOL_THREADS)
    more = [
        asyncio.to_thread(lambda: (barrier.wait(10.0), threading.current_thread().name)[1]) for _ in begun
    ]
    assert set(await asyncio.gather(*more)) == begun  # as many at once as there are, and no others
    assert _pool_threads() == begun
