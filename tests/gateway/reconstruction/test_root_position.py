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


def advanced(state: PositionState, n: int, force: np.ndarray = NOTHING_FELT, resting_s: float = 0.0):
    """Root after n frames."""
    for _ in range(n):
        parents, offsets = np.array([-1]), np.zeros((1, 3))
        walker = Walker(parents, offsets, PLACES, WALKS[0], state.body[0], state.contacts)
        root, _ = advance_position(walker, UPRIGHT, np.zeros((1, 3)), force, np.array([resting_s]), DT)
    return root


def test_a_body_that_rests_begins_on_the_floor():
    assert advanced(initial_position(1), 1, resting_s=1.0) == pytest.approx([0.0, 0.0, FLOOR + POST_M])


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
