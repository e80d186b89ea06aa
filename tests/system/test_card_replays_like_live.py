"""What a relay's card recorded gives the same poses, replayed, as the same samples did live."""

from __future__ import annotations

import numpy as np
import pytest

from devices.commands.card import Card, convert_card_file, download
from devices.commands.command_client import CommandClient
from devices.link import Chunk
from devices.replay_link import ReplayLink
from firmware_protocol import RELAY, FrameDecoder, PacketDecoder, encode_frame, wire_frame
from firmware_protocol.commands import Verb
from gateway.body.rig import load_rig
from gateway.pipeline import Pipeline
from gateway.sources.clock_mode import ClockMode
from gateway.stages.frame_assembler import AssemblyParams

pytestmark = pytest.mark.system

RIG = "robot_arm_4"
CARD_BYTES = 36_000
"""Of some three seconds."""
PARAMS = AssemblyParams(frame_interval_ns=1e7, max_wait_ns=5 * 10**9, max_gap_ns=10**8, hold_ns=5 * 10**9)


class Overheard:
    """A link, and all that came over it."""

    def __init__(self, link):
        self.name, self.framing = link.name, link.framing
        self.open, self.close, self.write = link.open, link.close, link.write
        self.chunks = []
        self._link = link

    async def __aiter__(self):
        async for chunk in self._link:
            self.chunks.append(chunk)
            yield chunk


def poses(chunks, framing):
    pipeline = Pipeline(load_rig(RIG), PARAMS, "independent", ClockMode.SHARED)
    pipeline.add_link("suit", framing)
    frames = [frame for chunk in chunks for frame in pipeline.feed(chunk)]
    return {frame.time_ns: frame.q_wb for frame in frames}


def packets(chunks):
    decoder = PacketDecoder(FrameDecoder())
    for chunk in chunks:
        for received in decoder.feed(chunk.data):
            yield (received.kind, received.module, received.sequence), received, chunk.arrived_ns


async def test_a_card_replays_like_live(commanded_suit, tmp_path, until):
    async with commanded_suit(RIG, has_relay=True) as suit:
        link = Overheard(suit.link)
        client = CommandClient([link])
        async with client.reading():
            relay = suit.unique_id(RELAY)
            await client.request(relay, Verb.START)
            recording = suit.traffic.device(RELAY).card
            await until(lambda: recording.entries() and recording.entries()[0].size > CARD_BYTES)
            await client.request(relay, Verb.STOP)
            card = Card(client, relay)
            (entry,) = await card.files()
            await download(card.read, entry, tmp_path / "raw")
            convert_card_file(tmp_path / "raw", tmp_path / "log", end_ns=10**18)
            first = await recorded(tmp_path / "log")
            on_card = {key: received for key, received, _ in packets(first)}
            # A relay sends later what it has written at once.
            await until(lambda: on_card.keys() <= {key for key, _, _ in packets(link.chunks)})

    live = {key: (received, arrived_ns) for key, received, arrived_ns in packets(link.chunks)}
    samples = {key: received.packet for key, received in on_card.items()}
    assert len(samples) > 4 * 250
    assert samples == {key: live[key][0].packet for key in samples}

    again = [
        Chunk(
            encode_frame(
                wire_frame(received.packet, received.module, received.sequence, received.module_time_us)
            ),
            arrived_ns,
            "suit",
        )
        for key, (received, arrived_ns) in live.items()
        if key in on_card
    ]
    # The one clock of all modules is set by the first packet: that of the recording as that of the live run.
    key, (_, arrived_ns) = next((key, value) for key, value in live.items() if key in on_card)
    assert key == next(iter(on_card))
    convert_card_file(tmp_path / "raw", tmp_path / "log", start_ns=arrived_ns)
    replayed = poses(await recorded(tmp_path / "log"), link.framing)
    lived = poses(again, link.framing)
    common = sorted(replayed.keys() & lived.keys())
    assert len(common) > 250
    assert max(len(replayed), len(lived)) - len(common) < 10
    # Not bit for bit: a card puts what came in one batch in the order of sending.
    np.testing.assert_allclose([replayed[t] for t in common], [lived[t] for t in common], atol=1e-12)


async def recorded(path):
    link = ReplayLink(path, speed=None, name="suit")
    await link.open()
    return [chunk async for chunk in link]
