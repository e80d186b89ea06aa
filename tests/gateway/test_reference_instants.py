"""Mode 1: interpolation to the reference module's instants, against closed form."""

import numpy as np

from gateway.stages.fused_assembler import Datum, ReferenceInstants


def turn(angle):
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])


def datum(t):
    return Datum(t, np.array([t, -2.0 * t]), turn(t * 1e-3))


def test_vectors_go_straight_and_orientations_along_the_sphere():
    gather = ReferenceInstants(0, (0, 1, 2))
    sets = []
    for k in range(50):
        for module, shift in ((0, 0.0), (1, 3.0), (2, 7.5)):
            sets += gather.add(module, datum(10.0 * k + shift))
    assert len(sets) >= 48
    for k, found in enumerate(sets):
        instant = 10.0 * k
        assert found[0].time_us == instant
        for module in (1, 2):
            if k == 0:
                assert module not in found  # nothing before the first instant
                continue
            np.testing.assert_allclose(found[module].vector, [instant, -2 * instant], atol=1e-9)
            np.testing.assert_allclose(found[module].orientation, turn(instant * 1e-3), atol=1e-12)
    assert gather.incomplete == 1


def test_q_and_minus_q_are_the_same_orientation():
    gather = ReferenceInstants(0, (0, 1))
    gather.add(1, Datum(0.0, None, turn(0.2)))
    gather.add(1, Datum(10.0, None, -turn(0.4)))
    (found,) = gather.add(0, Datum(5.0))
    np.testing.assert_allclose(found[1].orientation, turn(0.3), atol=1e-12)
    assert found[1].vector is None


def test_a_silent_module_keeps_no_one_waiting_for_ever():
    gather = ReferenceInstants(0, (0, 1, 2), depth=4)
    sets = []
    for k in range(20):
        sets += gather.add(0, datum(10.0 * k))
        sets += gather.add(1, datum(10.0 * k))
    assert len(sets) == 16
    assert all(set(found) == {0, 1} for found in sets)
    assert gather.incomplete == 16


def test_a_datum_at_the_very_instant_is_taken_as_it_is():
    gather = ReferenceInstants(0, (0, 1))
    gather.add(0, datum(10.0))
    (found,) = gather.add(1, datum(10.0))
    assert found[1].time_us == 10.0
