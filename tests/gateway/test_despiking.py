"""Single wild values are taken out; motion, steps and losses are left alone."""

import numpy as np

from gateway.frames import MAGNETIC_FIELD, NOT_READ, SPECIFIC_FORCE, InertialBatch
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
