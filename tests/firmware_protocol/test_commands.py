"""Verbs: arguments and payloads by hand, there and back, and refused when wrong."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol import (
    VERBS,
    Command,
    Result,
    Verb,
    decode_arguments,
    decode_payload,
    encode_arguments,
    encode_packet,
    encode_payload,
    encode_value,
)
from firmware_protocol.can_framing import MAX_CLASSIC_BODY_SIZE
from firmware_protocol.fields import INTEGER_RANGE, WireField
from firmware_protocol.messages import MAX_ARGUMENTS_SIZE, MAX_PAYLOAD_SIZE, RESULTS

seeded = settings(deadline=None, derandomize=True)


@pytest.mark.parametrize(
    ("verb", "values", "data"),
    [
        (Verb.HELLO, (1, 3), b"\x01\x03"),
        (Verb.IDENTIFY, (0,), b"\x00"),
        (Verb.GET_INFO, (), b""),
        (Verb.READ_SETTING, (9,), b"\x09"),
        (Verb.WRITE_SETTING, (2, b"\xd0\x07"), b"\x02\xd0\x07"),
        (Verb.COMMIT, (), b""),
        (Verb.FACTORY_RESET, (0x46414354,), b"TCAF"),
        (Verb.CARD_LIST, (513,), b"\x01\x02"),
        (Verb.CARD_READ, (1, 2, 192), b"\x01\x00\x02\x00\x00\x00\xc0"),
        (Verb.CARD_ERASE, (0xFFFF,), b"\xff\xff"),
    ],
)
def test_arguments_are_those_worked_out_by_hand(verb: Verb, values: tuple[Any, ...], data: bytes):
    assert encode_arguments(verb, *values) == data
    assert decode_arguments(verb, data) == values


FILES = ((1, 1000, 5, 0xCBF43926), (2, 2**32 - 1, 0, 0))


@pytest.mark.parametrize(
    ("verb", "values", "data"),
    [
        (Verb.HELLO, (0, 1, 1), b"\x00\x01\x01"),
        (Verb.STOP, (), b""),
        (Verb.READ_SETTING, (1, b"\x3f"), b"\x01\x3f"),
        (Verb.COMMIT, (2**32 - 1,), b"\xff\xff\xff\xff"),
        (Verb.CARD_LIST, (0, ()), b"\x00\x00"),
        (Verb.CARD_LIST, (9, FILES), b"\x09\x00" + b"".join(struct.pack("<HIII", *f) for f in FILES)),
        (Verb.CARD_READ, (1, 2, b""), b"\x01\x00\x02\x00\x00\x00"),
        (Verb.CARD_READ, (1, 2, b"abc"), b"\x01\x00\x02\x00\x00\x00abc"),
    ],
)
def test_payloads_are_those_worked_out_by_hand(verb: Verb, values: tuple[Any, ...], data: bytes):
    assert encode_payload(verb, *values) == data
    assert decode_payload(verb, data) == values


@pytest.mark.parametrize(
    ("verb", "data"),
    [
        (99, b""),
        (Verb.HELLO, b"\x01"),
        (Verb.HELLO, b"\x01\x01\x01"),
        (Verb.START, b"\x00"),
        (Verb.READ_SETTING, b""),
        (Verb.WRITE_SETTING, b"\x01" + bytes(200)),
        (Verb.FACTORY_RESET, b"FACT"),
        (Verb.FACTORY_RESET, bytes(4)),
        (Verb.CARD_READ, b"\x01\x00\x02\x00\x00\x00\xc1"),
    ],
)
def test_bad_arguments_are_none(verb: int, data: bytes):
    assert decode_arguments(verb, data) is None


@pytest.mark.parametrize(
    ("verb", "data"),
    [
        (99, b""),
        (Verb.COMMIT, b""),
        (Verb.CARD_LIST, b"\x01"),
        (Verb.CARD_LIST, b"\x01\x00" + bytes(13)),
        (Verb.CARD_READ, bytes(6 + 193)),
    ],
)
def test_a_bad_payload_is_none(verb: int, data: bytes):
    assert decode_payload(verb, data) is None


@pytest.mark.parametrize(
    ("verb", "values", "named"),
    [
        (99, (), "verb 99: there are 1 HELLO"),
        (Verb.HELLO, (1,), "HELLO.*min_version, max_version"),
        (Verb.HELLO, (1, 256), "HELLO.*max_version"),
        (Verb.IDENTIFY, (1.5,), "IDENTIFY.*seconds"),
        (Verb.FACTORY_RESET, (1,), "FACTORY_RESET.*magic"),
        (Verb.CARD_READ, (1, 0, 193), "CARD_READ.*length"),
        (Verb.WRITE_SETTING, (1, "text"), "WRITE_SETTING.*value"),
    ],
)
def test_encoding_refuses_and_names_verb_and_field(verb: int, values: tuple[Any, ...], named: str):
    with pytest.raises(ValueError, match=named):
        encode_arguments(verb, *values)


def test_as_many_files_are_listed_as_fit_an_answer():
    most = VERBS[Verb.CARD_LIST].max_entries
    assert most == (200 - 2) // 14
    files = tuple((n, n, n, n) for n in range(most))
    payload = encode_payload(Verb.CARD_LIST, 500, files)
    assert len(payload) <= MAX_PAYLOAD_SIZE
    assert decode_payload(Verb.CARD_LIST, payload) == (500, files)
    with pytest.raises(ValueError, match="CARD_LIST: 15 entries; 14 fit"):
        encode_payload(Verb.CARD_LIST, 500, (*files, files[0]))


def values(declared: WireField) -> st.SearchStrategy[Any]:
    if declared.code == "s":
        return st.binary(min_size=declared.min_size, max_size=declared.max_size)
    low, high = INTEGER_RANGE[declared.code]
    low = low if declared.minimum is None else int(declared.minimum)
    high = high if declared.maximum is None else int(declared.maximum)
    return st.integers(low, high)


@seeded
@given(st.sampled_from(sorted(VERBS)), st.data())
def test_arguments_and_payloads_round_trip(verb: int, data: st.DataObject):
    declared = VERBS[verb]
    sent = tuple(data.draw(values(f)) for f in declared.arguments)
    assert decode_arguments(verb, encode_arguments(verb, *sent)) == sent
    answer = tuple(data.draw(values(f)) for f in declared.payload)
    if declared.entries:
        entry = st.tuples(*map(values, declared.entries))
        answer += (tuple(data.draw(st.lists(entry, max_size=declared.max_entries))),)
    assert decode_payload(verb, encode_payload(verb, *answer)) == answer


@seeded
@given(st.integers(0, 255), st.binary(max_size=220))
def test_any_bytes_never_raise(verb: int, data: bytes):
    for decoded in (decode_arguments(verb, data), decode_payload(verb, data)):
        assert decoded is None or isinstance(decoded, tuple)


def test_every_verb_and_result_is_declared_with_a_sentence():
    assert set(VERBS) == {int(verb) for verb in Verb}
    assert set(RESULTS) == {int(result) for result in Result}
    for declared in VERBS.values():
        assert declared.sentence.endswith(".")
        for f in (*declared.arguments, *declared.payload, *declared.entries):
            assert f.name
            assert f.sentence.endswith(".")


def test_what_changes_the_device():
    changing = {declared.verb for declared in VERBS.values() if declared.changes_device}
    assert changing == {Verb.WRITE_SETTING, Verb.COMMIT, Verb.FACTORY_RESET, Verb.CARD_ERASE}


def test_the_longest_command_fits_classic_can():
    calibration = encode_value(9, (0.5,) * 30)
    arguments = encode_arguments(Verb.WRITE_SETTING, 9, calibration)
    assert len(arguments) <= MAX_ARGUMENTS_SIZE
    longest = Command(1, Verb.WRITE_SETTING, arguments=bytes(MAX_ARGUMENTS_SIZE))
    assert len(encode_packet(longest)) <= MAX_CLASSIC_BODY_SIZE
