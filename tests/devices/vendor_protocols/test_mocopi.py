"""Datagrams of mocopi: those of a real app, round trips, and bytes that are none."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.vendor_protocols.mocopi import PARENTS, Frame, MocopiDecoder, encode

REST = (1.0, 0.0, 0.0, 0.0)


@pytest.fixture
def captured(recording_set):
    """(an instant, the skeleton) as a real app sent them."""
    folder = recording_set("live_captures") / "mocopi"
    return [(folder / f"sample_{name}.bin").read_bytes() for name in ("fram", "skdf")]


def test_an_instant_of_a_real_app_is_read_as_it_is(captured):
    decoder = MocopiDecoder()
    (frame,) = decoder.feed(captured[0])
    assert (frame.number, frame.time_ms) == (1, 0)
    assert [bone for bone, _, _ in frame.bones] == list(range(27))
    for _, turned, _ in frame.bones:
        assert [abs(each) for each in turned] == [1, 0, 0, 0]
    assert frame.bones[0][2] == pytest.approx((0.0, 0.933, 0.0), abs=1e-3)
    assert not decoder.dropped


def test_the_parents_of_bones_are_those_that_a_real_app_tells(captured):
    data, decoder = captured[1], MocopiDecoder()
    assert decoder.feed(data) == []
    assert (decoder.unused, decoder.dropped) == (1, {})
    told = {}
    for part in data.split(b"bnid")[1:]:
        told[struct.unpack("<H", part[:2])[0]] = struct.unpack("<h", part.split(b"pbid")[1][:2])[0]
    assert tuple(told[bone] for bone in range(27)) == PARENTS


def test_an_instant_is_put_together_as_a_real_app_does(captured):
    data = captured[0]
    (frame,) = MocopiDecoder().feed(data)
    again = encode(frame)
    assert len(again) == len(data)
    # the same but for address and port of the sender, the wall clock, and the sign of a quaternion
    assert MocopiDecoder().feed(again) == [frame]
    assert [again[at : at + 4] for at in range(0, len(data), 4) if again[at : at + 4].isalpha()] == [
        data[at : at + 4] for at in range(0, len(data), 4) if data[at : at + 4].isalpha()
    ]


@given(st.lists(st.integers(0, 26), unique=True), st.lists(st.integers(1, 200)))
def test_instants_come_back_however_the_bytes_are_cut(bones, cuts):
    frame = Frame(3, 50, tuple((bone, (0.0, 1.0, 0.0, 0.0), (0.5, 0.25, 0.0)) for bone in bones))
    data, decoder, found = b"".join(map(encode, (frame, frame))), MocopiDecoder(), []
    for cut in [*cuts, len(data)]:
        found += decoder.feed(data[:cut])
        data = data[cut:]
    assert found == [frame, frame]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (encode(Frame(1, 1, ((0, (0.5, 0, 0, 0), (0, 0, 0)),))), "not_a_rotation"),
        (encode(Frame(1, 1, ((0, REST, (1e5, 0, 0)),))), "too_far"),
        (encode(Frame(1, 1, ())).replace(b"sony", b"sory"), "bad_field"),
        (b"something else", "noise"),
    ],
)
def test_what_cannot_be_is_dropped_and_counted_by_reason(data, reason):
    decoder = MocopiDecoder()
    assert decoder.feed(data) == []
    assert reason in decoder.dropped
    assert len(decoder.feed(encode(Frame(2, 2, ())))) == 1


@given(st.binary(max_size=300))
def test_no_bytes_raise(data):
    decoder = MocopiDecoder()
    decoder.feed(data)
    decoder.feed(encode(Frame(1, 1, ()))[:60] + data)
