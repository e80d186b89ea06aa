"""Rows of local devices: the acceleration of a point of the body is known. Compiled."""

from __future__ import annotations

import numpy as np

from gateway.frames import FloatArray, IntArray, Quantity
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial import chain_rows
from gateway.reconstruction.inertial.chain_averages import SETTLED, felt_into
from gateway.reconstruction.inertial.chain_scratch import Scratch
from gateway.reconstruction.inertial.chain_state import ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.heading_start import (
    gather_heading,
    shown_heading,
    tilt_spread,
    turn_beyond,
)
from gateway.reconstruction.inertial.lever_arms import learn_device, learn_fixed_point
from gateway.reconstruction.inertial.local_rows import find_local_pair, note_frame
from gateway.reconstruction.inertial.tree_filter import Evidence, add_own

AIR_VELOCITY = Quantity.AIR_VELOCITY.value
AIDED_S = 0.5
"""A local device that has been silent for longer no longer holds up its chain."""


@compiled
def device_rows(
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    scratch: Scratch,
    fixed: IntArray,
    dt: float,
    time_s: float,
) -> None:
    """Rows of all local devices; marks the segments that one of them holds up. time_s: since the first."""
    for d in range(len(fixed)):
        s = body.device_segment[d]
        state.device_age_s[d] += dt
        if scratch.is_valid[s] < 2.0:
            continue
        if state.device_covariance[d, 0, 0] == 0.0:
            for i in range(3):
                state.device_covariance[d, i, i] = noise.lever_arm_offset**2
                state.device_covariance[d, 3 + i, 3 + i] = noise.force_bias**2
        if fixed[d]:
            scratch.anchored[s] = 1.0  # also while its row waits for the averages
            if state.fresh_s[s] > SETTLED * noise.smoothing_s:
                _fixed_row(body, state, noise, scratch, d, s, dt)
            continue
        note_frame(body, state, noise, scratch.observed, d, time_s)
        _moving_row(body, state, noise, scratch, d, s, time_s)
        if is_heard(state, d) and is_telling(state, noise, d):
            scratch.anchored[s] = 1.0


@compiled
def is_heard(state: FilterState, d: int) -> bool:
    """Whether device d has told something of late, as its readings follow each other."""
    n, longest_s = state.n_readings[d, 0], AIDED_S
    if n > 1:
        longest_s = max(longest_s, 1.5 * (state.readings[d, n - 1, 0] - state.readings[d, n - 2, 0]))
    return bool(state.device_age_s[d] < longest_s)


@compiled
def is_telling(state: FilterState, noise: Noise, d: int) -> bool:
    """Whether device d tells more of the mean acceleration than that it is small."""
    return bool(state.device_fit[d, 1] < noise.unaided_speed**2 / noise.unaided_window_s)


@compiled
def _fixed_row(
    body: ChainBody, state: FilterState, noise: Noise, scratch: Scratch, d: int, s: int, dt: float
) -> None:
    """A point of segment s that does not move."""
    K, u = scratch.K[s], np.empty(3)
    felt_into(u, state.force[s], K, body.device_arm[d], state.device_shift[d], 0)
    variance = chain_rows.row_variance(noise, scratch.motion[s], dt)
    at_once = variance * dt / noise.row_memory_s
    added = learn_fixed_point(state, noise, scratch.learning, d, s, u, body.at_rest, K, variance, at_once, dt)
    variance += added * noise.row_memory_s / dt
    chain_rows.known_row(scratch.evidence, state, noise, s, u, body.at_rest, variance, False)


@compiled
def _moving_row(
    body: ChainBody, state: FilterState, noise: Noise, scratch: Scratch, d: int, s: int, time_s: float
) -> None:
    """A point of segment s whose acceleration is told."""
    pair, turns = scratch.pair, scratch.turns
    is_new, of_fit, span = find_local_pair(pair, body, state, noise, d, time_s)
    if not is_new:
        return
    interval = min(state.device_age_s[d], span)
    state.device_age_s[d], state.device_fit[d, 1] = 0.0, of_fit * span
    u, y, arm, shift = pair.u, pair.y, body.device_arm[d], state.device_shift[d]
    for i in range(3):
        for j in range(3):
            u[i] += pair.arm[i, j] * (arm[j] + shift[j])
    # overlapping windows share their readings, and frames with their errors
    sharing = max(1.0, span / interval)
    at_once = of_fit + noise.specific_force**2 + (noise.lever_arm * scratch.motion[s]) ** 2
    at_once += state.vibration[s, 0]
    variance = at_once * sharing
    turns_too = body.device_kind[d] == AIR_VELOCITY
    is_open = state.is_open[s] == 1 or turns[s, 2] != 0.0
    if turns_too:
        # both sides turn with the segment: all that the row shows is where down is
        for i in range(3):
            u[i] += -y[i] - body.gravity[i]
            y[i] = body.at_rest[i]
    if body.parents[s] < 0 and state.is_open[s]:
        gather_heading(state, s, u, y, variance + tilt_spread(state, s, interval), interval)
        _open_root(scratch.evidence, body, state, noise, s, turns)
        is_open = is_open or turns[s, 2] != 0.0
    elif not is_open and not turns_too:
        variance += sharing * learn_device(
            state, noise, scratch.learning, d, s, pair, variance, at_once, interval
        )
    chain_rows.known_row(scratch.evidence, state, noise, s, u, y, variance, is_open)


@compiled
def _open_root(
    evidence: Evidence, body: ChainBody, state: FilterState, noise: Noise, s: int, turns: FloatArray
) -> None:
    """Once shown, the heading against the world: turns the whole tree."""
    variance, angle = shown_heading(state, noise, s)
    if variance > 0.0:
        state.is_open[s] = 0
        row = np.zeros(3)
        row[2] = 1.0
        add_own(evidence, s, row, 0.0, variance)
        turn_beyond(body, state, s, angle, turns)
