"""Whom a filter believes too much, by its own corrections."""

import numpy as np
import pytest

from gateway.emulation.fast_arm import Switches, fast_arm, fast_motion, sampled
from gateway.reconstruction import update_many
from gateway.reconstruction.inertial.chain_state import initial_state
from gateway.reconstruction.inertial.corrections import ROW_DOUBT, gyrometer_doubt, note_correction, row_doubt
from gateway.reconstruction.inertial.joint import JointReconstructor

DT = 0.01


def noted(steps):
    """A state of two segments whose first one was corrected so, (T, 2) rad."""
    state = initial_state(2, 0)
    for x, y in steps:
        note_correction(state, 0, x, y, DT)
    return state


def test_corrections_that_go_on_tell_of_the_gyrometer():
    state = noted(np.tile([1e-4, -2e-4], (2000, 1)))
    assert gyrometer_doubt(state, 0, 2.0, DT) == pytest.approx(2.0 * DT)
    assert row_doubt(state, 0, 1) == 1.0


def test_corrections_to_and_fro_tell_of_the_rows():
    swing = np.sin(np.pi * np.arange(2000) * DT / 0.5)  # half a second each way
    state = noted(1e-4 * np.stack([swing, -swing], axis=1))
    assert row_doubt(state, 0, 1) == row_doubt(state, 1, 0) == pytest.approx(1.0 + ROW_DOUBT)
    assert gyrometer_doubt(state, 0, 2.0, DT) == 0.0


def test_corrections_that_are_new_each_time_tell_nothing_much():
    rng = np.random.default_rng(1)
    doubts = []
    for _ in range(20):
        state = noted(1e-4 * rng.standard_normal((2000, 2)))
        doubts.append((gyrometer_doubt(state, 0, 1.0, 1.0), row_doubt(state, 0, 1) - 1.0))
    assert np.mean(doubts, axis=0)[0] < 0.2
    assert np.mean(doubts, axis=0)[1] < 0.2 * ROW_DOUBT


def test_good_gyrometers_of_a_fast_chain_are_hardly_doubted():
    suit = fast_arm()
    body = JointReconstructor(suit, DT)
    update_many(body, sampled(suit, fast_motion(suit, 1), Switches(), 1)[:1500])
    assert body.state()["corrections"][:, 7].max() < 0.1
