"""Faults of the body's sensors through the wire: nothing but numbers, a word in status, neighbours well."""

import numpy as np
import pytest

from benchmarks.body_faults import (
    ML_CASES,
    MODULE_CASES,
    Case,
    emulated,
    is_finite,
    largest_step_deg,
    outcome,
    suit_with_position,
    told_after_s,
)

pytestmark = pytest.mark.slow

BY_NAME = {case.name: case for case in (*MODULE_CASES, *ML_CASES)}
VICTIM, NEIGHBOURS, OTHERS = [2], [1, 3], [0, 4, 5, 6]
EVERYONE = VICTIM + NEIGHBOURS + OTHERS


@pytest.fixture(scope="module")
def suit():
    return suit_with_position()


@pytest.fixture(scope="module")
def calm(suit):
    """The same walk without fault."""
    return emulated(suit, Case("nothing", lasts_s=0.0))


def test_a_module_that_dies_and_comes_back(suit, calm):
    case = BY_NAME["module dies, comes back after 10 s"]
    run = emulated(suit, case)
    assert is_finite(run)
    assert told_after_s(run, VICTIM) < 0.2
    assert outcome(run, calm, VICTIM, case).recovery_s < 8.0
    assert outcome(run, calm, NEIGHBOURS, case).recovery_s < 10.0
    assert outcome(run, calm, OTHERS, case).worst_deg < 3.0


@pytest.mark.parametrize("name", ["gyrometer saturated for 2 s", "gyrometer stuck for 5 s"])
def test_a_gyrometer_that_lies_is_told_and_harms_nobody_else(suit, calm, name):
    case = BY_NAME[name]
    run = emulated(suit, case)
    assert is_finite(run)
    assert told_after_s(run, VICTIM) < 1.0
    near = outcome(run, calm, NEIGHBOURS, case)
    assert near.worst_deg < 8.0  # they show the module that comes back its heading, not the reverse
    assert near.recovery_s < 5.0
    assert outcome(run, calm, OTHERS, case).worst_deg < 2.0


def test_a_magnet_turns_nobody(suit, calm):
    case = BY_NAME["magnet of 60 µT passes for 5 s"]
    assert outcome(emulated(suit, case), calm, EVERYONE, case).worst_deg < 2.0


def test_a_local_device_that_falls_silent(suit, calm):
    case = BY_NAME["local device silent for 5 s"]
    run = emulated(suit, case)
    assert is_finite(run)
    assert np.isfinite(run.p_w[200:]).all()
    assert told_after_s(run, EVERYONE) == pytest.approx(0.5, abs=0.2)
    assert largest_step_deg(run, 17.0, 22.0) < 0.5
    assert outcome(run, calm, EVERYONE, case).worst_deg < 5.0
