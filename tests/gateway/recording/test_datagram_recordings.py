"""A link with several senders is recorded with them, and replays bit for bit."""

from __future__ import annotations

from dataclasses import replace

import pytest

from devices.link import Chunk
from devices.recording_format import chunk_of, message_of
from devices.replay_link import ReplayLink
from gateway.recording.reading import open_recording
from gateway.recording.recovery import recover
from gateway.recording.solving import recorded_setup, verify, write_solved


@pytest.fixture
def crowded_chunks(arm_chunks):
    """Each chunk comes in two datagrams, with one of a stranger or of the other sender in between."""
    chunks = []
    for index, chunk in enumerate(arm_chunks):
        cut = len(chunk.data) // 2
        sender = f"10.0.0.{index % 2}:7000"
        chunks.append(replace(chunk, data=chunk.data[:cut], sender=sender))
        chunks.append(replace(chunk, data=b"\x07", sender="10.0.0.66:1"))
        chunks.append(replace(chunk, data=chunk.data[cut:], sender=sender))
    return chunks


def test_poses_of_several_senders_come_out_again_bit_for_bit(record, crowded_chunks, tmp_path):
    recording = open_recording(record(chunks=crowded_chunks))
    assert list(recording.chunks()) == crowded_chunks
    found = verify(recording)
    assert (found.is_identical, found.difference, found.not_recorded) == (True, None, 0)
    assert found.compared > 150
    solved = tmp_path / "solved.mcap"
    write_solved(recording, solved, recorded_setup(recording))
    recovered = tmp_path / "recovered.mcap"
    recover(solved, recovered)
    assert list(open_recording(recovered).chunks()) == crowded_chunks


async def test_a_replay_gives_the_senders_too(record, crowded_chunks):
    link = ReplayLink(record(chunks=crowded_chunks), speed=None)
    await link.open()
    assert [item async for item in link if isinstance(item, Chunk)] == crowded_chunks
    await link.close()


@pytest.mark.parametrize("data", [b"", b"\x05abc", b"\x01"])
def test_a_damaged_datagram_is_no_chunk(data):
    assert chunk_of("/datagrams/wifi", 1, data) is None


def test_an_overlong_sender_stays_readable(arm_chunks):
    chunk = replace(arm_chunks[0], sender="x" * 300)
    assert chunk_of(message_of(chunk)[0], chunk.arrived_ns, message_of(chunk)[1]) == replace(
        chunk, sender="x" * 255
    )
