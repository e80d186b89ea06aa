"""How a body heads in the world where nothing shows it: known by definition, and told as unknown."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.emulation.fast_arm import Switches, fast_arm, fast_motion, sampled
from gateway.reconstruction.inertial.tree.headings import define_headings, open_headings
from gateway.reconstruction.inertial.tree.reconstructor import ChainSettings, JointReconstructor
from gateway.reconstruction.inertial.tree.start import take_back_heading
from gateway.reconstruction.inertial.tree.state import (
    Heading,
    Started,
    chain_body,
    initial_state,
    work_space,
)
from gateway.reconstruction.inertial.tree.tuning import tuning
from gateway.reconstruction.inertial.tree.update import add_edge, update_tree
from gateway.reconstruction.reconstructor import update_many

SUIT, TUNING = fast_arm(), tuning()
N, SILENT = 5, 3
HEADING, OWN, UNSEEN = (0.0, 0.0, 1.0), 0.05**2, 1.0
"""Rad²: each heading against the body, and that of a module that was silent."""


def body_and_state():
    """A chain whose segments know how they head against each other, and not in the world."""
    body, state = chain_body(SUIT, uses_field=False), initial_state(N, len(SUIT.local_devices))
    body.segments["heading_observable"][0] = 0
    common = TUNING.unknown_heading**2 / N
    state.segments["started"], state.segments["heading"] = Started.YES, Heading.OBSERVED
    state.segments["P"] = np.diag([1e-4, 1e-4, common + OWN, 1e-5, 1e-5, 1e-5])
    state.segments["C"][1:, 2, 2] = common
    return body, state


def turned_by_a_joint(body, state, angle=1.0):
    """By what each segment turns, rad, after a module was silent and the joint beyond it shows ``angle``."""
    work = work_space(N)
    state.segments["P"][SILENT, 2, 2] += UNSEEN
    add_edge(work.segments[SILENT + 1].evidence, HEADING, (0.0, 0.0, -1.0), angle, 1e-4)
    update_tree(body.segments, state.segments, work)
    return work.segments["x"][:, 2]


def test_a_module_that_was_silent_turns_and_the_body_stays():
    body, state = body_and_state()
    define_headings(body, state, TUNING)
    turned = turned_by_a_joint(body, state)
    assert np.abs(np.delete(turned, SILENT)).max() < np.radians(0.5)
    assert turned[SILENT] == pytest.approx(-1.0, abs=0.02)


def test_without_the_definition_the_body_would_turn_with_it():
    assert np.degrees(abs(turned_by_a_joint(*body_and_state())[0])) > 5.0


def test_what_neighbours_know_of_each_other_stays():
    body, state = body_and_state()

    def between():
        one = state.segments
        C = one["C"][1:]
        return one["P"][1:] + one["P"][:-1] - C - C.transpose(0, 2, 1)

    before = between()
    define_headings(body, state, TUNING)
    np.testing.assert_allclose(between(), before, atol=1e-12)
    assert state.segments["P"][:, 2, 2].max() < 3.0 * OWN


@pytest.mark.parametrize(("silent", "unknown"), [(0, [0]), (2, [2, 3, 4])])
def test_a_heading_that_is_contradicted_becomes_unknown_on_the_side_that_gives_way(silent, unknown):
    """Of the root alone that was found wrongly, and of all beyond a joint where the root is known better."""
    body, state = body_and_state()
    define_headings(body, state, TUNING)
    state.segments["P"][unknown, 2, 2] += UNSEEN
    state.segments["C"][unknown[1:], 2, 2] += UNSEEN
    before = state.segments["P"][:, 2, 2].copy()
    take_back_heading(body, state, TUNING, work_space(N), max(silent, 1))
    more = state.segments["P"][:, 2, 2] - before
    assert np.flatnonzero(more).tolist() == unknown
    np.testing.assert_allclose(more[unknown], TUNING.unknown_heading**2)


@pytest.mark.parametrize("change", ["unobserved", "sun", "device"])
def test_a_heading_that_is_not_found_or_that_something_shows_is_not_defined(change):
    body, state = body_and_state()
    if change == "unobserved":
        state.segments["heading"][2] = Heading.UNOBSERVED
    elif change == "sun":
        state.segments["sun"]["has_shown"][2] = 1
    else:
        body.segments["heading_observable"][0] = 1
    before = state.segments["P"].copy()
    define_headings(body, state, TUNING)
    np.testing.assert_array_equal(state.segments["P"], before)


def test_the_first_sun_finds_the_heading_of_the_body_unknown():
    body, state = body_and_state()
    define_headings(body, state, TUNING)
    work = work_space(N)
    work.segments["sun"][1] = [1.0, 0.0, 0.0]
    for _ in range(2):
        open_headings(body, state, TUNING, work)
        state.segments["sun"]["has_shown"][1] = 1
    P, C = state.segments["P"][:, 2, 2], state.segments["C"][1:, 2, 2]
    np.testing.assert_allclose(P, TUNING.unknown_heading**2, atol=0.1)
    assert (P[1:] + P[:-1] - 2.0 * C).max() < 3.0 * OWN


def test_what_is_told_of_a_body_without_field_and_device_is_that_its_heading_is_unknown():
    suit = replace(fast_arm(), local_devices=())
    finder = JointReconstructor(suit, 0.01, ChainSettings(uses_field=False))
    update_many(finder, sampled(suit, fast_motion(suit, 3), Switches(), 3)[:1500])
    for segment in finder.certainty().values():
        assert segment["sigma_heading"] >= TUNING.unknown_heading
