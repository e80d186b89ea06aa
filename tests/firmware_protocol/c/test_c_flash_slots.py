"""Settings in flash by the C header: old or new after every loss of power, and shared with Python's slots."""

from __future__ import annotations

import json
import random
import struct
import subprocess
from pathlib import Path
from typing import Any
from zlib import crc32

import pytest

from firmware_protocol.device_settings import SETTINGS, decode_value, encode_value, factory_settings
from firmware_protocol.flash_slots import MAX_IMAGE_SIZE, SLOT_SIZE, SlotStore, encode_slot
from firmware_protocol.golden import VECTORS

HERE = Path(__file__).parent
SANITIZED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


class MemoryFlash:
    """Two slots in memory; programming clears bits."""

    def __init__(self, image: bytes = b"\xff" * 2 * SLOT_SIZE) -> None:
        self.image = bytearray(image)

    def read(self, address: int, n: int) -> bytes:
        return bytes(self.image[address : address + n])

    def erase(self, slot: int) -> None:
        self.image[slot * SLOT_SIZE : (slot + 1) * SLOT_SIZE] = b"\xff" * SLOT_SIZE

    def program(self, address: int, data: bytes) -> None:
        for place, byte in enumerate(data, address):
            self.image[place] &= byte


@pytest.fixture(scope="module")
def driver(compile_c) -> Path:
    return compile_c(HERE / "flash_driver.c", *SANITIZED)


def run(driver: Path, *arguments: str, given: bytes = b"") -> bytes:
    done = subprocess.run([driver, *arguments], input=given, capture_output=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout


def loaded_by_c(driver: Path, image: bytes) -> tuple[list[int], dict[int, Any]]:
    """(found, slot, generation) and the settings as the C header loads them."""
    state, *lines = run(driver, "load", str(SLOT_SIZE), given=image).decode().splitlines()
    values = (line.split() for line in lines)
    return list(map(int, state.split())), {int(k): decode_value(int(k), bytes.fromhex(v)) for k, v in values}


def committed_by_c(driver: Path, image: bytes, settings: dict[int, Any]) -> bytes:
    encoded = ((key, encode_value(key, value)) for key, value in settings.items())
    given = image + b"".join(bytes([key, len(value)]) + value for key, value in encoded)
    return run(driver, "commit", str(SLOT_SIZE), given=given)


def some_settings(number: int) -> dict[int, Any]:
    rng = random.Random(number)
    return {
        1: rng.randint(0, 63),
        2: decode_value(2, encode_value(2, rng.uniform(1, 4000))),
        8: rng.randint(1, 3),
        9: tuple(float(rng.randint(-99, 99)) / 8 for _ in range(30)),
        10: f"left µ {number}",
    }


def test_after_every_loss_of_power_the_old_settings_or_the_new_ones_are_there(driver: Path):
    """Each byte erased and programmed, each subset of its bits, three orders of erasure, four starts."""
    cuts, old_kept, new_taken, bad = map(int, run(driver, "cuts").split())
    assert bad == 0
    assert old_kept + new_taken == cuts
    steps = 256 + MAX_IMAGE_SIZE
    assert cuts > 3 * 4 * steps
    # Only the last bits of the magic's last byte, when all are programmed, make the new settings count.
    assert new_taken == 3 * 4


def test_losses_of_power_one_upon_another_leave_whole_settings(driver: Path):
    cuts, old_kept, new_taken, bad = map(int, run(driver, "walk").split())
    assert (cuts, bad) == (20_000, 0)
    assert min(old_kept, new_taken) > 1000


def test_flash_that_does_not_take_a_byte_fails_the_commit_and_keeps_the_old_settings(driver: Path):
    cuts, old_kept, _, bad = map(int, run(driver, "stuck").split())
    assert (cuts, bad) == (MAX_IMAGE_SIZE, 0)
    assert old_kept > cuts // 2


def test_erased_flash_gives_the_factory_settings_on_both_sides(driver: Path):
    (found, _, _), settings = loaded_by_c(driver, bytes(MemoryFlash().image))
    assert not found
    assert settings == factory_settings() == SlotStore(MemoryFlash()).load()


def test_what_either_side_commits_the_other_loads(driver: Path):
    flash = MemoryFlash()
    for number in range(1, 13):
        wanted = factory_settings() | some_settings(number)
        if number % 3:
            flash = MemoryFlash(committed_by_c(driver, bytes(flash.image), some_settings(number)))
        else:
            assert SlotStore(flash).commit(wanted) == number
        store = SlotStore(flash)
        (found, slot, generation), loaded = loaded_by_c(driver, bytes(flash.image))
        assert (found, slot, generation) == (1, 1 - number % 2, number)
        assert store.generation == number
        assert loaded == store.load() == wanted


def test_both_sides_write_the_same_image(driver: Path):
    settings = factory_settings() | some_settings(1)
    flash = MemoryFlash()
    SlotStore(flash).commit(settings)
    assert committed_by_c(driver, b"\xff" * 2 * SLOT_SIZE, settings) == bytes(flash.image)


def test_the_golden_slot_is_loaded_and_its_generation_wraps(driver: Path):
    slot = json.loads((VECTORS / "settings.json").read_text(encoding="utf-8"))["slot"]
    image = next(bytes.fromhex(v) for name, v in slot.items() if name not in ("generation", "settings"))
    flash = image.ljust(2 * SLOT_SIZE, b"\xff")
    state, loaded = loaded_by_c(driver, flash)
    assert state == [1, 0, slot["generation"]] == [1, 0, 2**32 - 1]
    expected = {s["key"]: decode_value(s["key"], bytes.fromhex(s["bytes"])) for s in slot["settings"]}
    assert loaded == expected
    wrapped = committed_by_c(driver, flash, some_settings(2))
    assert loaded_by_c(driver, wrapped)[0] == [1, 1, 0]
    assert SlotStore(MemoryFlash(wrapped)).generation == 0


def test_a_slot_of_another_firmware_gives_what_is_known_on_both_sides(driver: Path):
    """Only some settings; then, by hand, an unknown key, a value of wrong size and one out of range."""
    flash = MemoryFlash(encode_slot(5, {2: 250.0}).ljust(2 * SLOT_SIZE, b"\xff"))
    assert (
        loaded_by_c(driver, bytes(flash.image))[1]
        == SlotStore(flash).load()
        == factory_settings() | {2: 250.0}
    )
    for entries in (b"\xc8\x03abc\x01\x01\x05", b"\x02\x01\x05\x01\x01\x05", b"\x01\x01\x40\x08\x01\x03"):
        image = image_of(entries)
        flash = MemoryFlash(image)
        assert SlotStore(flash).generation == 6
        state, loaded = loaded_by_c(driver, image)
        assert state == [1, 0, 6]
        assert loaded == SlotStore(flash).load()


def test_a_value_that_runs_past_the_end_of_its_slot_is_none(driver: Path):
    """The checksum is right, so it was written so; the value that is said to be longer is not taken."""
    state, loaded = loaded_by_c(driver, image_of(b"\x08\x01\x03\x01\x05\x07"))
    assert state == [1, 0, 6]
    assert loaded == factory_settings() | {8: 3}


def image_of(entries: bytes) -> bytes:
    content = struct.pack("<IIHH", 0x4D475331, 6, len(entries), 0) + entries
    return (content + struct.pack("<I", crc32(content))).ljust(2 * SLOT_SIZE, b"\xff")


def test_random_damage_to_either_slot_is_the_same_to_both_sides(driver: Path):
    rng = random.Random(9)
    flash = MemoryFlash()
    for number in (1, 2):
        SlotStore(flash).commit(factory_settings() | some_settings(number))
    outcomes = set()
    for _ in range(60):
        spoilt = MemoryFlash(flash.image)
        for slot in rng.choice(([], [0], [1], [0, 1])):
            spoilt.image[slot * SLOT_SIZE + rng.randrange(MAX_IMAGE_SIZE)] ^= 1 << rng.randrange(8)
        (found, _, generation), loaded = loaded_by_c(driver, bytes(spoilt.image))
        store = SlotStore(spoilt)
        assert (generation if found else None) == store.generation
        assert loaded == store.load()
        outcomes.add(store.generation)
    assert outcomes == {None, 1, 2}
    assert set(SETTINGS) == set(loaded)
