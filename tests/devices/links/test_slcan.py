"""The slcan text codec, by table, by property and with noise."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.links.slcan import SlcanDecoder, encode_slcan, open_commands
from firmware_protocol.can_framing import FD_LENGTHS, CanFrame

# Lines with their meaning; the first two are examples of the LAWICEL CANUSB manual.
GOLDEN = [
    (b"t10021133\r", CanFrame(0x100, bytes.fromhex("1133"), is_extended=False)),
    (b"T0000010021133\r", CanFrame(0x100, bytes.fromhex("1133"))),
    (b"t7FF0\r", CanFrame(0x7FF, b"", is_extended=False)),
    (b"T1FFFFFFF80102030405060708\r", CanFrame(0x1FFFFFFF, bytes(range(1, 9)))),
    (b"r1230\r", CanFrame(0x123, b"", is_extended=False, is_remote=True)),
    (b"R000001000\r", CanFrame(0x100, b"", is_remote=True)),
    (b"d1239" + b"AB" * 12 + b"\r", CanFrame(0x123, b"\xab" * 12, is_extended=False, is_fd=True)),
    (b"D00000123F" + b"01" * 64 + b"\r", CanFrame(0x123, b"\x01" * 64, is_fd=True)),
    (b"b123101\r", CanFrame(0x123, b"\x01", is_extended=False, is_fd=True, bitrate_switch=True)),
    (b"B1ABCDEF0D" + b"7E" * 32 + b"\r", CanFrame(0x1ABCDEF0, b"\x7e" * 32, is_fd=True, bitrate_switch=True)),
]

MALFORMED = [
    b"T0000010021\r",  # data shorter than the length says
    b"t100211334\r",  # half a byte more
    b"t1002113399\r",  # one byte more: no time stamp has two digits
    b"t1009112233445566778899\r",  # classic frames have at most 8 bytes
    b"t8000\r",  # more than 11 bits
    b"T200000000\r",  # more than 29 bits
    b"t12\r",
    b"t\r",
    b"tXYZ0\r",
    b"t+120\r",  # Python would read +12 as a number
    b"t1_00\r",
    b"x123\r",
    b"\x00\xff\xfe\r",
    b"T" * 5000 + b"\r",
]


@pytest.mark.parametrize(("text", "frame"), GOLDEN)
def test_each_line_is_read_whole_bytewise_and_after_noise(text, frame):
    decoder = SlcanDecoder()
    assert decoder.feed(text) == [frame]
    assert [found for byte in text for found in decoder.feed(bytes([byte]))] == [frame]
    assert decoder.malformed == 0
    assert decoder.feed(b"~garbage\r" + text + text[:-1]) == [frame]
    assert decoder.feed(b"\r") == [frame]
    assert (decoder.accepted, decoder.malformed) == (4, 1)


@pytest.mark.parametrize(("text", "frame"), GOLDEN)
def test_each_frame_is_written_as_its_line(text, frame):
    assert encode_slcan(frame) == text


@pytest.mark.parametrize(("text", "frame"), GOLDEN)
@pytest.mark.parametrize("stamp", [b"1A2B", b"0001E240"])
def test_time_stamps_and_lower_case_and_line_feeds_are_tolerated(text, frame, stamp):
    letter, digits = text[:1], text[1:-1]
    decoder = SlcanDecoder()
    assert decoder.feed(letter + digits.lower() + stamp + b"\r\n" + text) == [frame, frame]
    assert decoder.malformed == 0


@pytest.mark.parametrize("line", MALFORMED)
def test_malformed_line_is_counted_once_and_the_next_one_read(line):
    text, frame = GOLDEN[0]
    decoder = SlcanDecoder()
    assert decoder.feed(line + text) == [frame]
    assert decoder.malformed == 1
    assert [found for byte in line + text for found in decoder.feed(bytes([byte]))] == [frame]
    assert decoder.malformed == 2


def test_answers_of_the_adapter_are_no_defects():
    text, frame = GOLDEN[1]
    decoder = SlcanDecoder()
    assert decoder.feed(b"\r\x07\rV1013\rN1234\rz\rZ\rF04\r\x07" + text) == [frame]
    assert (decoder.malformed, decoder.refused) == (0, 2)


def test_endless_line_needs_no_memory():
    decoder = SlcanDecoder()
    for _ in range(1000):
        assert decoder.feed(b"T" * 100) == []
        assert len(decoder._partial) < 300
    assert decoder.feed(b"\r" + GOLDEN[0][0]) == [GOLDEN[0][1]]
    assert decoder.malformed == 1


@st.composite
def can_frames(draw: st.DrawFn) -> CanFrame:
    is_extended, is_fd = draw(st.booleans()), draw(st.booleans())
    identifier = draw(st.integers(0, 0x1FFFFFFF if is_extended else 0x7FF))
    length = draw(st.sampled_from(FD_LENGTHS if is_fd else FD_LENGTHS[:9]))
    data = draw(st.binary(min_size=length, max_size=length))
    switch = is_fd and draw(st.booleans())
    return CanFrame(identifier, data, is_extended, is_fd, bitrate_switch=switch)


@given(st.lists(can_frames(), max_size=8), st.integers(1, 40))
@settings(max_examples=60, deadline=None)
def test_round_trip_in_pieces_of_any_size(frames, size):
    text = b"".join(map(encode_slcan, frames))
    decoder = SlcanDecoder()
    found = [f for start in range(0, len(text), size) for f in decoder.feed(text[start : start + size])]
    assert found == frames
    assert decoder.malformed == 0


@given(st.lists(st.binary(max_size=400), max_size=10))
@settings(max_examples=60, deadline=None)
def test_any_bytes_at_all_do_not_raise_and_do_not_spoil_what_follows(chunks):
    decoder = SlcanDecoder()
    for chunk in chunks:
        decoder.feed(chunk)
    decoder.feed(b"\r")
    assert decoder.feed(GOLDEN[0][0]) == [GOLDEN[0][1]]


@pytest.mark.parametrize(
    "frame",
    [
        CanFrame(0x800, b"", is_extended=False),
        CanFrame(1 << 29, b""),
        CanFrame(1, bytes(9)),
        CanFrame(1, bytes(13), is_fd=True),
        CanFrame(1, b"", is_error=True),
        CanFrame(1, b"", is_fd=True, is_remote=True),
    ],
)
def test_frame_that_can_does_not_have_is_refused(frame):
    with pytest.raises(ValueError, match="is not a frame that can be sent"):
        encode_slcan(frame)


def test_open_commands():
    assert open_commands(1_000_000) == [b"C\r", b"S8\r", b"O\r"]
    assert open_commands(500_000, 5_000_000) == [b"C\r", b"S6\r", b"Y5\r", b"O\r"]


def test_unknown_bit_rate_names_the_nearest():
    with pytest.raises(ValueError, match="no bit rate 900000; the nearest is 800000"):
        open_commands(900_000)
    with pytest.raises(ValueError, match="no bit rate 3000000; the nearest is 2000000"):
        open_commands(1_000_000, 3_000_000)
