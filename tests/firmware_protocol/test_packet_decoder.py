"""Chunks to packets: relay batches expanded, every drop counted, senders checked."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol import (
    BROADCAST,
    FROM_HOST,
    PACKETS,
    RELAY,
    CanFrameDecoder,
    Defect,
    FrameDecoder,
    Health,
    InertialSample,
    LocalMeasurement,
    PacketDecoder,
    ReceivedPacket,
    SamplingTrigger,
    WireFrame,
    decode_body,
    encode_frame,
    fragment,
    pack_can_records,
    relay_batch,
    wire_frame,
)
from firmware_protocol.framing import MAX_BODY_SIZE
from firmware_protocol.golden import FRAMES

seeded = settings(deadline=None, derandomize=True)

SAMPLE = wire_frame(InertialSample(specific_force=(0.0, 0.0, 9.8)), 3, 17, 1000)
POSITION = wire_frame(LocalMeasurement(3, (1.0, 2.0, 3.0), (0.5, 0.5, 0.5)), 40, 5, 1001)
HEALTH = wire_frame(Health(None, 3.7, None, None, 1, 2, 3, 4, 5), RELAY, 6, 1002)
TRIGGER = wire_frame(SamplingTrigger(number=5), 3, 7, 1003)
GOOD = [SAMPLE, POSITION, HEALTH]


def received(frame: WireFrame, relayed_us: int | None = None) -> ReceivedPacket:
    packet = decode_body(frame.kind, frame.body)
    assert not isinstance(packet, Defect)
    return ReceivedPacket(frame.kind, frame.module, frame.sequence, frame.module_time_us, packet, relayed_us)


def fed(*chunks: bytes) -> tuple[list[ReceivedPacket], Counter[Defect], int]:
    decoder = PacketDecoder(FrameDecoder())
    packets = [packet for chunk in chunks for packet in decoder.feed(chunk)]
    return packets, decoder.dropped, decoder.accepted


def test_frames_come_out_as_packets_with_their_headers():
    assert fed(*map(encode_frame, GOOD)) == ([received(frame) for frame in GOOD], Counter(), 3)


def test_can_gives_the_same_packets_as_a_byte_stream():
    decoder = PacketDecoder(CanFrameDecoder())
    chunk = pack_can_records(piece for frame in GOOD for piece in fragment(frame, fd=frame is POSITION))
    assert decoder.feed(chunk) == [received(frame) for frame in GOOD]
    assert decoder.accepted == 3
    assert not decoder.dropped


def test_a_batch_comes_out_as_the_packets_it_holds():
    batch = relay_batch(GOOD, sequence=9, module_time_us=2000)
    assert (batch.kind, batch.module, batch.sequence, batch.module_time_us) == (0x20, 0xFE, 9, 2000)
    assert fed(encode_frame(batch)) == ([received(frame, relayed_us=2000) for frame in GOOD], Counter(), 3)


def test_a_wire_frame_that_came_another_way_is_taken():
    decoder = PacketDecoder(FrameDecoder())
    assert decoder.take(relay_batch(GOOD, 9, 2000)) == [received(frame, 2000) for frame in GOOD]
    assert decoder.take(replace(SAMPLE, kind=0x77)) == []
    assert (decoder.accepted, decoder.dropped) == (3, Counter({Defect.UNKNOWN_KIND: 1}))


@pytest.mark.parametrize("kind", [*PACKETS, 0x20])
def test_only_what_the_host_sends_may_be_meant_for_all(kind: int):
    least = min(len(vector.body) for vector in FRAMES.values() if vector.kind == kind)
    frame = next(v for v in FRAMES.values() if v.kind == kind and len(v.body) == least)
    packets, dropped, _ = fed(encode_frame(replace(frame, module=BROADCAST)))
    if kind in FROM_HOST:
        assert [packet.module for packet in packets] == [BROADCAST]
        assert fed(encode_frame(replace(frame, module=RELAY)))[2] == 1
    else:
        assert dropped == {Defect.BAD_MODULE: 1}


def test_an_entry_put_together_by_hand():
    entry = bytes.fromhex("10 03 1100 e8030000 07") + struct.pack("<B3h", 1, 0, 0, 2047)
    assert relay_batch([SAMPLE], 0, 0).body == entry


def test_an_empty_batch_holds_nothing_and_is_no_defect():
    assert fed(encode_frame(relay_batch([], 0, 0))) == ([], Counter(), 0)


def test_a_truncated_entry_ends_the_batch_and_what_came_before_stands():
    batch = relay_batch(GOOD, 0, 0)
    first_two = len(relay_batch(GOOD[:2], 0, 0).body)
    for size in range(first_two + 1, len(batch.body)):
        cut = encode_frame(replace(batch, body=batch.body[:size]))
        assert fed(cut) == ([received(SAMPLE, 0), received(POSITION, 0)], Counter({Defect.TRUNCATED: 1}), 2)


@pytest.mark.parametrize(
    ("bad", "defect"),
    [
        (replace(SAMPLE, kind=0x77), Defect.UNKNOWN_KIND),
        (replace(SAMPLE, module=64), Defect.BAD_MODULE),
        (replace(SAMPLE, module=0xFF), Defect.BAD_MODULE),
        (replace(SAMPLE, kind=0x77, module=0xFF), Defect.UNKNOWN_KIND),
        (replace(TRIGGER, module=64), Defect.BAD_MODULE),
        (replace(TRIGGER, module=0xFD), Defect.BAD_MODULE),
        (replace(SAMPLE, body=SAMPLE.body + b"\x00"), Defect.BAD_LENGTH),
        (replace(SAMPLE, body=b"\x08"), Defect.BAD_VALUE),
        (replace(POSITION, body=b"\x04" + POSITION.body[1:]), Defect.BAD_VALUE),
    ],
)
def test_a_bad_packet_counts_once_and_harms_no_other(bad: WireFrame, defect: Defect):
    survivors = [received(SAMPLE), received(HEALTH)]
    alone = b"".join(map(encode_frame, [SAMPLE, bad, HEALTH]))
    batched = encode_frame(relay_batch([SAMPLE, bad, HEALTH], 0, 0))
    assert fed(alone) == (survivors, Counter({defect: 1}), 2)
    assert fed(batched) == ([received(SAMPLE, 0), received(HEALTH, 0)], Counter({defect: 1}), 2)


def test_a_batch_within_a_batch_is_refused_by_both_sides():
    inner = relay_batch([SAMPLE], 0, 0)
    with pytest.raises(ValueError, match="cannot hold another"):
        relay_batch([inner], 0, 0)
    head = struct.pack("<BBHIB", 0x20, RELAY, 0, 0, len(inner.body))
    outer = replace(inner, body=head + inner.body)
    assert fed(encode_frame(outer)) == ([], Counter({Defect.UNKNOWN_KIND: 1}), 0)


def test_only_a_relay_sends_batches():
    assert fed(encode_frame(replace(relay_batch(GOOD, 0, 0), module=3))) == (
        [],
        Counter({Defect.BAD_MODULE: 1}),
        0,
    )


def test_a_batch_too_long_for_its_parts_or_for_a_wire_frame_is_refused():
    with pytest.raises(ValueError, match="relay entry"):
        relay_batch([replace(SAMPLE, body=bytes(256))], 0, 0)
    entry_size = 9 + len(SAMPLE.body)
    fitting = relay_batch([SAMPLE] * (MAX_BODY_SIZE // entry_size), 0, 0)
    assert fed(encode_frame(fitting))[2] == MAX_BODY_SIZE // entry_size
    with pytest.raises(ValueError, match="at most 4083"):
        encode_frame(relay_batch([SAMPLE] * (MAX_BODY_SIZE // entry_size + 1), 0, 0))


def test_drops_of_frames_and_packets_are_counted_together():
    broken = bytearray(encode_frame(SAMPLE))
    broken[8] ^= 4
    assert fed(bytes(broken) + encode_frame(replace(SAMPLE, kind=0x78)))[1] == Counter(
        {Defect.BAD_CRC: 1, Defect.UNKNOWN_KIND: 1}
    )


@seeded
@given(st.binary(max_size=400), st.sampled_from([*PACKETS, 0x20, 0x99]), st.sampled_from([3, RELAY]))
def test_any_body_in_a_valid_frame_never_raises(body: bytes, kind: int, module: int):
    decoder = PacketDecoder(FrameDecoder())
    decoder.feed(encode_frame(WireFrame(kind, module, 0, 0, body)))
    assert decoder.feed(encode_frame(SAMPLE)) == [received(SAMPLE)]


@seeded
@given(st.lists(st.binary(max_size=200), max_size=5))
def test_arbitrary_chunks_never_raise_on_either_link(chunks: list[bytes]):
    byte_stream, can = PacketDecoder(FrameDecoder()), PacketDecoder(CanFrameDecoder())
    for chunk in chunks:
        byte_stream.feed(chunk)
        can.feed(chunk)
    byte_stream.feed(b"\x00")
    assert byte_stream.feed(encode_frame(SAMPLE)) == [received(SAMPLE)]
    assert can.feed(pack_can_records(fragment(SAMPLE))) == [received(SAMPLE)]
