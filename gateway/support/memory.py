"""Memory of a process that runs for weeks: what its threads add is bounded, and there from the start."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import threading
import weakref
from concurrent.futures import ThreadPoolExecutor

POOL_THREADS = 8
"""For what blocks: opening and closing ports, writing to CAN buses, reading configurations."""
MOST_ARENAS = 2
"""Of the C library: the main thread's, and one that all others share."""
LARGE_BYTES = 1 << 20
"""Blocks of this size and more go back to the system as soon as they are free."""
GIVE_BACK_S = 30.0
_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # <malloc.h>
_bounded: weakref.WeakSet[asyncio.AbstractEventLoop] = weakref.WeakSet()


def bound_memory() -> None:
    """Bound the memory of the event loop's process, before it starts anything; a second call does nothing.

    glibc gives every thread that allocates a heap of its own, which never shrinks, and a pool of threads
    makes a new one whenever all are busy: megabytes at a time, hours after the start. Both are settled here.
    So is what counts as a large block: by itself that grows with the largest one ever freed, and from then on
    blocks of megabytes that were wanted for a moment stay with the process.

    What stands by now stands for as long as the process: the garbage collector goes through it once more,
    and never again. It took 90 ms now and then, in which every pose waited.
    """
    loop = asyncio.get_running_loop()
    if loop in _bounded:
        return
    _bounded.add(loop)
    limit = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries have no arenas to limit
    if limit is not None:
        limit(_M_ARENA_MAX, MOST_ARENAS)
        limit(_M_MMAP_THRESHOLD, LARGE_BYTES)
    loop.set_default_executor(_started_pool())
    gc.collect()
    gc.freeze()


def trim_heap() -> bool:
    """Return what is free within the heap to the system; False where the C library cannot be asked."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is None:
        return False
    trim(0)
    return True


async def give_back() -> None:
    """Return what is free within the heap to the system, every so often, for ever.

    By itself glibc gives back only what is free at the heap's upper end. Every burst (a second of samples at
    once, after the machine or a cable paused) moves that end up, and one small block that stays there
    keeps all below it: megabytes in an hour, though nothing more is in use. Returns where the C library
    cannot be asked.
    """
    can_trim = True
    while can_trim:
        await asyncio.sleep(GIVE_BACK_S)
        can_trim = await asyncio.to_thread(trim_heap)


def _started_pool() -> ThreadPoolExecutor:
    """Return a pool of which all threads run already."""
    pool = ThreadPoolExecutor(POOL_THREADS, thread_name_prefix="gateway")
    # Each thread waits here, so that no thread can take two of the tasks and leave another unstarted.
    all_run = threading.Barrier(POOL_THREADS + 1)
    for _ in range(POOL_THREADS):
        pool.submit(all_run.wait)
    all_run.wait()
    return pool
