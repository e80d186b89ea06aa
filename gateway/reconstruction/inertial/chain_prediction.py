"""Prediction and correction of the chain filters: everything that turns with a segment. Compiled."""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import Clipped, FloatArray, Quantity
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, is_finite, norm
from gateway.reconstruction.inertial.chain_state import OPEN_SIGMA, ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.corrections import gyrometer_doubt
from gateway.reconstruction.inertial.observations import SegmentObservations
from gateway.reconstruction.inertial.tree_filter import propagate, propagate_own

FORCE_CLIPPED, RATE_CLIPPED = Clipped.SPECIFIC_FORCE.value, Clipped.ANGULAR_RATE.value
AIR_VELOCITY = Quantity.AIR_VELOCITY.value
LONGEST_COAST_S = 0.1
"""A silent segment keeps its rate for about that long."""
LONGEST_SILENCE_S = 1.0
"""After a longer silence, or saturation, a segment begins anew."""
START_ARM = 0.3
"""m: of a module from what it turns about when it begins."""
SATURATED_NOISE = 5.0
"""rad/s/√Hz of a gyrometer at its limit."""


@compiled
def predict(
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    rate: FloatArray,
    is_valid: FloatArray,
    is_joint: bool,
    dt: float,
    before: FloatArray,
) -> None:
    """Turns every started segment over dt by the mean of its last two rates (n, 3), in place.

    is_joint: whether segments and their parents share covariance. before: (n, 3, 3) to be used on the way.
    """
    turn, w = np.empty((3, 3)), np.empty(3)
    for s in range(len(body.parents)):
        if state.is_started[s] == 0:
            continue
        rotation_matrix.copy_into(before[s], state.R[s])
        if is_valid[s] > 0.0:
            _mean_rate(w, state, s, rate[s], dt)
            speed = norm(w)
            density = noise.gyrometer**2 + (noise.gyrometer_scale * speed) ** 2 * noise.scale_memory_s
            if is_valid[s] < 1.0:
                density += SATURATED_NOISE**2
                state.silent_s[s] += dt
            else:
                state.silent_s[s] = 0.0
            change = 0.0
            for i in range(3):
                step = rate[s, i] - state.rate[s, i]
                change += step**2
                state.slope[s, i], state.rate[s, i] = step / dt, rate[s, i]
            density += gyrometer_doubt(state, s, change, dt)
        else:
            for i in range(3):
                w[i] = (state.rate[s, i] - state.bias[s, i]) * math.exp(-dt / LONGEST_COAST_S)
                state.rate[s, i] = state.bias[s, i] + w[i]
            state.silent_s[s] += dt
            density = (noise.dead_rate**2 + dot(w, w)) * LONGEST_COAST_S
            state.slope[s] = np.nan
        if state.silent_s[s] > LONGEST_SILENCE_S:
            state.is_started[s] = 2
        rotation_matrix.exponential_into(turn, w[0] * dt, w[1] * dt, w[2] * dt)
        rotation_matrix.turn_rows(state.R[s], turn)
        propagate_own(state.P[s], before[s], dt)
        for i in range(3):
            # an orientation cannot be worse than unknown: keeps a long silence finite
            state.P[s, i, i] += density * dt if state.P[s, i, i] < OPEN_SIGMA**2 else 0.0
            state.P[s, 3 + i, 3 + i] += noise.bias_walk**2 * dt
        if is_joint and body.parents[s] >= 0:
            propagate(state.C[s], before[s], before[body.parents[s]], dt)


@compiled
def _mean_rate(w: FloatArray, state: FilterState, s: int, rate: FloatArray, dt: float) -> None:
    """w ← what turns segment s over dt, rad/s: from its last three rates, error O(dt³) of the angle.

    The trapezoid, less its error by Euler and Maclaurin's formula, and the coning of an axis that moves
    (Bortz 1971). At 100 Hz the trapezoid alone is off by up to a degree in fast motion.
    """
    bias, last, slope = state.bias[s], state.rate[s], state.slope[s]
    a = last[0] - bias[0], last[1] - bias[1], last[2] - bias[2]
    b = rate[0] - bias[0], rate[1] - bias[1], rate[2] - bias[2]
    w[0] = 0.5 * (a[0] + b[0]) + (a[1] * b[2] - a[2] * b[1]) * dt / 12.0
    w[1] = 0.5 * (a[1] + b[1]) + (a[2] * b[0] - a[0] * b[2]) * dt / 12.0
    w[2] = 0.5 * (a[2] + b[2]) + (a[0] * b[1] - a[1] * b[0]) * dt / 12.0
    for i in range(3):
        if math.isfinite(slope[i]):
            w[i] -= (rate[i] - last[i] - slope[i] * dt) / 12.0


@compiled
def exceeds(v: FloatArray, limit: float) -> bool:
    """Whether a component of v (3,) is that large."""
    return bool(abs(v[0]) >= limit or abs(v[1]) >= limit or abs(v[2]) >= limit)


@compiled
def note_valid_rows(is_valid: FloatArray, noise: Noise, observed: SegmentObservations) -> None:
    """is_valid (n,) ← 0: no sample; 0.5: turns by a gyrometer at the end of its range; 1: turns by its
    gyrometer; 2: its specific force counts too.

    A sensor is at the end of its range where its module says so, and at the largest range there is.
    """
    force, rate, status, clipped = (
        observed.specific_force, observed.angular_rate, observed.status, observed.clipped
    )  # fmt: skip
    for s in range(len(status)):
        is_valid[s] = 0.0
        if status[s] <= 1 and is_finite(rate[s]):
            is_valid[s] = 1.0
            is_usable = is_finite(force[s]) and clipped[s] & FORCE_CLIPPED == 0
            if exceeds(rate[s], noise.largest_rate) or clipped[s] & RATE_CLIPPED > 0:
                is_valid[s] = 0.5
            elif is_usable and not exceeds(force[s], noise.largest_force):
                is_valid[s] = 2.0


@compiled
def start(
    body: ChainBody, state: FilterState, noise: Noise, s: int, f: FloatArray, w: FloatArray, m: FloatArray
) -> None:
    """Segment s from its first sample: level by the specific force, facing as the field says, if any."""
    secondary, secondary_w = m, body.field
    if not (body.uses_field and is_finite(m)):
        secondary, secondary_w = np.zeros(3), np.zeros(3)
        secondary[int(abs(f[0]) > abs(f[1]))] = 1.0
        secondary_w[1] = 1.0
    R = rotation_matrix.from_two_vectors(f, secondary, body.at_rest, secondary_w)
    if not is_finite(R[0]):
        return
    rotation_matrix.copy_into(state.R[s], R)
    for i in range(3):
        state.bias[s, i], state.rate[s, i], state.slope[s, i] = 0.0, w[i], np.nan
    state.P[s], state.C[s] = 0.0, 0.0
    moved = start_acceleration(body.gravity, f, w)
    tilt = noise.start_tilt**2 + moved / dot(body.gravity, body.gravity)
    state.starting_square[s] = noise.starting_share * moved
    for i in range(3):
        state.P[s, i, i] = min(tilt, OPEN_SIGMA**2)
        state.P[s, 3 + i, 3 + i] = noise.bias**2
    state.P[s, 2, 2] = OPEN_SIGMA**2
    # a module that comes back may sit elsewhere
    state.arm_covariance[s] = 0.0
    for i in range(6):
        state.arm_covariance[s, i, i] = noise.lever_arm_offset**2
    state.learnt_s[s], state.corrections[s] = np.inf, 0.0
    state.field_offset[s, 0], state.field_offset[s, 1] = 0.0, noise.heading**2
    state.is_started[s], state.is_open[s] = 1, body.opens[s]
    state.fresh_s[s], state.silent_s[s], state.compass_s[s] = 0.0, 0.0, 0.0
    state.heading[s], state.rest[s], state.misfit[s] = 0.0, 0.0, 0.0
    for i in range(3):  # means of one sample: begun at zero, gravity alone would be a change for seconds
        state.rest[s, i], state.rest[s, 3 + i] = w[i], f[i]


@compiled
def start_acceleration(gravity: FloatArray, f: FloatArray, w: FloatArray) -> float:
    """(m/s²)², square of what a module may accelerate by, as its first sample shows: as much as it feels more
    or less than gravity, and as it turns at the end of ``START_ARM``."""
    turning = dot(w, w) * START_ARM
    square: float = (norm(f) - norm(gravity)) ** 2 + turning * turning
    return square


@compiled
def turn_segments(body: ChainBody, state: FilterState, turns: FloatArray, E: FloatArray) -> None:
    """Rotations of segments, and of all remembered that turns with them, in place.

    turns: (n, 3 or more) rotation vectors, world; E: (n, 3, 3) to be used on the way.
    """
    for s in range(len(body.parents)):
        if _is_turn(turns[s]):
            rotation_matrix.exponential_into(E[s], turns[s, 0], turns[s, 1], turns[s, 2])
            rotation_matrix.turn_columns(E[s], state.R[s])
            rotation_matrix.turn_columns(E[s], state.swing[s])
            rotation_matrix.turn(E[s], state.force[s])
            rotation_matrix.turn(E[s], state.last_force[s])
            rotation_matrix.turn(E[s], state.long_force[s])
    for d in range(len(body.device_segment)):
        s = body.device_segment[d]
        if _is_turn(turns[s]):
            if body.device_kind[d] == AIR_VELOCITY:
                for j in range(state.n_readings[d, 0]):
                    rotation_matrix.turn(E[s], state.readings[d, j, 1:4])
            rotation_matrix.turn_columns(E[s], state.device_turn[d])


@compiled
def _is_turn(v: FloatArray) -> bool:
    return bool(v[0] != 0.0 or v[1] != 0.0 or v[2] != 0.0)
