"""The client against an emulated suit: lost answers, silence, refusals, shared ids."""

from __future__ import annotations

import asyncio
from collections import Counter

import pytest

from devices.commands.command_client import CommandClient
from devices.commands.device_errors import CommandRefusedError, NoAnswerError, WritesLockedError
from devices.link import Chunk, Framing, LinkError
from firmware_protocol import Acknowledgement, FrameDecoder, Kind, decode_body, encode_frame
from firmware_protocol.commands import Result, Verb
from firmware_protocol.device_settings import encode_value

LABEL = 10


class LosesFirstAnswers:
    """A link on which every answer is lost the first time it is given."""

    framing = Framing.BYTE_STREAM

    def __init__(self, link):
        self.name = link.name
        self.lost = 0
        self._link = link
        self._seen = set()
        self.open, self.close, self.write = link.open, link.close, link.write

    async def __aiter__(self):
        decoder = FrameDecoder()
        async for chunk in self._link:
            kept = [frame for frame in decoder.feed(chunk.data) if not self._is_lost(frame)]
            yield Chunk(b"".join(map(encode_frame, kept)), chunk.arrived_ns, chunk.link)

    def _is_lost(self, frame):
        if frame.kind != Kind.ACKNOWLEDGEMENT:
            return False
        answer = decode_body(frame.kind, frame.body)
        assert isinstance(answer, Acknowledgement)
        key = answer.transaction, answer.unique_id
        is_first = key not in self._seen
        self._seen.add(key)
        self.lost += is_first
        return is_first


async def test_hello_agrees_on_the_version(commanded_suit):
    async with commanded_suit() as suit:
        client = CommandClient([suit.link])
        async with client.reading():
            assert await client.request(suit.unique_id(2), Verb.HELLO, 1, 9) == (1, 1, 1)
            assert await client.request(suit.unique_id(2), Verb.HELLO, 7, 9) == (0, 1, 1)


async def test_every_answer_lost_once_is_got_by_asking_again_and_acted_on_once(commanded_suit):
    async with commanded_suit() as suit:
        link = LosesFirstAnswers(suit.link)
        client = CommandClient([link], allow_writes=True)
        async with client.reading():
            everyone = await client.request_all(Verb.HELLO, 1, 1)
            assert set(everyone) == {suit.unique_id(number) for number in range(4)}
            one = suit.unique_id(1)
            await client.request(one, Verb.WRITE_SETTING, LABEL, encode_value(LABEL, "left"))
            first = await client.request(one, Verb.COMMIT)
            assert link.lost == 4 + 2
            with pytest.raises(CommandRefusedError) as refused:
                await client.request(one, Verb.COMMIT)
            assert refused.value.result is Result.NOTHING_STAGED  # so the first one was not done twice
            await client.request(one, Verb.WRITE_SETTING, LABEL, encode_value(LABEL, "right"))
            assert await client.request(one, Verb.COMMIT) == (first[0] + 1,)


async def test_a_device_that_shares_its_id_answers_for_itself_alone(commanded_suit):
    async with commanded_suit(stored_ids={2: 1}) as suit:
        client = CommandClient([suit.link])
        async with client.reading():
            await client.request(suit.unique_id(2), Verb.IDENTIFY, 60)
            now_s = suit.soon_s()
            assert suit.traffic.device(2).is_blinking(now_s)
            assert not suit.traffic.device(1).is_blinking(now_s)


@pytest.mark.parametrize("verb", [Verb.WRITE_SETTING, Verb.COMMIT, Verb.FACTORY_RESET, Verb.CARD_ERASE])
async def test_nothing_that_changes_a_device_is_sent_unless_allowed(commanded_suit, verb):
    arguments = {
        Verb.WRITE_SETTING: (LABEL, b"\0" * 16),
        Verb.COMMIT: (),
        Verb.FACTORY_RESET: (0x46414354,),
        Verb.CARD_ERASE: (1,),
    }
    async with commanded_suit() as suit:
        client = CommandClient([suit.link])
        async with client.reading():
            with pytest.raises(WritesLockedError, match=r"allow_device_writes.*--allow-writes"):
                await client.request(suit.unique_id(0), verb, *arguments[verb])
            await asyncio.sleep(0.05)
            assert suit.suit.counts.received_bytes == 0


async def test_a_device_locked_by_itself_says_so(commanded_suit):
    async with commanded_suit() as suit:
        suit.traffic.device(0).is_locked = True
        client = CommandClient([suit.link], allow_writes=True)
        async with client.reading():
            with pytest.raises(CommandRefusedError, match="locked on the device itself") as refused:
                await client.request(suit.unique_id(0), Verb.WRITE_SETTING, LABEL, b"\0" * 16)
            assert refused.value.result is Result.REFUSED


async def test_silence_is_named_after_so_many_attempts(commanded_suit, monkeypatch):
    monkeypatch.setattr("devices.commands.transactions.SINGLE_WAITS_S", (0.02, 0.04, 0.08))
    async with commanded_suit() as suit:
        client = CommandClient([suit.link])
        async with client.reading():
            with pytest.raises(NoAnswerError, match=r"device 6e6f.*does not answer HELLO \(asked 3 times\)"):
                await client.request(b"nobody here.", Verb.HELLO, 1, 1)


async def test_many_at_once_are_not_mixed_up(commanded_suit):
    async with commanded_suit() as suit:
        client = CommandClient([suit.link])
        async with client.reading():
            keys = [1, 2, 8, 1, 2]
            asked = [
                client.request(suit.unique_id(n), Verb.READ_SETTING, key) for n in range(4) for key in keys
            ]
            answers = await asyncio.gather(*asked)
            assert [key for key, _ in answers] == keys * 4
            assert [raw[0] for key, raw in answers if key == 1] == [0, 0, 1, 1, 2, 2, 3, 3]
            assert client.transactions.unexpected == 0


class DeadLink:
    """A link that takes nothing."""

    name, framing = "dead", Framing.BYTE_STREAM

    async def write(self, data, _to=()):
        raise LinkError("dead was unplugged")

    async def close(self):
        """It is."""


async def test_one_dead_link_does_not_keep_a_command_from_the_others(commanded_suit):
    async with commanded_suit() as suit:
        client = CommandClient([suit.link])
        async with client.reading():
            client.links |= {"dead": DeadLink()}
            client.link_of[suit.unique_id(0)] = "dead"  # it was heard there until a moment ago
            assert await client.request(suit.unique_id(0), Verb.HELLO, 1, 1) == (1, 1, 1)
            assert client.link_of[suit.unique_id(0)] == "suit"


async def test_no_link_that_takes_a_command_is_the_links_error(monkeypatch):
    monkeypatch.setattr("devices.commands.transactions.SINGLE_WAITS_S", (0.01, 0.01))
    client = CommandClient([DeadLink()])
    with pytest.raises(LinkError, match="dead was unplugged"):
        await client.request(b"one.........", Verb.HELLO, 1, 1)
    with pytest.raises(LinkError, match="no link"):
        await CommandClient([]).request_all(Verb.GET_INFO)


def test_two_clients_do_not_begin_with_the_same_number():
    firsts = Counter(CommandClient([]).transactions._next for _ in range(20))
    assert len(firsts) > 15
