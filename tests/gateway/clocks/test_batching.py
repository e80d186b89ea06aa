"""Slots of a link found from the arrival times of its chunks."""

import numpy as np
import pytest

from gateway.clocks import LinkBatching, RelayBatching


def slot_of(arrivals_us):
    batching = LinkBatching()
    for at in np.round(np.sort(arrivals_us) * 1e3).astype(np.int64).tolist():
        batching.observe(at)
    return batching.slot_us


def sampled(n_modules=17, seconds=10, seed=1):
    rng = np.random.default_rng(seed)
    k = np.arange(seconds * 100)
    rows = [k * 1e4 * (1 + ppm * 1e-6) + rng.uniform(0, 1e4) for ppm in rng.uniform(-100, 100, n_modules)]
    return np.concatenate(rows) + rng.exponential(1000, n_modules * len(k))


@pytest.mark.parametrize("slot_us", [1000.0, 4000.0, 16000.0])
@pytest.mark.parametrize("late_us", [0.0, 40.0])
def test_usb_slots_are_found_though_the_host_wakes_late(slot_us, late_us):
    slots = np.ceil(sampled() / slot_us).astype(int)
    late = late_us * np.random.default_rng(2).exponential(1.0, slots.max() + 1)  # of all packets of a slot
    assert slot_of(slots * slot_us + late[slots]) == pytest.approx(slot_us, rel=0.03)


def test_a_link_without_slots_has_none():
    assert slot_of(sampled()) == 0.0
    assert slot_of(sampled(3)) == 0.0


def test_a_relay_s_tick_is_found_from_its_stamps_over_their_wrap_and_silent_ticks():
    batching, rng = RelayBatching(), np.random.default_rng(3)
    ticks = np.flatnonzero(rng.random(60) < 0.7)
    for stamp in (2**32 - 300_000 + 10_000 * ticks).tolist():
        for _ in range(rng.integers(1, 20)):
            batching.observe_tick(stamp % 2**32)
    assert batching.slot_us == 10_000.0
