"""A memory card's files."""

from __future__ import annotations

from zlib import crc32

import pytest

from devices.emulators.device.emulated_card import CardEntry, EmulatedCard


def test_files_grow_and_are_read_in_pieces():
    card = EmulatedCard()
    assert card.write(b"lost")  # nothing is recording: nothing is kept
    assert card.begin(1000)
    card.write(b"abc")
    card.write(b"defg")
    assert card.recording == 1
    card.begin(2000)
    card.write(b"xyz")
    card.end()
    assert card.recording is None
    assert card.entries() == [
        CardEntry(1, 7, 1000, crc32(b"abcdefg")),
        CardEntry(2, 3, 2000, crc32(b"xyz")),
    ]
    assert card.read(1, 2, 3) == b"cde"
    assert card.read(1, 5, 100) == b"fg"
    assert card.read(1, 7, 100) == b""
    assert card.read(1, 8, 1) is None


def test_numbers_are_not_used_again():
    card = EmulatedCard()
    card.begin(0)
    card.erase(1)
    assert card.recording is None
    card.begin(0)
    assert [entry.file for entry in card.entries()] == [2]
    card.erase_all()
    assert card.entries() == []
    with pytest.raises(KeyError):
        card.read(2, 0, 1)


def test_a_full_card_ends_the_recording_and_has_room_after_an_erasure():
    card = EmulatedCard(capacity=10)
    card.begin(0)
    assert card.write(b"123456")
    assert not card.write(b"12345")
    assert card.recording is None
    assert card.entries()[0].size == 6
    card.begin(0)
    assert card.write(b"1234")
    assert not card.begin(0)
    card.erase(1)
    assert card.begin(0)
    assert card.write(b"123456")
