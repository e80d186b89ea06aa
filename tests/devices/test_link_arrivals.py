"""The queue between receive callback and reader."""

from __future__ import annotations

import asyncio

import pytest

from devices.arrivals import Arrivals
from devices.link import Chunk, LinkError


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
    arrivals = Arrivals("suit", limit_bytes=10)
    for index in range(6):
        arrivals.put(bytes([index]) * 4, index)
    arrivals.end()
    assert [chunk.arrived_ns async for chunk in arrivals] == [4, 5]
    assert (arrivals.dropped_chunks, arrivals.dropped_bytes) == (4, 16)


async def test_a_chunk_larger_than_the_limit_is_kept():
    arrivals = Arrivals("suit", limit_bytes=2)
    arrivals.put(b"large", 1)
    assert (await anext(arrivals)).data == b"large"
    assert arrivals.dropped_chunks == 0


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
