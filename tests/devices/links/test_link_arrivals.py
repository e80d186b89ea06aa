"""The queue between receive callback and reader."""

from __future__ import annotations

import asyncio

import pytest

from devices.link import Chunk, LinkError
from devices.links.arrivals import HAND_OVER_S, SMALL_BYTES, Arrivals
from devices.links.link_counts import LinkCounts


async def test_chunks_come_in_order_with_their_times():
    arrivals = Arrivals("suit")
    arrivals.put(b"a", 1)
    arrivals.put(b"bc", 5)
    arrivals.end()
    assert [chunk async for chunk in arrivals] == [Chunk(b"a", 1, "suit"), Chunk(b"bc", 5, "suit")]


async def test_reader_that_waits_is_woken():
    arrivals = Arrivals("suit")
    reading = asyncio.ensure_future(anext(arrivals))
    await asyncio.sleep(0)
    assert not reading.done()
    arrivals.put(b"x", 7)
    assert await reading == Chunk(b"x", 7, "suit")


async def wakings_of(arrivals, sizes, pause_s):
    """How often a reader was woken by chunks of these sizes, and what it read each time."""
    read, told = [[]], asyncio.Event()

    async def reader():
        async for chunk in arrivals:
            read[-1].append(chunk)
            if not arrivals._chunks:
                read.append([])
        told.set()

    reading = asyncio.ensure_future(reader())
    await asyncio.sleep(0)
    for k, size in enumerate(sizes):
        arrivals.put(bytes(size), k)
        await asyncio.sleep(pause_s)
    arrivals.end()
    await told.wait()
    await reading
    return [chunks for chunks in read if chunks]


async def test_small_chunks_that_come_fast_are_handed_over_together_each_with_its_time():
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    read = await wakings_of(Arrivals("suit"), [16] * 200, 0)
    assert len(read) <= 2 + (loop.time() - begun_s) / HAND_OVER_S  # the first at once, the last by the end
    assert [chunk.arrived_ns for chunks in read for chunk in chunks] == list(range(200))


async def test_chunks_that_come_slowly_and_large_ones_are_handed_over_at_once():
    assert len(await wakings_of(Arrivals("suit"), [16] * 5, 3 * HAND_OVER_S)) == 5
    assert len(await wakings_of(Arrivals("suit"), [SMALL_BYTES] * 20, 0)) == 20


async def test_a_small_chunk_waits_a_millisecond_and_no_longer():
    arrivals = Arrivals("suit")
    arrivals.put(b"first", 1)
    await anext(arrivals)
    reading = asyncio.ensure_future(anext(arrivals))
    await asyncio.sleep(0)
    arrivals.put(b"second", 2)
    await reading
    reading = asyncio.ensure_future(anext(arrivals))
    await asyncio.sleep(0)
    arrivals.put(b"third", 3)
    await asyncio.sleep(0)
    assert not reading.done()
    async with asyncio.timeout(1.0):
        assert (await reading).data == b"third"


async def test_chunks_before_the_loss_are_handed_out_first():
    arrivals = Arrivals("suit")
    arrivals.put(b"last words", 1)
    arrivals.end(LinkError("unplugged"))
    arrivals.put(b"too late", 2)
    assert (await anext(arrivals)).data == b"last words"
    for _ in range(2):  # it stays lost
        with pytest.raises(LinkError, match="unplugged"):
            await anext(arrivals)


async def test_first_end_counts():
    arrivals = Arrivals("suit")
    arrivals.end()
    arrivals.end(LinkError("afterwards"))
    assert [chunk async for chunk in arrivals] == []
    assert arrivals.error is None


async def test_oldest_are_dropped_and_counted_when_the_reader_is_too_far_behind():
    counts = LinkCounts()
    arrivals = Arrivals("suit", 10, counts)
    for index in range(6):
        arrivals.put(bytes([index]) * 4, index)
    arrivals.end()
    assert [chunk.arrived_ns async for chunk in arrivals] == [4, 5]
    assert (counts.behind, counts.handed) == (16, 8)


async def test_a_chunk_larger_than_the_limit_is_kept():
    counts = LinkCounts()
    arrivals = Arrivals("suit", 2, counts)
    arrivals.put(b"large", 1)
    assert (await anext(arrivals)).data == b"large"
    assert counts.behind == 0


async def test_cancelled_reader_loses_nothing():
    arrivals = Arrivals("suit")
    reading = asyncio.ensure_future(anext(arrivals))
    await asyncio.sleep(0)
    reading.cancel()
    arrivals.put(b"x", 1)
    await asyncio.gather(reading, return_exceptions=True)
    assert (await anext(arrivals)).data == b"x"


async def test_link_never_opened_says_so():
    with pytest.raises(LinkError, match=r"suit is not open: call open\(\)"):
        await anext(Arrivals.never_opened("suit"))
