"""Heat maps as bytes, and back."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.cameras.heat_map_messages import (
    FAINTEST,
    FOUND_BY_CAMERA,
    LONGEST,
    HeatMapMessage,
    HeatMapReceiver,
    camera_of,
    encode_heat_maps,
    quantised,
    retimed,
)

AFFINE = np.array([[0.05, 0.01, -3.0], [-0.01, 0.05, 7.25]])


def message(sequence=3, camera="links", seed=1):
    likelihood = np.random.default_rng(seed).random((4, 8, 6)).astype(np.float32)
    return HeatMapMessage(camera, "full", sequence, 123_456_789, quantised(likelihood), AFFINE)


def assert_same(a, b):
    assert (a.camera, a.network, a.sequence, a.time_ns) == (b.camera, b.network, b.sequence, b.time_ns)
    assert (a.likelihood == b.likelihood).all()
    assert (a.map_from_pixel == b.map_from_pixel).all()


@given(st.lists(st.integers(1, 60), max_size=40), st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_messages_come_out_of_any_pieces_of_a_stream(cuts, n):
    sent = [message(sequence, f"kamera{sequence}", sequence) for sequence in range(n)]
    stream = b"".join(map(encode_heat_maps, sent))
    receiver, found, begun = HeatMapReceiver(), [], 0
    for cut in cuts:
        found += receiver.receive(stream[begun : begun + cut])
        begun += cut
    found += receiver.receive(stream[begun:])
    assert len(found) == n
    for a, b in zip(sent, found, strict=True):
        assert_same(a, b)
    assert not receiver.dropped


def test_nobody_in_the_picture_is_a_message_too():
    nobody = HeatMapMessage("a", "lite", 9, 1, None, np.zeros((2, 3)))
    found = HeatMapReceiver().receive(encode_heat_maps(nobody))[0]
    assert found.likelihood is None
    assert (found.camera, found.network, found.sequence) == ("a", "lite", 9)


def test_likelihoods_lose_half_a_step_and_what_is_faint():
    values = np.linspace(0, 1, 1001, dtype=np.float32)
    back = quantised(values).astype(float) / 255
    assert np.abs(back - values)[values > (FAINTEST + 1) / 255].max() <= 0.5 / 255 + 1e-6
    assert back[values < (FAINTEST - 1) / 255].max() == 0


@given(st.binary(max_size=300))
@settings(max_examples=100, deadline=None)
def test_anything_before_a_message_is_passed_over(rubbish):
    receiver = HeatMapReceiver()
    found = receiver.receive(rubbish.replace(b"MGHM", b"") + encode_heat_maps(message()))
    assert len(found) == 1


@given(st.integers(0, 19), st.integers(0, 255))
@settings(max_examples=60, deadline=None)
def test_a_damaged_head_costs_no_message_behind_it(place, value):
    damaged = bytearray(encode_heat_maps(message()))
    damaged[place] = value
    receiver = HeatMapReceiver()
    receiver.receive(bytes(damaged))
    assert [each.sequence for each in receiver.receive(encode_heat_maps(message(77)))][-1:] == [77]


@given(st.binary(max_size=80), st.integers(0, 100))
@settings(max_examples=60, deadline=None)
def test_a_damaged_body_is_dropped_or_read_and_never_raises(rubbish, place):
    sent = encode_heat_maps(message())
    begin = 24 + place
    damaged = (sent[:begin] + rubbish + sent[begin + len(rubbish) :])[: len(sent)]
    receiver = HeatMapReceiver()
    found = receiver.receive(damaged + encode_heat_maps(message(77)))
    assert found[-1].sequence == 77


def test_a_length_beyond_all_measure_is_dropped_and_counted():
    head = bytearray(encode_heat_maps(message()))
    struct.pack_into("<I", head, 20, LONGEST + 1)
    receiver = HeatMapReceiver()
    assert len(receiver.receive(bytes(head) + encode_heat_maps(message()))) == 1
    assert receiver.dropped["too_long"] == 1


def test_a_bomb_is_not_unpacked():
    """Dimensions that promise less than the compressed data hold."""
    data = bytearray(encode_heat_maps(message()))
    n = len("links") + len("full")
    struct.pack_into("<3H", data, 24 + n + 48, 1, 1, 1)
    receiver = HeatMapReceiver()
    assert receiver.receive(bytes(data)) == []
    assert receiver.dropped["unreadable"] == 1


def test_retiming_changes_nothing_else():
    found = HeatMapReceiver().receive(retimed(encode_heat_maps(message()), 12, 99))[0]
    assert (found.sequence, found.time_ns) == (12, 99)
    assert (found.likelihood == message().likelihood).all()


def test_a_name_without_end_is_refused():
    with pytest.raises(ValueError, match="255 bytes"):
        encode_heat_maps(message(camera="a" * 256))


def test_whole_messages_are_told_from_what_is_not():
    message = encode_heat_maps(HeatMapMessage("a", "full", 1, 2, None, np.zeros((2, 3))))
    assert camera_of(message) == "a"
    assert camera_of(message + message) == "a"
    for other in (b"", message[:-1], message + b"x", message + message[:-1], b"x" + message[1:]):
        assert camera_of(other) is None


def test_people_have_numbers_and_one_person_the_bytes_of_version_1():
    one = encode_heat_maps(message())
    assert one[4] == 1
    for person, following in ((7, 1), (FOUND_BY_CAMERA + 3, 0), (0, 2)):
        sent = encode_heat_maps(replace(message(), person=person, following=following))
        assert sent[4] == 2
        found = HeatMapReceiver().receive(sent)[0]
        assert (found.person, found.following) == (person, following)
        assert_same(found, message())
    nobody = replace(message(), likelihood=None, person=7)
    assert HeatMapReceiver().receive(encode_heat_maps(nobody))[0].person == 7
