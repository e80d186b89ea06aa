"""Two slots of flash: power is cut at every byte and every erasure, and the settings are old or new."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from random import Random
from zlib import crc32

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol import SETTINGS, FlashError, SlotStore, factory_settings
from firmware_protocol.flash_slots import (
    MAX_IMAGE_SIZE,
    SLOT_MAGIC,
    SLOT_SIZE,
    decode_slot,
    encode_slot,
    is_newer,
)

seeded = settings(deadline=None, derandomize=True)

SIZE = 256
CALIBRATION = tuple(place / 4 for place in range(30))


class PowerCut(Exception):
    """The lights went out."""


class ModelFlash:
    """NOR flash: erased by slots to 0xFF, programming clears bits, byte after byte.

    Power is cut in the step ``cut_at``: the programming of one byte, or one erasure. The byte in
    progress then keeps the bits set in ``survivors`` of those that were to be cleared; an erasure in
    progress leaves the bytes that ``mixture`` makes of the old ones.
    """

    def __init__(self) -> None:
        self.cells = bytearray(b"\xff" * (2 * SIZE))
        self.steps = 0
        self.cut_at: int | None = None
        self.survivors = 0x00
        self.mixture = bytes
        self.is_erasing: list[bool] = []

    def read(self, address: int, n: int) -> bytes:
        return bytes(self.cells[address : address + n])

    def erase(self, slot: int) -> None:
        start, stop = slot * SIZE, (slot + 1) * SIZE
        if self._is_cut(is_erasing=True):
            self.cells[start:stop] = self.mixture(self.cells[start:stop])
            raise PowerCut
        self.cells[start:stop] = b"\xff" * SIZE

    def program(self, address: int, data: bytes) -> None:
        for place, byte in enumerate(data, address):
            if self._is_cut(is_erasing=False):
                self.cells[place] &= byte | self.survivors
                raise PowerCut
            self.cells[place] &= byte

    def _is_cut(self, is_erasing: bool) -> bool:
        self.steps += 1
        self.is_erasing.append(is_erasing)
        return self.steps - 1 == self.cut_at


def flash_with(*committed: dict[int, object], generation: int = 0) -> ModelFlash:
    """A flash in which these settings were committed one after another, the first as a generation."""
    flash = ModelFlash()
    image = encode_slot(generation, committed[0])
    flash.cells[: len(image)] = image
    for later in committed[1:]:
        SlotStore(flash, SIZE).commit(later)
    return flash


def copy_of(flash: ModelFlash) -> ModelFlash:
    copy = ModelFlash()
    copy.cells[:] = flash.cells
    return copy


def half_erased(old: bytes, rng: Random) -> Iterator[bytes]:
    """What an erasure may leave: nothing done, all done, any part of the bytes, any part of the bits."""
    yield old
    yield b"\xff" * len(old)
    for place in range(len(old) + 1):
        yield b"\xff" * place + old[place:]
        yield old[:place] + b"\xff" * (len(old) - place)
    for _ in range(200):
        yield bytes(byte | rng.randrange(256) for byte in old)
        yield bytes(byte if rng.random() < 0.5 else 0xFF for byte in old)


SMALL = ({1: 5}, {1: 9})
MIDDLE = ({1: 5, 2: 100.0, 10: "left"}, {1: 5, 2: 200.0, 8: 3, 10: "right shank"})
LARGE = (factory_settings(), factory_settings() | {1: 63, 9: CALIBRATION, 10: "sixteen letters."})
SHRINKING = (LARGE[1], SMALL[1])

every_pair = pytest.mark.parametrize("pair", [SMALL, MIDDLE, LARGE, SHRINKING])
every_history = pytest.mark.parametrize(
    ("n_before", "generation"),
    [(0, 0), (1, 0), (2, 7), (3, 7), (1, 2**32 - 1), (2, 2**32 - 2), (2, 2**31 - 1)],
)


def before_and_after(
    pair: tuple[dict[int, object], dict[int, object]], n_before: int, generation: int
) -> tuple[ModelFlash, dict[int, object], dict[int, object]]:
    """A flash before the commit of the second settings of a pair, and what is loaded before and after."""
    old, new = pair
    flash = flash_with(*[old] * n_before, generation=generation) if n_before else ModelFlash()
    loaded = SlotStore(flash, SIZE).load()
    done = copy_of(flash)
    SlotStore(done, SIZE).commit(new)
    return flash, loaded, SlotStore(done, SIZE).load()


@every_pair
@every_history
def test_power_cut_at_every_byte_leaves_the_old_settings_or_the_new(
    pair: tuple[dict[int, object], dict[int, object]], n_before: int, generation: int
):
    flash, old, new = before_and_after(pair, n_before, generation)
    assert old != new
    probe = copy_of(flash)
    SlotStore(probe, SIZE).commit(pair[1])
    outcomes = []
    for step, is_erasing in enumerate(probe.is_erasing):
        for survivors in () if is_erasing else (0x00, 0x01, 0x80, 0x55, 0xAA, 0x7F, 0xFE, 0xFF):
            broken = copy_of(flash)
            broken.cut_at, broken.survivors = step, survivors
            with pytest.raises(PowerCut):
                SlotStore(broken, SIZE).commit(pair[1])
            loaded = SlotStore(broken, SIZE).load()
            assert loaded in (old, new)
            outcomes.append(loaded == new)
            # The next commit is none the worse for it.
            broken.cut_at = None
            SlotStore(broken, SIZE).commit(pair[1])
            assert SlotStore(broken, SIZE).load() == new
    # Only with the last bit of the magic are the new settings there.
    assert sum(outcomes) > 0
    assert not any(outcomes[:-8])


@every_pair
@every_history
def test_power_cut_in_an_erasure_leaves_the_old_settings(
    pair: tuple[dict[int, object], dict[int, object]], n_before: int, generation: int
):
    flash, old, _ = before_and_after(pair, n_before, generation)
    store = SlotStore(flash, SIZE)
    probe = copy_of(flash)
    SlotStore(probe, SIZE).commit(pair[1])
    assert probe.is_erasing[0]
    assert not any(probe.is_erasing[1:])
    before = bytes(flash.cells)
    (slot,) = {place // SIZE for place, (a, b) in enumerate(zip(before, probe.cells, strict=True)) if a != b}
    start = slot * SIZE
    for left in half_erased(before[start : start + SIZE], Random(1)):
        flash.cells[:] = before
        flash.steps, flash.cut_at, flash.mixture = 0, 0, lambda _, left=left: left
        with pytest.raises(PowerCut):
            store.commit(pair[1])
        assert store.load() == old


@pytest.mark.parametrize(("old", "new"), [SMALL])
def test_every_subset_of_the_bits_of_every_byte(old: dict[int, object], new: dict[int, object]):
    flash, before, after = before_and_after((old, new), 1, 41)
    probe = copy_of(flash)
    SlotStore(probe, SIZE).commit(new)
    for step in range(1, len(probe.is_erasing)):
        for survivors in range(256):
            broken = copy_of(flash)
            broken.cut_at, broken.survivors = step, survivors
            with pytest.raises(PowerCut):
                SlotStore(broken, SIZE).commit(new)
            assert SlotStore(broken, SIZE).load() in (before, after)


@seeded
@given(st.data())
def test_cuts_one_after_another_never_lose_what_was_committed(data: st.DataObject):
    flash, committed = ModelFlash(), factory_settings()
    for attempt in range(8):
        new = committed | {1: attempt, 10: "x" * data.draw(st.integers(0, 16))}
        flash.steps, flash.cut_at = 0, data.draw(st.none() | st.integers(0, MAX_IMAGE_SIZE))
        flash.survivors = data.draw(st.integers(0, 255))
        keep = data.draw(st.binary(min_size=8, max_size=8))
        flash.mixture = lambda old, keep=keep: bytes(b | keep[i % 8] for i, b in enumerate(old))
        try:
            SlotStore(flash, SIZE).commit(new)
            acceptable = [new]
        except PowerCut:
            acceptable = [committed, new]
        loaded = SlotStore(flash, SIZE).load()
        assert loaded in acceptable
        committed = loaded


def test_an_empty_flash_holds_the_factory_settings():
    store = SlotStore(ModelFlash(), SIZE)
    assert store.load() == factory_settings()
    assert store.generation is None


def test_commits_take_turns_and_count():
    flash = ModelFlash()
    store = SlotStore(flash, SIZE)
    assert [store.commit({1: n}) for n in range(4)] == [1, 2, 3, 4]
    slots = [decode_slot(flash.read(start, SIZE)) for start in (0, SIZE)]
    assert [slot and slot.generation for slot in slots] == [3, 4]
    assert store.load() == factory_settings() | {1: 3}


def test_the_count_wraps():
    store = SlotStore(flash_with({1: 1}, generation=2**32 - 1), SIZE)
    assert store.commit({1: 2}) == 0
    assert store.load()[1] == 2
    assert store.commit({1: 3}) == 1
    assert store.load()[1] == 3


@pytest.mark.parametrize(
    ("generation", "other", "newer"),
    [
        (1, 0, True),
        (0, 1, False),
        (5, 5, False),
        (0, 2**32 - 1, True),
        (2**31 - 1, 0, True),
        (2**31, 0, False),
    ],
)
def test_serial_number_arithmetic(generation: int, other: int, newer: bool):
    assert is_newer(generation, other) is newer


def test_a_slot_put_together_by_hand():
    content = struct.pack("<IIHH", 0x4D475331, 8, 7, 0) + bytes([1, 1, 9]) + bytes([2, 2, 0xD0, 0x07])
    image = content + struct.pack("<I", crc32(content))
    assert encode_slot(8, {2: 200.0, 1: 9}) == image
    assert content[:4] == b"1SGM"
    flash = ModelFlash()
    flash.cells[SIZE : SIZE + len(image)] = image
    assert SlotStore(flash, SIZE).load() == factory_settings() | {1: 9, 2: 200.0}
    assert SlotStore(flash, SIZE).generation == 8


def test_what_this_firmware_does_not_know_or_allow_gives_way_to_the_factory_value():
    entries = bytes([200, 1, 0, 1, 1, 64, 8, 1, 3, 10, 1])  # unknown key; module 64; mode 3; cut short
    content = struct.pack("<IIHH", SLOT_MAGIC, 0, len(entries), 0) + entries
    flash = ModelFlash()
    flash.cells[: len(content) + 4] = content + struct.pack("<I", crc32(content))
    assert SlotStore(flash, SIZE).load() == factory_settings() | {8: 3}


@seeded
@given(st.binary(max_size=300), st.booleans())
def test_any_bytes_in_flash_never_raise(data: bytes, has_magic: bool):
    flash = ModelFlash()
    image = (SLOT_MAGIC.to_bytes(4, "little") if has_magic else b"") + data
    flash.cells[: len(image)] = image
    flash.cells = flash.cells[: 2 * SIZE]
    assert SlotStore(flash, SIZE).load() == factory_settings()


class WornFlash(ModelFlash):
    """One byte no longer takes zeros."""

    def __init__(self, worn: int) -> None:
        super().__init__()
        self._worn = worn

    def program(self, address: int, data: bytes) -> None:
        super().program(address, data)
        self.cells[self._worn] = 0xFF


@pytest.mark.parametrize("worn", [0, 3, 5, 12, 30])
def test_worn_flash_is_noticed_and_the_old_settings_stay(worn: int):
    flash = WornFlash(SIZE + worn)
    image = encode_slot(3, {1: 7})
    flash.cells[: len(image)] = image
    store = SlotStore(flash, SIZE)
    with pytest.raises(FlashError, match="slot 1"):
        store.commit(factory_settings() | {1: 8})
    assert store.load()[1] == 7


def test_bad_settings_are_refused_before_anything_is_erased():
    flash = flash_with({1: 5})
    before = bytes(flash.cells)
    for bad, named in (({1: 64}, "module_id"), ({99: 1}, "setting 99"), ({10: "seventeen letters"}, "label")):
        with pytest.raises(ValueError, match=named):
            SlotStore(flash, SIZE).commit(bad)
    with pytest.raises(ValueError, match="a slot holds 64"):
        SlotStore(flash, 64).commit(factory_settings())
    assert flash.cells == before


def test_all_settings_fit_a_slot_with_room_to_spare():
    assert len(encode_slot(0, factory_settings())) == MAX_IMAGE_SIZE < SLOT_SIZE // 4
    assert set(factory_settings()) == set(SETTINGS)
