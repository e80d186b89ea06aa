"""Threads and heaps of a process that runs for weeks."""

from __future__ import annotations

import asyncio
import threading

from gateway.memory import POOL_THREADS, bound_memory


def pool_threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.startswith("gateway_")}


async def test_all_threads_of_the_pool_are_there_from_the_start():
    others = pool_threads()
    bound_memory()
    begun = pool_threads() - others
    assert len(begun) == POOL_THREADS
    bound_memory()  # as a second service in the same loop does, after a changed configuration
    barrier = threading.Barrier(POOL_THREADS)

    def own_thread() -> threading.Thread:
        barrier.wait(10.0)  # until all of them are at work
        return threading.current_thread()

    assert set(await asyncio.gather(*(asyncio.to_thread(own_thread) for _ in begun))) == begun
    assert pool_threads() - others == begun
