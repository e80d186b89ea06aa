"""Files of a relay's card: fetched whole, resumed where they were cut, verified, replayed."""

from __future__ import annotations

import asyncio
import zlib

import pytest

from devices.commands.card import LINK, Card, CardFile, convert_card_file, download
from devices.commands.command_client import CommandClient
from devices.commands.device_errors import CardError, CommandRefusedError
from devices.link import Framing
from devices.recording_file import RecordingFile
from firmware_protocol import RELAY, FrameDecoder, WireFrame, encode_frame
from firmware_protocol.commands import Verb

CONTENT = bytes(range(256)) * 20


def entry_of(content, file=1):
    return CardFile(file, len(content), 0, zlib.crc32(content))


class Cut(Exception):
    pass


class FakeCard:
    """Content in memory; cut off after so many reads."""

    def __init__(self, content=CONTENT, cut_after=None):
        self.content, self.cut_after, self.offsets = content, cut_after, []

    async def read(self, file, offset, length):
        if self.cut_after is not None and len(self.offsets) >= self.cut_after:
            raise Cut
        self.offsets.append(offset)
        return self.content[offset : offset + length]


async def test_a_cut_download_goes_on_where_it_stopped(tmp_path):
    target = tmp_path / "walk"
    first = FakeCard(cut_after=3)
    with pytest.raises(Cut):
        await download(first.read, entry_of(CONTENT), target, step=1000)
    assert not target.exists()
    assert (tmp_path / "walk.part").stat().st_size == 3000
    second, progress = FakeCard(), []
    await download(second.read, entry_of(CONTENT), target, progress.append, step=1000)
    assert second.offsets == [3000, 4000, 5000]
    assert progress == [3000, 4000, 5000, 5120]
    assert target.read_bytes() == CONTENT
    assert not (tmp_path / "walk.part").exists()


async def test_a_partial_file_of_something_else_is_found_out_and_fetched_anew(tmp_path):
    target = tmp_path / "walk"
    (tmp_path / "walk.part").write_bytes(b"of another file")
    card = FakeCard()
    await download(card.read, entry_of(CONTENT), target, step=4096)
    assert target.read_bytes() == CONTENT
    assert card.offsets == [15, 4111, 0, 4096]


async def test_damage_is_named_and_nothing_gets_the_files_name(tmp_path):
    damaged = FakeCard(CONTENT[:-1] + b"\0")
    with pytest.raises(CardError, match="does not have the checksum"):
        await download(damaged.read, entry_of(CONTENT), tmp_path / "walk")
    short = entry_of(CONTENT)._replace(size=6000, file=2)
    with pytest.raises(CardError, match="ends after 5120 bytes; the card said 6000"):
        await download(FakeCard().read, short, tmp_path / "other")
    assert not (tmp_path / "walk").exists()
    assert not (tmp_path / "other").exists()


async def test_an_empty_file_is_fetched_too(tmp_path):
    await download(FakeCard(b"").read, entry_of(b""), tmp_path / "nothing")
    assert (tmp_path / "nothing").read_bytes() == b""


async def test_files_of_a_relay_through_its_commands(commanded_suit, tmp_path):
    async with commanded_suit(has_relay=True) as suit:
        card = suit.traffic.device(RELAY).card
        assert card is not None
        for number in range(30):  # more than one answer can list
            card.begin(1000 * number)
            card.write(bytes([number]) * number * 40)
        card.end()
        client = CommandClient([suit.link], allow_writes=True)
        async with client.reading():
            relay = Card(client, suit.unique_id(RELAY))
            files = await relay.files()
            assert [(f.file, f.size, f.start_time_us) for f in files] == [
                (n + 1, 40 * n, 1000 * n) for n in range(30)
            ]
            await download(relay.read, files[29], tmp_path / "thirty")
            assert (tmp_path / "thirty").read_bytes() == bytes([29]) * 29 * 40
            await relay.erase(30)
            assert len(await relay.files()) == 29
            with pytest.raises(CommandRefusedError, match="no such file"):
                await relay.read(30, 0, 10)
            await relay.erase()
            assert await relay.files() == []
            with pytest.raises(CommandRefusedError, match="cannot do that"):
                await Card(client, suit.unique_id(1)).files()


def test_arrival_times_are_those_of_the_senders_clocks(tmp_path):
    def frame(module, time_us):
        return encode_frame(WireFrame(0x10, module, 0, time_us % 2**32, b"\0"))

    source, target = tmp_path / "raw", tmp_path / "log"
    start = 2**32 - 15_000  # the clock of module 1 wraps
    source.write_bytes(
        frame(1, start)
        + frame(2, 500)
        + frame(1, start + 10_000)
        + frame(2, 10_500)
        + b"\x07damaged\x00"
        + frame(1, start + 20_000)
        + frame(3, 77)  # switched on only now
        + frame(1, start + 30_000)
        + frame(3, 10_077)
        + frame(2, 100)  # has restarted: here it only looks late, and is not put before the others
        + frame(1, start + 40_000)[:-4]
    )
    made = convert_card_file(source, target, start_ns=10**18)
    messages = list(RecordingFile(target).messages())
    elapsed_ms = [(message.time_ns - 10**18) / 1e6 for message in messages]
    assert elapsed_ms == [0, 0, 10, 10, 20, 20, 30, 30, 30]
    assert (made.chunks, made.dropped, made.duration_s) == (9, 1, 0.03)
    assert RecordingFile(target).head.links == {LINK: Framing.BYTE_STREAM}
    decoder = FrameDecoder()
    modules = [frame.module for message in messages for frame in decoder.feed(message.data)]
    assert modules == [1, 2, 1, 2, 1, 3, 1, 3, 2]
    ending = convert_card_file(source, target, end_ns=10**18)
    assert list(RecordingFile(target).messages())[-1].time_ns == 10**18
    assert ending == made


async def test_recording_of_a_card_holds_what_the_modules_sent(commanded_suit, tmp_path):
    async with commanded_suit(has_relay=True) as suit:
        client = CommandClient([suit.link])
        async with client.reading():
            relay = suit.unique_id(RELAY)
            begun_s = suit.soon_s(0.0)
            await client.request(relay, Verb.START)
            await asyncio.sleep(0.5)
            await client.request(relay, Verb.STOP)
            took_s = suit.soon_s(0.0) - begun_s
            (entry,) = await Card(client, relay).files()
            await download(Card(client, relay).read, entry, tmp_path / "walk.card")
    made = convert_card_file(tmp_path / "walk.card", tmp_path / "walk", end_ns=10**18)
    assert made.dropped == 0
    assert 0.35 < made.duration_s < took_s
    assert made.chunks == pytest.approx(4 * 100 * made.duration_s, rel=0.1)
