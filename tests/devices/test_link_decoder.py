"""A decoder for each sender: nobody's bytes join another's, and only who sends valid packets is answered."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.link import Chunk, Framing
from devices.link_decoder import MOST_SENDERS, SILENT_AFTER_NS, LinkDecoder
from firmware_protocol import Defect, InertialSample, encode_frame, wire_frame

SAMPLE = InertialSample((0.0, 0.0, 9.81), (0.0, 0.0, 0.0))


def frame_of(module, sequence=0):
    return encode_frame(wire_frame(SAMPLE, module, sequence, 1000 * sequence))


def fed(decoder, data, sender, at_ns=0):
    return decoder.feed(Chunk(data, at_ns, "wifi", sender))


@pytest.fixture
def decoder():
    return LinkDecoder(Framing.BYTE_STREAM)


def test_a_stranger_between_two_datagrams_costs_nothing(decoder):
    received = []
    for sequence in range(100):
        received += fed(decoder, frame_of(5, sequence), "10.0.0.5:7000")
        fed(decoder, b"\x07", "10.0.0.66:1")
    assert [packet.sequence for packet in received] == list(range(100))
    assert not decoder.is_damaged
    assert decoder.senders == ("10.0.0.5:7000",)
    assert decoder.strangers == ("10.0.0.66:1",)
    assert decoder.strange_chunks == 100


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 40)), max_size=80))
def test_frames_cut_anywhere_come_whole_whoever_sends_in_between(turns):
    decoder = LinkDecoder(Framing.BYTE_STREAM)
    whole = {sender: b"".join(frame_of(sender, sequence) for sequence in range(20)) for sender in range(4)}
    rest, received = dict(whole), []
    for sender, size in [*turns, *((sender, len(whole[sender])) for sender in whole)]:
        piece, rest[sender] = rest[sender][:size], rest[sender][size:]
        received += fed(decoder, piece, f"10.0.0.{sender}:7000")
    for sender in whole:
        assert [p.sequence for p in received if p.module == sender] == list(range(20))
    assert decoder.accepted == 80
    assert not any(decoder.dropped.values())


def test_what_a_stranger_garbles_is_counted_and_no_damage_to_the_modules(decoder):
    fed(decoder, frame_of(1), "10.0.0.1:7000")
    fed(decoder, b"\x02rubbish\x00", "10.0.0.66:1")
    assert not decoder.is_trusted
    assert not decoder.is_damaged
    assert sum(decoder.dropped.values()) == 1
    fed(decoder, b"\x02rubbish\x00", "10.0.0.1:7000")
    assert decoder.is_damaged


def test_ever_new_strangers_are_bounded_and_push_out_no_module(decoder):
    partial = frame_of(1)[:10]
    fed(decoder, frame_of(0), "10.0.0.1:7000")
    fed(decoder, partial, "10.0.0.1:7000")
    for number in range(5 * MOST_SENDERS):
        fed(decoder, b"\x01\x00", f"10.1.{number // 250}.{number % 250}:{number}")
    assert len(decoder._by_sender) == MOST_SENDERS
    assert decoder.senders == ("10.0.0.1:7000",)
    assert decoder.dropped == {Defect.TOO_SHORT: 5 * MOST_SENDERS}  # also of those that are forgotten
    (packet,) = fed(decoder, frame_of(1)[10:], "10.0.0.1:7000")
    assert packet.module == 1
    assert len(decoder.strangers) == 8


def test_a_module_gets_in_with_its_first_datagram_whatever_the_flood(decoder):
    for number in range(2 * MOST_SENDERS):
        fed(decoder, frame_of(number % 60), f"10.1.0.1:{number + 1}")  # a flood of forged, valid ones
    assert len(fed(decoder, frame_of(7), "10.0.0.7:7000")) == 1
    assert "10.0.0.7:7000" in decoder.senders
    assert len(decoder.senders) == MOST_SENDERS


def test_who_has_been_silent_for_a_minute_is_not_written_to(decoder):
    fed(decoder, frame_of(1), "10.0.0.1:7000", at_ns=10**18)
    fed(decoder, frame_of(2), "10.0.0.2:7000", at_ns=10**18 + SILENT_AFTER_NS)
    assert decoder.senders == ("10.0.0.1:7000", "10.0.0.2:7000")
    fed(decoder, frame_of(2), "10.0.0.2:7000", at_ns=10**18 + SILENT_AFTER_NS + 1)
    assert decoder.senders == ("10.0.0.2:7000",)


def test_a_link_with_one_other_end_names_nobody(decoder):
    fed(decoder, frame_of(1), "")
    assert (decoder.senders, decoder.strangers, decoder.statistics()) == ((), (), {})
