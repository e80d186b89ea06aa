"""Where the body is, by closed forms: what a frame does to a filter that is put into a known state."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gateway.geometry.records import records
from gateway.reconstruction.inertial.contacts import (
    HALT_S,
    LONGEST_FLIGHT_S,
    ContactPlace,
    PositionState,
    Walk,
    Walker,
    advance_position,
    initial_position,
)

DT = 0.01
FLOOR = 0.25
POST_M = 0.8
GRAVITY = (0.0, 0.0, -9.81)
PLACES, WALKS = records(ContactPlace, 1), records(Walk, 1)
PLACES["point"], WALKS["gravity"] = (0.0, 0.0, -POST_M), GRAVITY
WALKS["has_floor"], WALKS["floor"] = 1, FLOOR
"""One upright segment whose module sits on its upper end, and which stands on its lower one."""
UPRIGHT = np.array([[1.0, 0.0, 0.0, 0.0]])
NOTHING_FELT = np.full((1, 3), np.nan)


def advanced(
    state: PositionState, n: int, force=NOTHING_FELT, resting_s=0.0, rate=(0.0, 0.0, 0.0), places=PLACES
):
    """Root after n frames."""
    for _ in range(n):
        parents, offsets = np.array([-1]), np.zeros((1, 3))
        walker = Walker(parents, offsets, places, WALKS[0], state.body[0], state.contacts)
        root, _ = advance_position(walker, UPRIGHT, np.array([rate]), force, np.array([resting_s]), DT)
    return root


def test_a_body_that_rests_begins_on_the_floor():
    assert advanced(initial_position(1), 1, resting_s=1.0) == pytest.approx([0.0, 0.0, FLOOR + POST_M])


@pytest.mark.parametrize("rate", [0.0, 0.4], ids=["held", "seen to slip"])
def test_what_rests_comes_down_to_a_level_floor_whether_or_not_the_legs_see_it_move(rate):
    """Legs whose lengths are wrong see every foot move that stands: the body climbed a stair at each step."""
    state = initial_position(1)
    advanced(state, 20, resting_s=1.0)
    state.body["x"][0, 2, 0] += 0.2
    state.contacts["anchor"][0, 2] += 0.2
    root = advanced(state, 150, UPRIGHT[:, 1:] - GRAVITY, resting_s=1.0, rate=(0.0, rate, 0.0))
    assert root[2] == pytest.approx(FLOOR + POST_M, abs=0.02)


def test_of_two_contacts_at_rest_the_lower_is_on_the_floor():
    """A foot on its ball: the heel above it is not drawn down."""
    places = records(ContactPlace, 2)
    places["point"] = [[0.0, 0.0, -POST_M], [0.2, 0.0, 0.1 - POST_M]]
    root = advanced(initial_position(2), 200, UPRIGHT[:, 1:] - GRAVITY, resting_s=1.0, places=places)
    assert root[2] == pytest.approx(FLOOR + POST_M, abs=1e-6)


def test_after_the_longest_flight_the_body_halts_and_sinks_to_the_floor_with_one_time_constant():
    state = initial_position(1)
    advanced(state, 1, resting_s=1.0)
    state.contacts["anchor"] = np.nan
    body = state.body[0]
    body.aloft_s = LONGEST_FLIGHT_S + 1.0
    body.x[:] = [[0.3, 0.0, 0.0], [0.0, 0.0, 0.0], [FLOOR + POST_M + 0.6, 0.0, 0.0]]
    root = advanced(state, round(HALT_S / DT))
    assert root == pytest.approx([0.3, 0.0, FLOOR + POST_M + 0.6 / math.e], abs=1e-9)


def test_after_the_longest_flight_velocity_fades_with_the_same_time_constant():
    state = initial_position(1)
    advanced(state, 1, resting_s=1.0)
    state.contacts["anchor"] = np.nan
    body = state.body[0]
    body.aloft_s = LONGEST_FLIGHT_S + 1.0
    body.x[:, 1] = [2.0, -1.0, 0.0]
    advanced(state, round(HALT_S / DT))
    assert body.x[:2, 1] == pytest.approx([2.0 / math.e, -1.0 / math.e], abs=1e-9)


def test_in_flight_the_body_falls_as_everything_does():
    state = initial_position(1)
    advanced(state, 1, resting_s=1.0)
    state.contacts["anchor"] = np.nan
    body = state.body[0]
    body.acceleration[:] = GRAVITY
    body.P[:] = 0.0
    body.x[:] = [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [3.0, 2.0, 0.0]]
    root = advanced(state, 50, force=np.zeros((1, 3)))  # free fall feels nothing
    assert root == pytest.approx([0.5, 0.0, 3.0 + 2.0 * 0.5 - 0.5 * 9.81 * 0.5**2], abs=1e-9)
