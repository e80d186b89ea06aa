"""Faults of the body's sensors through the wire: nothing but numbers, a word in status, neighbours well."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.emulation.body_faults import (
    ML_CASES,
    MODULE_CASES,
    Case,
    emulated,
    fault_effect,
    is_finite,
    largest_step_deg,
    reported_after_s,
    suit_with_position,
)

BY_NAME = {case.name: case for case in (*MODULE_CASES, *ML_CASES)}
VICTIM, NEIGHBOURS, OTHERS = [2], [1, 3], [0, 4, 5, 6]
EVERYONE = VICTIM + NEIGHBOURS + OTHERS


BEGINS_S, LONGEST_S = 5.0, 13.0
"""The walk sets off at 2.75 s. Bounds are two to five times what three seeds gave at most."""


@pytest.fixture(scope="module")
def suit():
    return suit_with_position()


@pytest.fixture(scope="module")
def calm(suit):
    """The same walk without fault."""
    return emulated(suit, Case("nothing", lasts_s=0.0, seconds=LONGEST_S))


def shorter(name, lasts_s, seconds):
    """A case of the benchmark that begins sooner, lasts ``lasts_s`` and is watched until ``seconds``."""
    return replace(BY_NAME[name], begins_s=BEGINS_S, lasts_s=lasts_s, seconds=seconds)


def test_a_module_that_dies_and_comes_back(suit, calm):
    case = shorter("module dies, comes back after 10 s", 4.0, LONGEST_S)
    run = emulated(suit, case)
    assert is_finite(run)
    assert reported_after_s(run, VICTIM) < 0.2
    assert fault_effect(run, calm, VICTIM).recovery_s < 2.0
    assert fault_effect(run, calm, NEIGHBOURS).worst_deg < 1.5
    assert fault_effect(run, calm, OTHERS).worst_deg < 0.5


@pytest.mark.parametrize(
    ("name", "lasts_s"),
    [
        ("gyroscope saturated for 2 s", 2.0),
        ("gyroscope stuck for 5 s", 4.0),
    ],
)
def test_a_gyroscope_that_lies_is_told_and_harms_nobody_else(suit, calm, name, lasts_s):
    case = shorter(name, lasts_s, BEGINS_S + lasts_s + 4.0)
    run = emulated(suit, case)
    assert is_finite(run)
    assert reported_after_s(run, VICTIM) < 1.0
    near = fault_effect(run, calm, NEIGHBOURS)
    assert near.worst_deg < 1.5  # they show the module that comes back its heading, not the reverse
    assert near.recovery_s < 1.0
    assert fault_effect(run, calm, OTHERS).worst_deg < 0.5


def test_a_magnet_turns_nobody(suit, calm):
    case = shorter("magnet of 60 µT passes for 5 s", 3.0, 10.0)
    assert fault_effect(emulated(suit, case), calm, EVERYONE).worst_deg < 1.0


def test_a_local_device_that_falls_silent(suit, calm):
    case = shorter("local device silent for 5 s", 3.0, 12.0)
    run = emulated(suit, case)
    assert is_finite(run)
    assert np.isfinite(run.p_w[200:]).all()
    assert reported_after_s(run, EVERYONE) == pytest.approx(0.5, abs=0.2)
    assert largest_step_deg(run, case.ends_s, case.ends_s + 4.0) < 0.5
    assert fault_effect(run, calm, EVERYONE).worst_deg < 1.0
