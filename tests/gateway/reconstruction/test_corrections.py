"""Whom a filter believes too much, by its own corrections."""

import numpy as np
import pytest

from gateway.emulation.fast_arm import Switches, fast_arm, fast_motion, sampled
from gateway.reconstruction import update_many
from gateway.reconstruction.inertial.tree.prediction import (
    gyroscope_inflation,
    note_correction,
    row_inflation,
)
from gateway.reconstruction.inertial.tree.reconstructor import JointReconstructor
from gateway.reconstruction.inertial.tree.state import initial_state
from gateway.reconstruction.inertial.tree.tuning import tuning

DT, TUNING = 0.01, tuning()


def noted(steps):
    """Two segments whose first one was corrected so, (T, 2) rad."""
    segments = initial_state(2, 0).segments
    for x, y in steps:
        note_correction(segments[0].corrections, x, y, TUNING, DT)
    return segments


def test_corrections_that_go_on_tell_of_the_gyroscope():
    segments = noted(np.tile([1e-4, -2e-4], (2000, 1)))
    assert gyroscope_inflation(segments[0], 2.0, DT) == pytest.approx(2.0 * DT)
    assert row_inflation(segments[0], segments[1], TUNING) == 1.0


def test_corrections_to_and_fro_tell_of_the_rows():
    swing = np.sin(np.pi * np.arange(2000) * DT / 0.5)  # half a second each way
    segments = noted(1e-4 * np.stack([swing, -swing], axis=1))
    assert (
        row_inflation(segments[0], segments[1], TUNING)
        == row_inflation(segments[1], segments[0], TUNING)
        == pytest.approx(1.0 + TUNING.row_inflation)
    )
    assert gyroscope_inflation(segments[0], 2.0, DT) == 0.0


def test_corrections_that_are_new_each_time_tell_nothing_much():
    rng = np.random.default_rng(1)
    inflations = []
    for _ in range(20):
        segments = noted(1e-4 * rng.standard_normal((2000, 2)))
        inflations.append(
            (
                gyroscope_inflation(segments[0], 1.0, 1.0),
                row_inflation(segments[0], segments[1], TUNING) - 1.0,
            )
        )
    assert np.mean(inflations, axis=0)[0] < 0.2
    assert np.mean(inflations, axis=0)[1] < 0.2 * TUNING.row_inflation


def test_good_gyroscopes_of_a_fast_chain_are_hardly_believed_less():
    """As little as what corrections that are new each time seem to tell: on the mean, since single instants
    of single motions scatter from 0 to 0.5."""
    suit, shares = fast_arm(), []
    for seed in range(1, 7):
        body = JointReconstructor(suit, DT)
        update_many(body, sampled(suit, fast_motion(suit, seed), Switches(), seed)[:1500])
        shares.append(body.state()["segments"]["corrections"]["gyroscope"])
    assert np.mean(shares) < 0.2
