"""Recordings as links."""

from __future__ import annotations

import asyncio

import pytest

from devices.link import Chunk, Framing, LinkError, SentChunk
from devices.recording_format import SENT
from devices.recording_writer import RecordingWriter, session_record
from devices.replay_link import ReplayLink, framings_of
from tests.patience import PATIENCE_S
from tests.simulated_time import in_simulated_time

LINKS = {"suit": Framing.BYTE_STREAM, "bus": Framing.CAN}
SUIT = {"suit": Framing.BYTE_STREAM}
STEP_NS = 20_000_000
CHUNKS = [Chunk(bytes([index]), 1000 + index * STEP_NS, list(LINKS)[index % 2]) for index in range(8)]


def record(path, links, chunks):
    with RecordingWriter(path, session_record(links), {}, 0) as recording:
        for chunk in chunks:
            recording.add_chunk(chunk, links[chunk.link])
            recording.flush()
    return path


@pytest.fixture
def both(tmp_path):
    return record(tmp_path / "both.log", LINKS, CHUNKS)


async def replay(link: ReplayLink) -> list[Chunk]:
    await link.open()
    async with asyncio.timeout(PATIENCE_S):
        return [chunk async for chunk in link]


async def test_chunks_come_back_with_their_times(both):
    link = ReplayLink(both, link="bus", speed=None)
    assert (link.name, link.framing) == ("bus", Framing.CAN)  # known before opening
    assert await replay(link) == CHUNKS[1::2]
    await link.close()
    assert await replay(link) == CHUNKS[1::2]
    assert link.defect is None


async def test_the_only_link_need_not_be_named_and_may_be_renamed(tmp_path):
    path = record(tmp_path / "log", SUIT, CHUNKS[::2])
    link = ReplayLink(path, speed=None, name="yesterday")
    chunks = await replay(link)
    assert [chunk.data for chunk in chunks] == [chunk.data for chunk in CHUNKS[::2]]
    assert {chunk.link for chunk in chunks} == {"yesterday"}


async def test_all_links_come_in_the_recorded_order_under_their_names(both):
    link = ReplayLink(both, speed=None, name="all of it")
    assert link.contents == LINKS
    assert await replay(link) == CHUNKS


async def test_links_that_carry_no_packets_have_no_framing(tmp_path):
    path = record(tmp_path / "log", {"suit": Framing.CAN, "gnss": "gnss"}, [Chunk(b"a", 1, "suit")])
    assert framings_of(ReplayLink(path)) == {"suit": Framing.CAN}


async def test_what_was_sent_is_told_in_its_place(tmp_path):
    path = tmp_path / "log"
    with RecordingWriter(path, session_record(SUIT), {}, 0) as recording:
        recording.add_chunk(Chunk(b"a", 1, "suit"), Framing.BYTE_STREAM)
        recording.add(SENT + "suit", 2, b"what time is it?")
        recording.add_chunk(Chunk(b"b", 3, "suit"), Framing.BYTE_STREAM)
    link = ReplayLink(path, speed=None, name="arm")
    await link.open()
    assert [item async for item in link] == [
        Chunk(b"a", 1, "arm"),
        SentChunk(b"what time is it?", 2, "arm"),
        Chunk(b"b", 3, "arm"),
    ]


async def test_a_reader_that_is_held_reads_no_further(tmp_path):
    chunks = [Chunk(b"x", index, "suit") for index in range(100)]
    link = ReplayLink(record(tmp_path / "log", SUIT, chunks), speed=None)
    go_on = asyncio.Event()
    link.hold = go_on.wait
    reading = asyncio.ensure_future(replay(link))
    await asyncio.sleep(0.02)
    assert not reading.done()
    go_on.set()
    assert await reading == chunks


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_pace_is_that_of_the_recording(both, speed):
    async def came_s():
        link = ReplayLink(both, link="bus", speed=speed)
        await link.open()
        start_s = asyncio.get_running_loop().time()
        return [asyncio.get_running_loop().time() - start_s async for _ in link]

    due_s = [(chunk.arrived_ns - CHUNKS[0].arrived_ns) * 1e-9 / speed for chunk in CHUNKS[1::2]]
    assert in_simulated_time(came_s()) == pytest.approx(due_s, abs=1e-6)


async def test_other_tasks_run_at_full_speed(tmp_path):
    chunks = [Chunk(b"x", index, "suit") for index in range(1000)]
    link = ReplayLink(record(tmp_path / "log", SUIT, chunks), link="suit", speed=None)
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
    link = ReplayLink(record(tmp_path / "log", SUIT, chunks), link="suit")
    await link.open()
    reading = asyncio.ensure_future(_all(link))
    await asyncio.sleep(0.01)
    await link.close()
    assert await asyncio.wait_for(reading, PATIENCE_S) == [chunks[0]]


async def _all(link: ReplayLink) -> list[Chunk]:
    return [chunk async for chunk in link]


async def test_cut_off_tail_is_reported_after_what_is_before_it(tmp_path, caplog):
    path = tmp_path / "log"
    recording = RecordingWriter(path, session_record(LINKS), {}, 0)
    for chunk in CHUNKS:
        recording.add_chunk(chunk, LINKS[chunk.link])
        recording.flush()
    recording.abandon()
    with path.open("r+b") as file:
        file.truncate(recording.size - 100)
    link = ReplayLink(path, link="bus", speed=None)
    assert await replay(link) == CHUNKS[1:-2:2]
    assert "was not closed" in link.defect
    assert "was not closed" in caplog.text


async def test_commands_are_discarded(both):
    link = ReplayLink(both, link="suit", speed=None)
    await link.open()
    await link.write(b"sample now")
    assert [chunk async for chunk in link] == CHUNKS[::2]


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("sut", r"has no link 'sut' \(did you mean 'suit'\?\)"),
        ("xyz", r"has no link 'xyz' \(known: bus, suit\)"),
    ],
)
async def test_link_that_is_not_there_names_those_that_are(both, wanted, message):
    with pytest.raises(LinkError, match=message):
        await ReplayLink(both, link=wanted).open()


async def test_absent_and_foreign_files(tmp_path):
    with pytest.raises(LinkError, match="cannot be read: No such file"):
        await ReplayLink(tmp_path / "none").open()
    (tmp_path / "text").write_text("hello, this is text")
    with pytest.raises(LinkError, match="is no recording of mocap-gateway"):
        await ReplayLink(tmp_path / "text").open()
    with pytest.raises(LinkError, match="not open"):
        await anext(aiter(ReplayLink(tmp_path / "none")))


def test_speed_is_positive():
    with pytest.raises(ValueError, match="speed 0"):
        ReplayLink("log", speed=0)
