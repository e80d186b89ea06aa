"""Single wild values are taken out; motion, steps and losses are left alone."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gateway.frames import INERTIAL_SAMPLE, MAGNETIC_FIELD, NOT_READ, SPECIFIC_FORCE, InertialBatch
from gateway.sources.despiking import Despiker, SpikeLimits


def reading(sequence, value, module=0, magnetic=(10.0, 20.0, 30.0)):
    measured = (0.0, value, 9.8), (0.0, 0.0, value / 10), magnetic or NOT_READ
    return InertialBatch.of([(module, sequence, 10_000_000 * sequence, measured, 0)]).samples


def run(values, limits=None):
    despiker = Despiker(limits)
    out = [despiker.add(reading(k, v)) for k, v in enumerate(values)]
    return [sample["measured"][SPECIFIC_FORCE, 1] for given in out for sample in given], despiker


def test_a_spike_becomes_the_median_one_sample_later():
    values = [1.0, 2.0, 3.0, 500.0, 5.0, 6.0]
    clean, despiker = run(values)
    assert clean == [1.0, 2.0, 3.0, 5.0, 5.0]
    assert despiker.summary() == {"0": 2}  # both sensors of that sample


def test_fast_motion_and_steps_pass_unchanged():
    t = np.arange(200) / 100
    motion = (150 * np.sin(2 * np.pi * 4 * t)).tolist()
    assert run(motion)[0] == motion[:-1]
    step = [0.0] * 10 + [400.0] * 10
    clean, despiker = run(step)
    assert clean == step[:-1]
    assert not despiker.summary()


def test_around_a_lost_sample_nothing_is_judged():
    despiker = Despiker(SpikeLimits())
    out = [despiker.add(reading(k, v)) for k, v in ((0, 0.0), (1, 0.0), (3, 500.0), (4, 0.0), (5, 0.0))]
    assert [given["measured"][0, SPECIFIC_FORCE, 1] for given in out if len(given)] == [0.0, 0.0, 500.0, 0.0]


def test_modules_are_apart_and_absent_sensors_stay_absent():
    despiker = Despiker()
    assert not len(despiker.add(reading(0, 1.0, module=1)))
    assert not len(despiker.add(reading(0, 900.0, module=2)))
    (first,) = despiker.add(reading(1, 1.0, module=1, magnetic=None))
    assert first["measured"][SPECIFIC_FORCE, 1] == 1.0
    (second,) = despiker.add(reading(2, 1.0, module=1))
    assert np.isnan(second["measured"][MAGNETIC_FIELD]).all()


class PlainDespiker:
    """The same, one sample after another."""

    def __init__(self, limits):
        self.spikes, self._limits, self._last = {}, limits, {}

    def add(self, sample):
        module = int(sample["module"])
        before, middle = self._last.get(module, (None, None))
        self._last[module] = middle, sample
        if before is not None and before["sequence"] + 1 == middle["sequence"] == sample["sequence"] - 1:
            for sensor, limit in enumerate(self._limits):
                three = np.stack([each["measured"][sensor] for each in (before, middle, sample)])
                median = np.sort(three, axis=0)[1]
                if not np.isnan(three).any() and (np.abs(three[1] - median) > limit).any():
                    middle["measured"][sensor] = median
                    self.spikes[module] = self.spikes.get(module, 0) + 1
        return middle


def values_of(sample):
    """To the bit, without the bytes between fields."""
    return *(int(sample[name]) for name in ("module", "sequence", "time_ns")), sample["measured"].tobytes()


@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.sampled_from([1, 1, 1, 1, 2, 0]), st.sampled_from([0.1, 1.0, 40.0])),
        max_size=80,
    ),
    st.lists(st.integers(0, 80), max_size=4),
    st.integers(0, 2**32 - 1),
)
def test_batches_come_out_as_sample_by_sample(arriving, cuts, seed):
    rng = np.random.default_rng(seed)
    samples, counts = np.zeros(len(arriving), INERTIAL_SAMPLE), [0] * 4
    for sample, (module, step, size) in zip(samples, arriving, strict=True):
        counts[module] += step
        sample["module"], sample["sequence"] = 7 * module, counts[module]
        sample["measured"] = rng.normal(size=(3, 3)) * size
        sample["measured"][rng.random(3) < 0.1] = np.nan
    despiker, plain = Despiker(SpikeLimits(20.0, 2.0, 60.0)), PlainDespiker((20.0, 2.0, 60.0))
    expected = [given for given in map(plain.add, samples.copy()) if given is not None]
    made = [sample for part in np.split(samples, sorted(cuts)) for sample in despiker.add(part)]
    assert [values_of(sample) for sample in made] == [values_of(sample) for sample in expected]
    assert despiker.spikes == plain.spikes
    assert despiker.held_back == len({module for module, *_ in arriving})
