"""Where the body is, by closed forms: what a frame does to a filter that is put into a known state."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gateway.reconstruction.inertial.root_position import (
    Contacts,
    PositionSettings,
    PositionState,
    advance_position,
    initial_position,
)

DT = 0.01
FLOOR = 0.25
POST_M = 0.8
SETTINGS = PositionSettings()
POST = Contacts(
    parents=np.array([-1]),
    offsets=np.zeros((1, 3)),
    segments=np.array([0]),
    points=np.array([[0.0, 0.0, -POST_M]]),
    reference=0,
    arm=np.zeros(3),
    gravity=np.array([0.0, 0.0, -9.81]),
    has_floor=True,
    floor=FLOOR,
)
"""One upright segment whose module sits on its upper end, and which stands on its lower one."""
UPRIGHT = np.array([[1.0, 0.0, 0.0, 0.0]])
NOTHING_FELT = np.full((1, 3), np.nan)


def advanced(state: PositionState, n: int, force: np.ndarray = NOTHING_FELT, resting_s: float = 0.0):
    """Root after n frames."""
    for _ in range(n):
        root, _ = advance_position(
            POST, SETTINGS, state, UPRIGHT, np.zeros((1, 3)), force, np.array([resting_s]), DT
        )
    return root


def test_a_body_that_rests_begins_on_the_floor():
    assert advanced(initial_position(1), 1, resting_s=1.0) == pytest.approx([0.0, 0.0, FLOOR + POST_M])


def test_after_the_longest_flight_the_body_halts_and_sinks_to_the_floor_with_one_time_constant():
    state = initial_position(1)
    advanced(state, 1, resting_s=1.0)
    state.anchor[:] = np.nan
    state.clock[1] = SETTINGS.longest_flight_s + 1.0
    state.x[:] = [[0.3, 0.0, 0.0], [0.0, 0.0, 0.0], [FLOOR + POST_M + 0.6, 0.0, 0.0]]
    root = advanced(state, round(SETTINGS.halt_s / DT))
    assert root == pytest.approx([0.3, 0.0, FLOOR + POST_M + 0.6 / math.e], abs=1e-9)


def test_after_the_longest_flight_velocity_fades_with_the_same_time_constant():
    state = initial_position(1)
    advanced(state, 1, resting_s=1.0)
    state.anchor[:] = np.nan
    state.clock[1] = SETTINGS.longest_flight_s + 1.0
    state.x[:, 1] = [2.0, -1.0, 0.0]
    advanced(state, round(SETTINGS.halt_s / DT))
    assert state.x[:2, 1] == pytest.approx([2.0 / math.e, -1.0 / math.e], abs=1e-9)


def test_in_flight_the_body_falls_as_everything_does():
    state = initial_position(1)
    advanced(state, 1, resting_s=1.0)
    state.anchor[:] = np.nan
    state.acceleration[:] = POST.gravity
    state.P[:] = 0.0
    state.x[:] = [[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [3.0, 2.0, 0.0]]
    root = advanced(state, 50, force=np.zeros((1, 3)))  # free fall feels nothing
    assert root == pytest.approx([0.5, 0.0, 3.0 + 2.0 * 0.5 - 0.5 * 9.81 * 0.5**2], abs=1e-9)
