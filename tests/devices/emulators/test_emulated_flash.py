"""Flash that wears like flash, and settings that survive whatever it does."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.emulators.device.emulated_flash import (
    ERASED,
    EmulatedFlash,
    PowerLost,
    StoredSettings,
    provision,
)
from firmware_protocol.device_settings import factory_settings
from firmware_protocol.flash_slots import SlotStore

SIZE = 64


def small(seed=0):
    return EmulatedFlash(2, SIZE, seed)


@given(st.binary(min_size=1, max_size=SIZE), st.binary(min_size=1, max_size=SIZE))
def test_programming_clears_bits_until_the_slot_is_erased(first, second):
    flash = small()
    assert flash.read(0, 2 * SIZE) == bytes([ERASED]) * 2 * SIZE
    flash.program(SIZE, first)
    flash.program(SIZE, second)
    n = min(len(first), len(second))
    assert flash.read(SIZE, n) == bytes(a & b for a, b in zip(first[:n], second[:n], strict=True))
    flash.program(0, b"\x12")
    flash.erase(1)
    assert flash.read(0, 1) == b"\x12"
    assert flash.read(SIZE, SIZE) == bytes([ERASED]) * SIZE


@given(st.binary(min_size=1, max_size=SIZE), st.integers(0, SIZE - 1), st.integers(0, 1000))
def test_a_power_cut_leaves_a_prefix_and_part_of_a_byte(data, step, seed):
    flash = small(seed)
    flash.cut_power_after(step)
    if step >= len(data):
        flash.program(0, data)
        return
    with pytest.raises(PowerLost):
        flash.program(0, data)
    assert flash.steps == step
    assert flash.read(0, step) == data[:step]
    in_progress = flash.read(step, 1)[0]
    assert in_progress & data[step] == data[step]  # nothing cleared that was to stay
    assert flash.read(step + 1, SIZE) == bytes([ERASED]) * SIZE
    flash.program(0, data)  # with power back it can be finished
    assert flash.read(0, len(data)) == data


def test_an_erasure_cut_short_leaves_a_mixture():
    mixtures = set()
    for seed in range(20):
        flash = small(seed)
        flash.program(0, bytes(SIZE))
        flash.cut_power_after(0)
        with pytest.raises(PowerLost):
            flash.erase(0)
        left = flash.read(0, SIZE)
        assert 0 in left
        assert ERASED in left
        assert any(byte not in (0, ERASED) for byte in left)
        mixtures.add(left)
        assert flash.read(SIZE, SIZE) == bytes([ERASED]) * SIZE
    assert len(mixtures) == 20


def test_addresses_outside_are_refused():
    flash = small()
    for call in (lambda: flash.read(2 * SIZE, 1), lambda: flash.program(-1, b"a"), lambda: flash.erase(2)):
        with pytest.raises(ValueError, match="the flash has 128"):
            call()


def steps_of_a_commit():
    flash = EmulatedFlash()
    provision(flash, {"module_id": 5})
    before = flash.steps
    provision(flash, {"module_id": 9})
    return flash.steps - before


@pytest.mark.parametrize("seed", [1, 2])
def test_settings_are_the_old_or_the_new_wherever_a_commit_is_cut(seed):
    n_steps, found = steps_of_a_commit(), []
    for step in range(n_steps + 1):
        flash = EmulatedFlash(seed=seed)
        provision(flash, {"module_id": 5, "label": "left"})
        settings = StoredSettings(flash)
        settings.stage(1, 9)
        settings.stage(10, "right")
        flash.cut_power_after(step)
        if step < n_steps:
            with pytest.raises(PowerLost):
                settings.commit()
        else:
            assert settings.commit() is not None
        flash.cut_power_after(None)
        restarted = StoredSettings(flash)
        found.append((restarted["module_id"], restarted["label"]))
        assert not restarted.staged
        assert not restarted.is_factory
        restarted.stage(1, 30)  # and the flash is fit for the next commit
        assert restarted.commit() is not None
        assert StoredSettings(flash)["module_id"] == 30
    assert set(found) == {(5, "left"), (9, "right")}
    assert found[0] == (5, "left")
    assert found[-1] == (9, "right")


def test_settings_by_name_and_key():
    flash = EmulatedFlash()
    settings = StoredSettings(flash)
    assert settings.is_factory
    assert settings["sampling_rate"] == factory_settings()[2]
    settings.stage(2, 50.0)
    assert settings.value(2) == 50.0
    assert settings["sampling_rate"] == factory_settings()[2]
    settings.discard()
    assert settings.value(2) == factory_settings()[2]
    settings.stage(2, 50.0)
    settings.commit()
    assert settings["sampling_rate"] == 50.0
    assert SlotStore(flash).load()[2] == pytest.approx(50.0)
    settings.reset()
    assert settings["sampling_rate"] == factory_settings()[2]
    with pytest.raises(KeyError):
        settings["colour"]


def test_worn_out_flash_fails_and_keeps_the_old_settings():
    flash = EmulatedFlash()
    provision(flash, {"module_id": 5})
    settings = StoredSettings(flash)
    settings.stage(1, 9)
    flash.is_worn_out = True
    assert settings.commit() is None
    assert settings["module_id"] == StoredSettings(flash)["module_id"] == 5
    assert settings.value(1) == 9  # still staged
