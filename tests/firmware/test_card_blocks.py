"""The relay's recorder on a card whose power goes in the middle of a block."""

from __future__ import annotations

import ctypes
import random
import zlib
from typing import NamedTuple

import pytest

from firmware_protocol.commands import ALL_FILES
from tests.firmware.machines import shared_library

BLOCK, HELD = 512, 484
"""Bytes of a block, and those of a file in it."""
DONE, BAD_ARGUMENTS, BUSY, NO_SUCH_FILE = 0, 2, 4, 7
SEEDS = range(60)


class Entry(NamedTuple):
    number: int
    size: int
    start_us: int
    crc: int


class ReadArguments(ctypes.Structure):
    _fields_ = [("file", ctypes.c_uint16), ("offset", ctypes.c_uint32), ("length", ctypes.c_uint8)]


class Card:
    """Blocks, and the recorder on them; a cut leaves the block under way half old and half new."""

    def __init__(self, library: ctypes.CDLL, n_blocks: int, content: bytes = b"") -> None:
        self.library, self.n_blocks = library, n_blocks
        self.blocks = bytearray(content.ljust(n_blocks * BLOCK, b"\0"))
        self.writes_left: int | None = None
        self.torn_at = 0
        number, data = ctypes.c_int, ctypes.c_void_p
        read, write = (ctypes.CFUNCTYPE(ctypes.c_int, number, data) for _ in range(2))
        self._kept = (
            ctypes.CFUNCTYPE(ctypes.c_int)(lambda: self.n_blocks),
            read(self._read),
            write(self._write),
        )
        for name, function in zip(("on_blocks", "on_read", "on_write"), self._kept, strict=True):
            ctypes.c_void_p.in_dll(library, name).value = ctypes.cast(function, ctypes.c_void_p).value
        for name in ("recorder_begin", "recorder_write"):
            getattr(library, name).restype = ctypes.c_bool
        library.recorder_mount()

    def _read(self, number: int, data: int) -> int:
        ctypes.memmove(data, bytes(self.blocks[number * BLOCK : (number + 1) * BLOCK]), BLOCK)
        return 1

    def _write(self, number: int, data: int) -> int:
        if self.writes_left == 0:
            return 1  # as far as the relay can tell; it has no power any more
        whole, size = ctypes.string_at(data, BLOCK), BLOCK
        if self.writes_left is not None:
            self.writes_left -= 1
            size = self.torn_at if self.writes_left == 0 else BLOCK
        self.blocks[number * BLOCK : number * BLOCK + size] = whole[:size]
        return 1

    def power_again(self) -> None:
        self.writes_left = None
        self.library.recorder_mount()

    def begin(self, time_us: int = 0) -> bool:
        return self.library.recorder_begin(time_us)

    def write(self, data: bytes) -> bool:
        return self.library.recorder_write(data, ctypes.c_size_t(len(data)))

    def end(self) -> None:
        self.library.recorder_end()

    def work(self, now_us: int) -> None:
        self.library.recorder_work(now_us)

    def erase(self, number: int) -> int:
        return self.library.card_erase(number)

    @property
    def files(self) -> list[Entry]:
        found: list[Entry] = []
        while True:
            payload, size = ctypes.create_string_buffer(198), ctypes.c_size_t(0)
            assert (
                self.library.card_list(len(found), payload, ctypes.c_size_t(198), ctypes.byref(size)) == DONE
            )
            raw = payload.raw[: size.value]
            numbers = [
                (raw[at : at + 2], raw[at + 2 : at + 6], raw[at + 6 : at + 10], raw[at + 10 : at + 14])
                for at in range(2, len(raw), 14)
            ]
            found += [Entry(*(int.from_bytes(each, "little") for each in entry)) for entry in numbers]
            if not numbers or len(found) >= int.from_bytes(raw[:2], "little"):
                return found

    def piece(self, number: int, offset: int, length: int) -> tuple[int, bytes]:
        payload, size = ctypes.create_string_buffer(198), ctypes.c_size_t(0)
        wanted = ReadArguments(number, offset, length)
        result = self.library.card_read(
            ctypes.byref(wanted), payload, ctypes.c_size_t(198), ctypes.byref(size)
        )
        return result, payload.raw[6 : size.value]

    def content(self, entry: Entry) -> bytes:
        read = b""
        while len(read) < entry.size:
            result, data = self.piece(entry.number, len(read), 192)
            assert (result, bool(data)) == (DONE, True)
            read += data
        assert zlib.crc32(read) == entry.crc
        return read


@pytest.fixture(scope="session")
def library(tmp_path_factory) -> ctypes.CDLL:
    built = tmp_path_factory.mktemp("recorder") / "recorder.so"
    return shared_library(built, "relay", ["recorder.c"], "blocks_shim.c")


@pytest.mark.parametrize("size", [0, 1, HELD - 1, HELD, HELD + 1, 5 * HELD, 9000])
def test_what_is_written_is_read_and_stands_there_after_a_restart(library, size):
    card, data = Card(library, 100), random.Random(size).randbytes(size)
    assert card.begin(77)
    assert card.write(data)
    for _ in range(2):
        (entry,) = card.files
        assert (entry.number, entry.size, entry.start_us) == (1, size, 77)
        assert card.content(entry) == data
        assert card.piece(1, size, 10) == (DONE, b"")
        assert card.piece(1, size + 1, 10)[0] == BAD_ARGUMENTS
        card.end()
        card.power_again()


def test_a_full_card_ends_the_file_and_says_so(library):
    card = Card(library, 5)
    assert card.begin()
    assert card.write(bytes(3 * HELD))
    assert not card.write(b"x")
    assert card.files[0].size == 3 * HELD
    assert card.write(b"x")  # nothing is open any more
    assert not card.begin()
    assert card.erase(1) == DONE
    assert card.begin()
    assert [entry.number for entry in card.files] == [2]


def test_erased_files_are_gone_for_good_and_their_numbers_do_not_come_again(library):
    card = Card(library, 1000)
    for k in range(20):
        assert card.begin()
        assert card.write(bytes([k]) * 1000)
    assert card.erase(20) == card.erase(ALL_FILES) == BUSY
    card.end()
    assert card.erase(3) == card.erase(17) == DONE
    assert card.erase(3) == card.erase(21) == NO_SUCH_FILE
    card.power_again()
    assert [entry.number for entry in card.files] == [*range(1, 3), *range(4, 17), *range(18, 21)]
    assert card.content(card.files[2]) == bytes([3]) * 1000
    assert card.erase(ALL_FILES) == DONE
    card.power_again()
    assert card.files == []
    assert card.begin()
    assert card.write(b"new")
    card.end()
    card.power_again()
    (entry,) = card.files
    assert (entry.number, card.content(entry)) == (21, b"new")


def test_the_card_of_somebody_else_is_not_written_to_until_it_is_erased(library):
    theirs = random.Random(1).randbytes(100 * BLOCK)
    card = Card(library, 100, theirs)
    assert not card.begin()
    assert card.files == []
    assert card.blocks == theirs
    assert card.erase(ALL_FILES) == DONE
    assert card.begin()
    card.power_again()
    assert len(card.files) == 1


@pytest.mark.parametrize("seed", SEEDS)
def test_whatever_is_cut_short_what_was_kept_before_stays(library, seed):
    """Files are recorded and erased until the power goes within a block, thrice."""
    rng, card = random.Random(seed), Card(library, 400)
    whole: dict[int, bytes] = {}
    last = 0
    for _ in range(3):
        card.writes_left = rng.randrange(1, 60)
        card.torn_at = rng.choice((rng.randrange(40), rng.randrange(BLOCK + 1)))  # heads differ in few bytes
        erased: list[int] = []
        is_within, now_us, data = False, 0, b""
        while card.writes_left:
            if not is_within:
                is_within = card.begin()
                assert is_within
                last, data = card.files[-1].number, b""
                assert last not in whole
            piece = rng.randbytes(rng.randrange(1, 300))
            card.write(piece)
            data += piece
            now_us += 100_000
            card.work(now_us)
            if rng.random() < 0.1:
                card.end()
                is_within = False
                if card.writes_left:
                    whole[last] = data
            if whole and rng.random() < 0.3 and card.writes_left:
                number = rng.choice(list(whole))
                card.erase(number)
                erased = [number]
                if card.writes_left:
                    del whole[number]
                    erased = []
        card.power_again()
        found = {entry.number: card.content(entry) for entry in card.files}
        for number, content in whole.items():
            assert found.get(number) == content or number in erased
        assert found.keys() <= whole.keys() | {last} | set(erased)
        whole = {number: content for number, content in whole.items() if number in found}
        if last in found and last not in whole:
            assert data.startswith(found[last])
            whole[last] = found[last]
