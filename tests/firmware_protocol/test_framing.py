"""Wire frames on a byte stream: against a hand-made frame, under any chunking, through any noise."""

from __future__ import annotations

import tracemalloc
from collections import Counter
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol import (
    DELIMITER,
    MAX_FRAME_SIZE,
    Defect,
    FrameDecoder,
    WireFrame,
    encode_frame,
)
from firmware_protocol.framing import MAX_BODY_SIZE, MAX_STUFFED_SIZE, serialize
from firmware_protocol.stuffing import stuff, unstuff

seeded = settings(deadline=None, derandomize=True)

u8, u16, u32 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32))
bodies = st.binary(max_size=600) | st.integers(0, MAX_BODY_SIZE).map(lambda size: b"\xa5" * size)
wire_frames = st.builds(WireFrame, u8, u8, u16, u32, bodies)

FRAME = WireFrame(kind=0x10, module=3, sequence=17, module_time_us=1_250_000, body=b"\x05\x00\x07")


def crc32_bit_by_bit(data: bytes) -> int:
    """CRC-32/ISO-HDLC as the textbooks define it, one bit at a time."""
    register = 0xFFFFFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xEDB88320 if register & 1 else 0)
    return register ^ 0xFFFFFFFF


def cobs_by_hand(data: bytes) -> bytes:
    """Cheshire & Baker's encoding: each block is its length plus one, then its non-zero bytes."""
    out = bytearray()
    block = bytearray()
    for place, byte in enumerate(data):
        if byte:
            block.append(byte)
        if byte == 0 or (len(block) == 254 and place + 1 < len(data)):
            out += bytes([len(block) + 1]) + block
            block.clear()
    return bytes(out + bytes([len(block) + 1]) + block)


def chunks_of(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[start:stop] for start, stop in pairwise(edges)]


def fed(chunks: list[bytes]) -> tuple[list[WireFrame], Counter[Defect], int]:
    decoder = FrameDecoder()
    frames = [frame for chunk in chunks for frame in decoder.feed(chunk)]
    return frames, decoder.dropped, decoder.accepted


def test_checksum_by_hand_has_the_published_check_value():
    assert crc32_bit_by_bit(b"123456789") == 0xCBF43926


@pytest.mark.parametrize(
    ("data", "stuffed"),
    [  # the examples of Cheshire & Baker's article and its encyclopaedia entry
        ("00", "0101"),
        ("0000", "010101"),
        ("11220033", "0311220233"),
        ("11223344", "0511223344"),
        ("11000000", "0211010101"),
    ],
)
def test_stuffing_by_hand_agrees_with_the_literature(data: str, stuffed: str):
    assert cobs_by_hand(bytes.fromhex(data)).hex() == stuffed


@given(
    st.lists(st.sampled_from([b"\x00", b"a", bytes([255]), b"b" * 253, b"c" * 254, b"d" * 255])).map(b"".join)
)
def test_stuffing_agrees_with_that_by_hand_and_can_be_undone(data: bytes):
    """Around the length of a full block, too."""
    stuffed = stuff(data)
    assert stuffed == cobs_by_hand(data)
    assert unstuff(stuffed) == data
    assert unstuff(stuffed[:-1] + b"\x00") is None
    assert unstuff(stuffed + b"\xff") is None


def test_a_wire_frame_put_together_by_hand():
    #              ver kind mod  sequence  module time    body
    content = bytes.fromhex("01 10 03  11 00  d0 12 13 00  05 00 07")
    raw = content + crc32_bit_by_bit(content).to_bytes(4, "little")
    stuffed = bytes.fromhex("05 01 10 03 11  04 d0 12 13  02 05  06 07") + raw[-4:] + b"\x00"
    assert 0 not in raw[-4:]
    assert encode_frame(FRAME) == stuffed == cobs_by_hand(raw) + DELIMITER
    assert FrameDecoder().feed(stuffed) == [FRAME]


@seeded
@given(wire_frames)
def test_encoding_agrees_with_stuffing_and_checksum_by_hand(frame: WireFrame):
    raw = serialize(frame)
    assert int.from_bytes(raw[-4:], "little") == crc32_bit_by_bit(raw[:-4])
    assert encode_frame(frame) == cobs_by_hand(raw) + DELIMITER


@seeded
@given(st.lists(wire_frames, max_size=6), st.lists(st.integers(0, 20_000), max_size=40))
def test_frames_survive_any_chunking(frames: list[WireFrame], cuts: list[int]):
    stream = b"".join(map(encode_frame, frames))
    received, dropped, accepted = fed(chunks_of(stream, cuts))
    assert received == frames
    assert not dropped
    assert accepted == len(frames)


@seeded
@given(st.binary(max_size=300), st.lists(wire_frames, max_size=2), st.binary(max_size=300))
def test_one_byte_at_a_time_gives_the_same(before: bytes, frames: list[WireFrame], after: bytes):
    stream = before + DELIMITER + b"".join(map(encode_frame, frames)) + after
    assert fed([stream[i : i + 1] for i in range(len(stream))]) == fed([stream])


@seeded
@given(st.binary(max_size=600), wire_frames)
def test_noise_and_a_delimiter_never_disturb_the_next_frame(noise: bytes, frame: WireFrame):
    decoder = FrameDecoder()
    decoder.feed(noise + DELIMITER)
    assert decoder.feed(encode_frame(frame)) == [frame]


@seeded
@given(st.lists(st.binary(max_size=400) | st.just(b"\x01" * 5000), max_size=8))
def test_every_stretch_between_delimiters_is_accounted_for_once(stretches: list[bytes]):
    stream = DELIMITER.join([*stretches, b""])
    _, dropped, accepted = fed([stream])
    assert accepted + dropped.total() == sum(1 for stretch in stream.split(DELIMITER) if stretch)


@pytest.mark.parametrize("chunk_size", [1, 7, 4096, 4113, 4114, 5000, 100_000])
def test_an_overlong_stretch_counts_once_and_costs_no_more(chunk_size: int):
    stream = encode_frame(FRAME) + b"\x55" * 13_000 + DELIMITER + encode_frame(FRAME)
    chunks = [stream[i : i + chunk_size] for i in range(0, len(stream), chunk_size)]
    assert fed(chunks) == ([FRAME, FRAME], Counter({Defect.OVERLONG: 1}), 2)


def test_endless_noise_is_not_kept():
    decoder = FrameDecoder()
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    for _ in range(2000):
        decoder.feed(b"\x55" * 1000)
    after, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 2 * MAX_STUFFED_SIZE
    assert peak - before < 8 * MAX_STUFFED_SIZE
    assert decoder.dropped == Counter({Defect.OVERLONG: 1})


@pytest.mark.parametrize("filling", [b"\x00", b"\xff", b"\xff" * 253 + b"\x00"])
def test_the_largest_frame_passes_and_one_byte_more_is_refused(filling: bytes):
    body = (filling * MAX_BODY_SIZE)[:MAX_BODY_SIZE]
    frame = replace(FRAME, body=body)
    assert len(serialize(frame)) == MAX_FRAME_SIZE
    assert len(encode_frame(frame)) <= MAX_STUFFED_SIZE + 1
    assert FrameDecoder().feed(encode_frame(frame)) == [frame]
    with pytest.raises(ValueError, match="4084 bytes"):
        encode_frame(replace(frame, body=body + b"\x00"))


def test_no_turned_bit_passes():
    sent = encode_frame(FRAME)
    for place in range(8 * (len(sent) - 1)):
        damaged = bytearray(sent)
        damaged[place // 8] ^= 1 << place % 8
        frames, dropped, _ = fed([bytes(damaged)])
        assert frames == []
        assert dropped.total() >= 1


@pytest.mark.parametrize(
    ("stretch", "defect"),
    [
        (b"\x09abc", Defect.BAD_STUFFING),
        (b"\x01", Defect.TOO_SHORT),
        (cobs_by_hand(serialize(FRAME)[:12]), Defect.TOO_SHORT),
        (cobs_by_hand(serialize(FRAME)[1:]), Defect.BAD_CRC),
        (cobs_by_hand(serialize(replace(FRAME, version=2))), Defect.BAD_VERSION),
        (b"\x01" * (MAX_STUFFED_SIZE + 1), Defect.OVERLONG),
    ],
)
def test_each_defect_has_its_name(stretch: bytes, defect: Defect):
    assert fed([stretch + DELIMITER + encode_frame(FRAME)]) == ([FRAME], Counter({defect: 1}), 1)


@pytest.mark.parametrize(
    "numbers",
    [{"kind": 256}, {"module": -1}, {"sequence": 2**16}, {"module_time_us": 2**32}, {"version": 256}],
)
def test_a_number_that_does_not_fit_its_field_is_refused(numbers: dict[str, int]):
    with pytest.raises(ValueError, match=next(iter(numbers))):
        encode_frame(replace(FRAME, **numbers))
