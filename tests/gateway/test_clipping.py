"""Ends of ranges are found where values stay flat, and nowhere else; nothing else of a sample changes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gateway.body.rig import load_rig
from gateway.body.skeleton import SensorRanges
from gateway.frames import ANGULAR_RATE, INERTIAL_SAMPLE, SPECIFIC_FORCE, Clipped, InertialBatch
from gateway.pipeline import Pipeline
from gateway.stages.clipping import SMALLEST_RANGES, RangeWatch
from gateway.stages.frame_assembler import AssemblyParams

LIMIT = 7.0  # rad/s


def swing(seconds: float = 20.0, rate_hz: float = 100.0, peak: float = 12.0, seed: int = 1) -> np.ndarray:
    """(n, 3) rad/s: sums of sines about three axes, the first up to about the peak."""
    rng = np.random.default_rng(seed)
    times = np.arange(round(seconds * rate_hz)) / rate_hz
    frequency, phase = rng.uniform(0.2, 1.5, (3, 3)), rng.uniform(0.0, 6.3, (3, 3))
    terms = np.sin(2.0 * np.pi * frequency[..., None] * times + phase[..., None])
    return (np.array([peak, 0.5 * peak, 0.3 * peak])[:, None] * terms.mean(axis=1) * 1.5).T


def samples(rate: np.ndarray, force: np.ndarray | None = None, module: int = 1) -> np.ndarray:
    """What a module sends."""
    sent = np.zeros(len(rate), INERTIAL_SAMPLE)
    sent["module"], sent["sequence"] = module, np.arange(len(rate))
    sent["measured"][:, SPECIFIC_FORCE] = [0.0, 0.0, 9.81] if force is None else force
    sent["measured"][:, ANGULAR_RATE] = rate
    sent["measured"][:, 2] = np.nan
    return sent


def marked(sent: np.ndarray, ranges: dict[int, SensorRanges] | None = None) -> np.ndarray:
    return RangeWatch(ranges or {}).add(sent)["clipped"]


@given(st.integers(0, 2**31), st.sampled_from([25.0, 100.0, 1000.0]), st.sampled_from([0.0, 0.001, 0.02]))
@settings(max_examples=60)
def test_what_is_not_clipped_passes_as_it_is(seed, rate_hz, noise):
    rng = np.random.default_rng(seed)
    rate = swing(8.0, rate_hz, float(rng.uniform(1.0, 30.0)), seed)
    quantum = float(rng.choice([1e-6, 1e-3, 0.02]))
    rate = np.round((rate + noise * rng.standard_normal(rate.shape)) / quantum) * quantum
    sent = samples(rate)
    assert RangeWatch({}).add(sent) is sent


@example(322, 0.0, False)  # the clipped axis made no small step for nine seconds, another did
@example(532, 0.0, True)
@example(1982, 0.01994, False)  # a value is 0.96 of the largest at its end
@example(5805, 0.0106158, False)  # the step into the end is next to nothing beside the others', too
@given(st.integers(0, 2**31), st.floats(0.0, 0.02), st.booleans())
@settings(max_examples=40)
def test_what_is_clipped_is_marked_soon_and_nothing_else_is(seed, skew, is_negative):
    rng = np.random.default_rng(seed)
    rate = swing(20.0, 100.0, 14.0, seed) * (-1.0 if is_negative else 1.0)
    true = rate + 0.001 * rng.standard_normal(rate.shape)
    flat = np.clip(true, -LIMIT, LIMIT)
    sent = samples(flat + skew * np.roll(flat, 1, axis=1))  # makers mix axes to put them square
    found = marked(sent) & Clipped.ANGULAR_RATE > 0
    is_high = np.maximum(0.0, true[:, 0]) >= LIMIT
    runs = np.split(np.arange(len(found)), np.flatnonzero(np.diff(is_high)) + 1)
    sharp = [run for run in runs if is_high[run[0]] and run[0] > 500 and len(run) > 12]  # steps are known
    sharp = [run for run in sharp if true[run[0] - 1, 0] - true[run[0] - 2, 0] > 0.05]
    if sharp:
        after = np.arange(len(found)) >= sharp[0][8]
        assert found[is_high & after].mean() > 0.9  # skewed axes move the end by two percent
    near = (np.abs(flat) > 0.93 * LIMIT).any(axis=1)
    assert not found[~near].any()


def test_only_the_mark_changes():
    sent = samples(np.clip(swing(), -LIMIT, LIMIT))
    before = sent.copy()
    after = RangeWatch({}).add(sent)
    for name in INERTIAL_SAMPLE.names or ():
        np.testing.assert_array_equal(sent[name], before[name])
    for name in ("module", "sequence", "time_ns"):
        np.testing.assert_array_equal(after[name], before[name])
    np.testing.assert_array_equal(after["measured"], before["measured"])
    assert after["clipped"].any()


def test_batches_of_any_size_are_the_same():
    sent = np.concatenate([samples(np.clip(swing(), -LIMIT, LIMIT), module=m) for m in (1, 2)])
    sent = sent[np.argsort(sent["sequence"], kind="stable")]
    watch, whole = RangeWatch({}), marked(sent)
    parts = [watch.add(part)["clipped"] for part in np.split(sent, [1, 2, 50, 51, 777])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert set(watch.found()) == {1, 2}


@pytest.mark.parametrize("quantum", [1e-4, 0.01, 0.1])
def test_coarse_sensors_at_rest_are_left_alone(quantum):
    rng = np.random.default_rng(2)
    rest = np.round(0.3 * quantum * rng.standard_normal((4000, 3)) / quantum) * quantum
    force = [0.0, 0.0, 9.81] + np.round(0.3 * rng.standard_normal((4000, 3))) * quantum
    sent = samples(rest, force)
    assert RangeWatch({}).add(sent) is sent


def test_an_even_turn_is_left_alone():
    rng = np.random.default_rng(3)
    turn = np.clip(np.arange(2000) * 0.1, 0.0, 5.0)  # a turntable speeds up and stays
    rate = np.stack([turn, 0.0 * turn, 0.0 * turn], axis=1) + 0.002 * rng.standard_normal((2000, 3))
    sent = samples(np.round(rate / 0.001) * 0.001)
    assert RangeWatch({}).add(sent) is sent


def test_values_sent_again_are_left_alone():
    sent = samples(np.repeat(swing(), 8, axis=0))
    assert RangeWatch({}).add(sent) is sent


def test_small_values_are_no_end():
    sent = samples(np.clip(swing(peak=3.0), -0.9 * SMALLEST_RANGES[1], 0.9 * SMALLEST_RANGES[1]))
    assert RangeWatch({}).add(sent) is sent


def test_an_end_that_larger_values_pass_was_none():
    rate = swing(40.0)
    rate[:2000] = np.clip(rate[:2000], -LIMIT, LIMIT)
    found = marked(samples(rate))
    assert found[:2000].any()
    beyond = np.flatnonzero(np.abs(rate[:, 0]) > 1.1 * LIMIT)
    assert len(beyond) > 20
    assert not found[beyond[-5:]].any()


def test_an_end_of_one_axis_holds_for_all_either_way():
    rate = swing(30.0, peak=14.0)
    rate[1500:] = -rate[1500:, [1, 2, 0]] * (LIMIT + 3.0) / np.abs(rate[1500:, 0]).max()
    flat = np.clip(rate, -LIMIT, LIMIT)
    found, is_high = marked(samples(flat)), (np.abs(rate) >= LIMIT).any(axis=1)
    assert found[:1500].any()
    assert is_high[1500:].sum() > 20
    assert found[1500:][is_high[1500:]].all()


def test_one_wild_value_does_not_hide_the_end():
    rate = np.clip(swing(40.0), -LIMIT, LIMIT)
    rate[100, 0] = 30.0
    assert marked(samples(rate))[200:].sum() > 20


def test_a_stated_range_counts_from_the_first_sample():
    rate = np.clip(swing(), -LIMIT, LIMIT)
    stated = {1: SensorRanges(angular_rate=0.999 * LIMIT)}
    found = marked(samples(rate), stated) & Clipped.ANGULAR_RATE > 0
    assert found[(np.abs(rate) >= 0.999 * LIMIT).any(axis=1)].all()
    assert not found[(np.abs(rate) < 0.97 * LIMIT).all(axis=1)].any()
    assert not marked(samples(rate, module=2), stated)[:5].any()


def test_an_accelerometer_that_is_clipped_is_told_as_such():
    force = 5.0 * swing(peak=12.0)
    watch = RangeWatch({})
    found = watch.add(samples(0.1 * swing(seed=5), np.clip(force, -19.6, 19.6)))["clipped"]
    assert set(found.tolist()) == {0, Clipped.SPECIFIC_FORCE}
    told = watch.summary()["1"]
    assert told["specific_force_ms2"] == pytest.approx(19.6, rel=0.02)
    assert told["specific_force_samples"] == np.count_nonzero(found)


def test_lost_samples_are_no_step():
    sent = samples(np.clip(swing(), -LIMIT, LIMIT))
    lost = sent[np.arange(len(sent)) % 4 != 3]  # never five in a row
    assert not marked(lost).any()


@pytest.mark.parametrize("is_stated", [False, True])
def test_frames_are_marked_whether_the_rig_states_the_range_or_not(is_stated):
    suit = load_rig("single_placed")
    module = suit.module_ids[0]
    ranges = {module: SensorRanges(angular_rate=LIMIT)} if is_stated else {}
    params = AssemblyParams(1e7, 10**7, 10**8, 10**8)
    stage = Pipeline(replace(suit, ranges=ranges), params).module_stage
    sent = samples(np.clip(swing(), -LIMIT, LIMIT), module=module)
    sent["time_ns"] = 10_000_000 * np.arange(1, len(sent) + 1)
    frames = []
    for k in range(len(sent)):
        frames += stage.add([InertialBatch(sent[k : k + 1])], int(sent["time_ns"][k]))
    assert any(frame.clipped is not None for frame in frames)
    assert stage.statistics()["clipped"][str(module)]["angular_rate_samples"] > 0
