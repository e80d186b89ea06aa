"""Recordings as links."""

from __future__ import annotations

import asyncio
import time

import pytest

from devices.chunk_log import ChunkLogWriter, LoggedLink
from devices.link import Chunk, Framing, LinkError
from devices.replay_link import ReplayLink

LINKS = [LoggedLink("suit", Framing.BYTE_STREAM), LoggedLink("bus", Framing.CAN)]
STEP_NS = 20_000_000
CHUNKS = [Chunk(bytes([index]), 1000 + index * STEP_NS, LINKS[index % 2].name) for index in range(8)]


def record(path, links, chunks):
    with ChunkLogWriter(path, links) as log:
        for chunk in chunks:
            log.append(chunk)
    return path


@pytest.fixture
def both(tmp_path):
    return record(tmp_path / "both.log", LINKS, CHUNKS)


async def replay(link: ReplayLink) -> list[Chunk]:
    await link.open()
    async with asyncio.timeout(2):
        return [chunk async for chunk in link]


async def test_chunks_come_back_with_their_times(both):
    link = ReplayLink(both, link="bus", speed=None)
    assert (link.name, link.framing) == ("bus", Framing.CAN)  # known before opening
    assert await replay(link) == CHUNKS[1::2]
    await link.close()
    assert await replay(link) == CHUNKS[1::2]
    assert link.defect is None


async def test_the_only_link_need_not_be_named_and_may_be_renamed(tmp_path):
    path = record(tmp_path / "log", LINKS[:1], CHUNKS[::2])
    link = ReplayLink(path, speed=None, name="yesterday")
    chunks = await replay(link)
    assert [chunk.data for chunk in chunks] == [chunk.data for chunk in CHUNKS[::2]]
    assert {chunk.link for chunk in chunks} == {"yesterday"}


@pytest.mark.parametrize("speed", [1.0, 2.0])
async def test_pace_is_that_of_the_recording(both, speed):
    link = ReplayLink(both, link="bus", speed=speed)
    await link.open()
    start = time.monotonic()
    due = [(chunk.arrived_ns - CHUNKS[0].arrived_ns) * 1e-9 / speed for chunk in CHUNKS[1::2]]
    late = [time.monotonic() - start - expected async for _, expected in _zip(link, due)]
    assert len(late) == 4
    assert all(-0.001 < seconds < 0.05 for seconds in late)


async def _zip(link, values):
    remaining = iter(values)
    async for chunk in link:
        yield chunk, next(remaining)


async def test_other_tasks_run_at_full_speed(tmp_path):
    chunks = [Chunk(b"x", index, "suit") for index in range(1000)]
    link = ReplayLink(record(tmp_path / "log", LINKS, chunks), link="suit", speed=None)
    turns = 0

    async def count() -> None:
        nonlocal turns
        while True:
            turns += 1
            await asyncio.sleep(0)

    counting = asyncio.ensure_future(count())
    assert len(await replay(link)) == 1000
    counting.cancel()
    assert turns >= 1000 // 32


async def test_closing_ends_a_long_wait(tmp_path):
    chunks = [Chunk(b"a", 0, "suit"), Chunk(b"b", 3600 * 10**9, "suit")]
    link = ReplayLink(record(tmp_path / "log", LINKS, chunks), link="suit")
    await link.open()
    reading = asyncio.ensure_future(_all(link))
    await asyncio.sleep(0.01)
    await link.close()
    assert await asyncio.wait_for(reading, 1) == [chunks[0]]


async def _all(link: ReplayLink) -> list[Chunk]:
    return [chunk async for chunk in link]


async def test_cut_off_tail_is_reported_after_what_is_before_it(both, caplog):
    with both.open("r+b") as file:
        file.truncate(both.stat().st_size - 1)
    link = ReplayLink(both, link="bus", speed=None)
    assert await replay(link) == CHUNKS[1:-2:2]
    assert "cut off" in link.defect
    assert "cut off" in caplog.text


async def test_commands_are_discarded(both):
    link = ReplayLink(both, link="suit", speed=None)
    await link.open()
    await link.write(b"sample now")
    assert [chunk async for chunk in link] == CHUNKS[::2]


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (None, r"holds several links: choose one with link= \(suit, bus\)"),
        ("sut", "has no link 'sut': did you mean 'suit'"),
        ("xyz", "has no link 'xyz': it has: suit, bus"),
    ],
)
async def test_link_that_is_not_there_names_those_that_are(both, wanted, message):
    with pytest.raises(LinkError, match=message):
        await ReplayLink(both, link=wanted).open()


async def test_absent_and_foreign_files(tmp_path):
    with pytest.raises(LinkError, match="cannot be read: No such file"):
        await ReplayLink(tmp_path / "none").open()
    (tmp_path / "text").write_text("hello, this is text")
    with pytest.raises(LinkError, match="is not a chunk log"):
        await ReplayLink(tmp_path / "text").open()
    with pytest.raises(LinkError, match="not open"):
        await anext(aiter(ReplayLink(tmp_path / "none")))


def test_speed_is_positive():
    with pytest.raises(ValueError, match="speed 0"):
        ReplayLink("log", speed=0)
