"""Threads and heaps of a process that runs for weeks."""

from __future__ import annotations

import asyncio
import ctypes
import subprocess
import sys
import threading

import psutil
import pytest

from gateway.support import memory
from gateway.support.memory import POOL_THREADS, bound_memory, give_back


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


LARGE_BLOCK = """
import asyncio, ctypes
from gateway.support.memory import bound_memory

class Heap(ctypes.Structure):
    names = "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost"
    _fields_ = [(name, ctypes.c_size_t) for name in names.split()]

async def main():
    bound_memory()

asyncio.run(main())
c = ctypes.CDLL(None)
c.malloc.restype, c.malloc.argtypes, c.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
c.mallinfo2.restype = Heap
c.free(c.malloc(16 << 20))  # by itself, glibc would take this for the size of an ordinary block from here on
before = c.mallinfo2().hblkhd
block = c.malloc(4 << 20)
print(c.mallinfo2().hblkhd - before)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="this C library cannot be asked")
def test_blocks_of_megabytes_stay_out_of_the_heap():
    """Where they go back to the system when they are free, whatever was allocated before."""
    done = subprocess.run([sys.executable, "-c", LARGE_BLOCK], capture_output=True, text=True, check=True)
    assert int(done.stdout) >= 4 << 20


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="this C library cannot be asked")
async def test_what_is_free_below_a_block_that_stays_goes_back_to_the_system(monkeypatch):
    """It used to stay with the process: megabytes an hour."""
    monkeypatch.setattr(memory, "GIVE_BACK_S", 0.01)
    c = ctypes.CDLL(None)
    c.malloc.restype, c.malloc.argtypes, c.free.argtypes = (
        ctypes.c_void_p,
        [ctypes.c_size_t],
        [ctypes.c_void_p],
    )
    size = 64 << 10  # too small for pages of its own
    burst = [c.malloc(size) for _ in range(512)]
    for block in burst:
        ctypes.memset(block, 1, size)
    stays = burst.pop()
    for block in burst:
        c.free(block)
    before = resident_bytes()
    giving = asyncio.create_task(give_back())
    for _ in range(1000):
        if resident_bytes() < before - (24 << 20):
            break
        await asyncio.sleep(0.01)
    giving.cancel()
    c.free(stays)
    assert resident_bytes() < before - (24 << 20)


def resident_bytes():
    return psutil.Process().memory_info().rss
