"""Wire frames on CAN: against identifiers made by hand, through loss, repetition and disorder."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from zlib import crc32

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol import (
    PACKETS,
    CanFrame,
    CanFrameDecoder,
    Defect,
    Kind,
    WireFrame,
    fragment,
    pack_can_records,
    unpack_can_records,
)
from firmware_protocol.can_framing import FD_LENGTHS, MAX_CLASSIC_BODY_SIZE, MAX_PARTIAL_FRAMES
from firmware_protocol.kinds import CAN_PRIORITY

seeded = settings(deadline=None, derandomize=True)

u8, u16, u32 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32))
wire_frames = st.builds(WireFrame, u8, u8, u16, u32, st.binary(max_size=245))

can_frames = st.one_of(
    st.builds(CanFrame, st.integers(0, 2**29 - 1), st.binary(max_size=8), is_remote=st.booleans()),
    st.builds(CanFrame, st.integers(0, 2**29 - 1), st.binary(max_size=8), is_error=st.just(value=True)),
    st.builds(CanFrame, st.integers(0, 2**11 - 1), st.binary(max_size=8), is_extended=st.just(value=False)),
    st.builds(
        CanFrame,
        st.integers(0, 2**29 - 1),
        st.binary(max_size=64),
        is_fd=st.just(value=True),
        bitrate_switch=st.booleans(),
    ),
)

# A sample of accelerometer and gyroscope; module 3, sample 17, at 1.25 s.
FRAME = WireFrame(0x10, 3, 17, 1_250_000, bytes.fromhex("05 0000 0000 0108 0000 5e00 0000"))
OTHER = replace(FRAME, module=4, body=bytes(range(40)))


def fed(*chunks: list[CanFrame]) -> tuple[list[WireFrame], Counter[Defect], int]:
    decoder = CanFrameDecoder()
    frames = [frame for chunk in chunks for frame in decoder.feed(pack_can_records(chunk))]
    return frames, decoder.dropped, decoder.accepted


def test_classic_pieces_put_together_by_hand():
    on_the_wire = bytes.fromhex("01 10 03 1100 d0121300") + FRAME.body
    payload = on_the_wire[3:9] + b"\x0d" + FRAME.body + crc32(on_the_wire).to_bytes(4, "little")
    identifier = 0b011_00010000_00000011_0001_0_00000
    last = 0b100000
    expected = [
        CanFrame(identifier | 0, payload[0:8]),
        CanFrame(identifier | 1, payload[8:16]),
        CanFrame(identifier | last | 2, payload[16:24]),
    ]
    assert fragment(FRAME) == expected
    assert fed(expected) == ([FRAME], Counter(), 1)


@pytest.mark.parametrize(
    ("body_size", "fd", "lengths"),
    [
        (0, False, [8, 3]),
        (13, False, [8, 8, 8]),
        (19, False, [8, 8, 8, 6]),
        (13, True, [24]),
        (19, True, [32]),
        (37, True, [48]),
        (53, True, [64]),
        (54, True, [64, 1]),
        (102, True, [64, 64]),
        (255, True, [64, 64, 64, 64, 12]),
    ],
)
def test_lengths_of_the_pieces(body_size: int, fd: bool, lengths: list[int]):
    pieces = fragment(replace(FRAME, body=b"\xff" * body_size), fd=fd)
    assert [len(piece.data) for piece in pieces] == lengths
    assert all(length in FD_LENGTHS for length in lengths)
    assert all(piece.is_fd is fd and piece.is_extended for piece in pieces)


@pytest.mark.parametrize("kind", PACKETS)
def test_every_kind_has_a_priority_that_leads_the_identifier(kind: int):
    assert fragment(replace(FRAME, kind=kind))[0].identifier >> 26 == CAN_PRIORITY[kind]


def test_local_measurements_win_over_samples_and_these_over_health():
    order = sorted((Kind.HEALTH, Kind.INERTIAL_SAMPLE, Kind.LOCAL_MEASUREMENT), key=CAN_PRIORITY.__getitem__)
    assert order == [Kind.LOCAL_MEASUREMENT, Kind.INERTIAL_SAMPLE, Kind.HEALTH]


@seeded
@given(wire_frames, st.booleans())
def test_round_trip(frame: WireFrame, fd: bool):
    assert fed(fragment(frame, fd)) == ([frame], Counter(), 1)


@seeded
@given(st.data())
def test_modules_interleaved_at_will(data: st.DataObject):
    frames = data.draw(
        st.lists(wire_frames, min_size=1, max_size=6, unique_by=lambda frame: (frame.kind, frame.module))
    )
    queues = [fragment(frame, data.draw(st.booleans())) for frame in frames]
    traffic = []
    while any(queues):
        traffic.append(data.draw(st.sampled_from([queue for queue in queues if queue])).pop(0))
    cut = data.draw(st.integers(0, len(traffic)))
    received, dropped, _ = fed(traffic[:cut], traffic[cut:])
    assert sorted(received, key=repr) == sorted(frames, key=repr)
    assert not dropped


@seeded
@given(st.data())
def test_damaged_traffic_never_yields_a_frame_that_was_not_sent(data: st.DataObject):
    """Many samples of two modules, so that a wrong join would find pieces of the right shape."""
    sent = [replace(FRAME, module=i % 2, sequence=i, body=bytes([i]) * 30) for i in range(8)]
    fd = data.draw(st.booleans())
    traffic = [piece for frame in sent for piece in fragment(frame, fd)]
    damages = data.draw(st.lists(st.sampled_from(["lose", "repeat", "swap", "turn a bit"]), max_size=6))
    for damage in damages:
        place = data.draw(st.integers(0, len(traffic) - 1))
        old = traffic[place]
        match damage:
            case "lose":
                del traffic[place]
            case "repeat":
                traffic.insert(place, old)
            case "swap":
                traffic[place - 1], traffic[place] = old, traffic[place - 1]
            case "turn a bit":
                traffic[place] = replace(old, identifier=old.identifier ^ 1 << data.draw(st.integers(0, 25)))
    # A frame that lost its end is noticed when the module's next one comes.
    following = [replace(FRAME, module=module, sequence=99) for module in (0, 1)]
    received, dropped, _ = fed(traffic, *(fragment(frame, fd) for frame in following))
    assert set(received) <= set(sent + following)
    assert received[-2:] == following
    if not dropped and "turn a bit" not in damages:
        assert len(traffic) == sum(len(fragment(frame, fd)) for frame in received[:-2])


def test_no_turned_bit_of_identifier_or_data_passes():
    pieces = fragment(FRAME)
    for place in range(len(pieces)):
        # Bits 26 to 28, the priority, say nothing about the wire frame.
        for bit in range(26):
            turned = replace(pieces[place], identifier=pieces[place].identifier ^ 1 << bit)
            assert fed([*pieces[:place], turned, *pieces[place + 1 :]])[0] == []
        for bit in range(8 * len(pieces[place].data)):
            data = bytearray(pieces[place].data)
            data[bit // 8] ^= 1 << bit % 8
            assert (
                fed([*pieces[:place], replace(pieces[place], data=bytes(data)), *pieces[place + 1 :]])[0]
                == []
            )


A, B, C = fragment(FRAME)


@pytest.mark.parametrize(
    ("traffic", "dropped"),
    [
        ([A, C, A, B, C], {Defect.LOST_FRAGMENT: 1}),
        ([A, B, A, B, C], {Defect.LOST_FRAGMENT: 1}),
        ([B, C, A, B, C], {Defect.LOST_FRAGMENT: 1}),
        ([C, A, B, C], {Defect.LOST_FRAGMENT: 1}),
        ([A, A, B, C], {Defect.LOST_FRAGMENT: 1}),
        ([A, B, B, C, A, B, C], {Defect.LOST_FRAGMENT: 1}),
        ([A, B, replace(C, data=C.data[:-1]), A, B, C], {Defect.BAD_LENGTH: 1}),
        ([A, B, replace(C, data=bytes(8)), A, B, C], {Defect.BAD_CRC: 1}),
        ([replace(A, identifier=A.identifier | 1 << 5), A, B, C], {Defect.TOO_SHORT: 1}),
        ([A, CanFrame(0x123, b"\x01", is_extended=False), B, C], {Defect.FOREIGN: 1}),
        ([A, replace(B, is_remote=True, data=b""), B, C], {Defect.FOREIGN: 1}),
        ([A, CanFrame(0x4, bytes(8), is_error=True), B, C], {Defect.FOREIGN: 1}),
        ([A, replace(B, identifier=B.identifier ^ 2 << 6), B, C], {Defect.FOREIGN: 1}),
    ],
)
def test_each_disturbance_counts_once_and_the_next_frame_passes(
    traffic: list[CanFrame], dropped: dict[Defect, int]
):
    assert fed(traffic) == ([FRAME], Counter(dropped), 1)


@pytest.mark.parametrize("surplus", [1, 5])
def test_classic_pieces_are_not_padded(surplus: int):
    pieces = fragment(replace(FRAME, body=b""))
    last = replace(pieces[-1], data=pieces[-1].data + bytes(surplus))
    assert fed([pieces[0], last])[1] == Counter({Defect.BAD_LENGTH: 1})


def test_padding_is_not_looked_at_but_bounded():
    (piece,) = fragment(replace(FRAME, body=bytes(19)), fd=True)
    odd_padding = replace(piece, data=piece.data[:30] + b"\xcc\xcc")
    assert len(fed([odd_padding])[0]) == 1
    far_too_long = replace(piece, data=piece.data + bytes(32))
    assert fed([far_too_long])[1] == Counter({Defect.BAD_LENGTH: 1})


def test_what_is_in_reassembly_is_bounded():
    begun = [fragment(replace(FRAME, kind=kind, module=m)) for kind in range(8) for m in range(64)]
    decoder = CanFrameDecoder()
    decoder.feed(pack_can_records(pieces[0] for pieces in begun))
    assert decoder.dropped == Counter({Defect.LOST_FRAGMENT: len(begun) - MAX_PARTIAL_FRAMES})
    latest = begun[-MAX_PARTIAL_FRAMES:]
    finished = decoder.feed(pack_can_records(piece for pieces in latest for piece in pieces[1:]))
    assert len(finished) == MAX_PARTIAL_FRAMES


@pytest.mark.parametrize(
    ("frame", "fd", "named"),
    [
        (replace(FRAME, body=bytes(MAX_CLASSIC_BODY_SIZE + 1)), False, "245"),
        (replace(FRAME, body=bytes(256)), True, "255"),
        (replace(FRAME, version=16), False, "version"),
        (replace(FRAME, module=256), False, "module"),
    ],
)
def test_what_does_not_fit_is_refused(frame: WireFrame, fd: bool, named: str):
    with pytest.raises(ValueError, match=named):
        fragment(frame, fd)


def test_the_longest_bodies_fit():
    classic = replace(FRAME, body=bytes(MAX_CLASSIC_BODY_SIZE))
    assert len(fragment(classic)) == 32
    assert fed(fragment(classic))[0] == [classic]
    assert fed(fragment(replace(FRAME, body=b"\xff" * 255), fd=True))[2] == 1


@seeded
@given(st.lists(can_frames, max_size=10))
def test_records_round_trip(frames: list[CanFrame]):
    assert unpack_can_records(pack_can_records(frames)) == frames


def test_a_record_has_socketcan_flags():
    assert pack_can_records([CanFrame(0x1234567, b"\xaa")]).hex() == "67452381" + "00" + "01" + "aa"
    assert (
        pack_can_records([CanFrame(0x7FF, b"", is_extended=False, is_remote=True)]).hex()
        == "ff07004000" + "00"
    )
    fd = CanFrame(1, bytes(12), is_fd=True, bitrate_switch=True)
    assert pack_can_records([fd]).hex() == "01000080" + "03" + "0c" + "00" * 12


@seeded
@given(st.lists(can_frames, min_size=1, max_size=4), st.integers(1, 6))
def test_a_broken_tail_is_dropped_and_counted(frames: list[CanFrame], cut: int):
    data = pack_can_records(frames)[:-cut]
    kept = unpack_can_records(data)
    assert kept == frames[: len(kept)]
    decoder = CanFrameDecoder()
    decoder.feed(data)
    is_broken = pack_can_records(kept) != data
    assert decoder.dropped[Defect.TRUNCATED] == int(is_broken)


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(1, bytes(9)),
        CanFrame(1, bytes(65), is_fd=True),
        CanFrame(1 << 29, b""),
        CanFrame(1 << 11, b"", is_extended=False),
    ],
)
def test_an_impossible_can_frame_is_refused(frame: CanFrame):
    with pytest.raises(ValueError, match="CAN"):
        pack_can_records([frame])


@seeded
@given(st.lists(st.binary(max_size=300), max_size=5), st.lists(can_frames, max_size=20))
def test_arbitrary_input_never_raises(chunks: list[bytes], traffic: list[CanFrame]):
    decoder = CanFrameDecoder()
    for chunk in [*chunks, pack_can_records(traffic)]:
        decoder.feed(chunk)
        unpack_can_records(chunk)
    assert decoder.feed(pack_can_records(fragment(FRAME))) == [FRAME]
