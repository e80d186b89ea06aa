"""One instant of the chain filters: predict, average, open headings, rows, update, correct. Compiled."""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray, IntArray, Quantity, Status, StatusArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial import chain_rows
from gateway.reconstruction.inertial.chain_averages import (
    REST_WINDOW_S,
    SETTLED,
    average,
    felt_at,
    watch_rest,
)
from gateway.reconstruction.inertial.chain_prediction import predict, start, turn_segments, valid_rows
from gateway.reconstruction.inertial.chain_state import OPEN_SIGMA, ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.heading_start import (
    compass_turn,
    gather_heading,
    reopen_headings,
    shown_heading,
    tilt_spread,
    turn_evidence,
)
from gateway.reconstruction.inertial.lever_arms import learn_device_arm, learn_joint_arms
from gateway.reconstruction.inertial.local_rows import local_pair, note_frame
from gateway.reconstruction.inertial.observations import SegmentObservations
from gateway.reconstruction.inertial.rest_rows import rest_rows, rolling
from gateway.reconstruction.inertial.sun_rows import follow_sun
from gateway.reconstruction.inertial.tree_filter import (
    Evidence,
    add_edge,
    add_own,
    no_evidence,
    update_outward,
    update_tree,
)

AIR_VELOCITY = Quantity.AIR_VELOCITY.value
INTERPOLATED, UNAIDED = Status.INTERPOLATED.value, Status.UNAIDED.value
STARTING_S = 2.0
"""So long a device may take to say its first."""
AIDED_S = 0.5
"""A local device that has been silent for longer no longer holds up its chain."""


@compiled
def step(
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    fixed: IntArray,
    is_joint: bool,
    dt: float,
    time_s: float,
    observed: SegmentObservations,
    resting: FloatArray,
    sun: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """dt: since the frame before, s (> 0); time_s: of the frame since the first. resting: (n,) s for how
    long each segment has stood still, 0: not. sun: as ``follow_sun`` takes it. ``state`` changes in place.

    Returns the accelerations of all proximal joints (n, 3), world, NaN where not known; and (n,) whether the
    segment's module counted: 0 no, 1 its gyrometer, 2 all of it.
    """
    n = len(body.parents)
    force, rate, field = observed.specific_force, observed.angular_rate, observed.magnetic_field
    is_valid = valid_rows(noise, force, rate, observed.status)
    turning = rolling(state, rate, resting, dt)
    predict(body, state, noise, rate, is_valid, dt)
    for s in range(n):
        if state.is_started[s] != 1:
            if is_valid[s] == 2.0:
                start(body, state, noise, s, force[s], rate[s], field[s])
            if state.is_started[s] != 1:
                is_valid[s] = 0.0
    reopen_headings(body, state)
    K, motion = average(body, state, noise, force, rate, is_valid, dt)
    evidence = no_evidence(n)
    turns = np.zeros((n, 3))
    if body.uses_field:
        _follow_field(evidence, body, state, noise, is_valid, field, dt, turns)
    if len(sun) > 0:
        follow_sun(evidence, body, state, noise, is_valid, sun, dt, turns)
    anchored = _device_rows(
        evidence, body, state, noise, fixed, is_valid, force, rate, K, motion, dt, time_s, turns
    )
    rest_rows(evidence, body, state, noise, is_valid, force, resting, turning, dt, anchored)
    U = _joint_rows(evidence, body, state, noise, is_valid, K, motion, dt, anchored, turns)
    for s in range(n):
        if is_valid[s] > 0.0 and watch_rest(state, noise, s, force[s], rate[s], dt):
            chain_rows.rest_row(evidence, state, s, REST_WINDOW_S, dt)
    turn_segments(body, state, turns)
    if is_joint:
        errors = update_tree(body.parents, state.P, state.C, evidence)
    else:
        errors = update_outward(body.parents, state.P, evidence)
    state.bias[:] += errors[:, 3:]
    turn_segments(body, state, errors[:, :3].copy())
    acceleration = np.full((n, 3), np.nan)
    for s in range(n):
        if is_valid[s] == 2.0:
            acceleration[s] = U[s] + body.gravity
    return acceleration, is_valid


@compiled
def _follow_field(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    is_valid: FloatArray,
    field: FloatArray,
    dt: float,
    turns: FloatArray,
) -> None:
    """A row where the heading is settled; where it is open the field leads it as a compass."""
    for s in range(len(body.parents)):
        if is_valid[s] == 0.0 or not math.isfinite(field[s, 0] + field[s, 1] + field[s, 2]):
            continue
        chain_rows.watch_field(body, state, s, field[s], dt)
        if state.is_open[s] == 0:
            chain_rows.field_row(evidence, body, state, noise, s, field[s], dt)
            continue
        off, disturbance = chain_rows.field_error(body, state, s, field[s])
        turns[s, 2] = compass_turn(state, s, off, disturbance, dt)
    for s in range(len(body.parents)):
        turn_evidence(state, s, turns[s, 2])
        if body.parents[s] >= 0:
            turn_evidence(state, s, -turns[body.parents[s], 2])


@compiled
def _device_rows(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    fixed: IntArray,
    is_valid: FloatArray,
    force: FloatArray,
    rate: FloatArray,
    K: FloatArray,
    motion: FloatArray,
    dt: float,
    time_s: float,
    turns: FloatArray,
) -> FloatArray:
    """Rows of all local devices; (n,) 1 for segments that one of them holds up."""
    anchored = np.zeros(len(body.parents))
    for d in range(len(fixed)):
        s = body.device_segment[d]
        state.device_age_s[d] += dt
        if is_valid[s] < 2.0:
            continue
        if fixed[d]:
            if state.fresh_s[s] > SETTLED * noise.smoothing_s:
                _fixed_row(evidence, body, state, noise, d, s, K[s], motion[s], dt)
                anchored[s] = 1.0
            continue
        note_frame(body, state, noise, d, time_s, force[s] - state.force_bias[s], rate[s] - state.bias[s])
        is_new, u, y, variance, span = local_pair(body, state, noise, d, time_s)
        if is_new:
            interval = min(state.device_age_s[d], span)
            state.device_age_s[d] = 0.0
            # overlapping windows share their readings, and frames with their errors
            variance += noise.specific_force**2 + (noise.lever_arm * motion[s]) ** 2
            variance *= max(1.0, span / interval)
            if body.device_kind[d] == AIR_VELOCITY:
                # both sides turn with the segment: all that the row shows is where down is
                u, y = u - y - body.gravity, -body.gravity
            if body.parents[s] < 0 and state.is_open[s]:
                gather_heading(state, s, u, y, variance + tilt_spread(state, s, interval), interval)
                _open_root(evidence, body, state, noise, s, turns)
            chain_rows.known_row(
                evidence, state, noise, s, u, y, variance, state.is_open[s] == 1 or turns[s, 2] != 0.0
            )
        if state.device_age_s[d] < AIDED_S:
            anchored[s] = 1.0
    return anchored


@compiled
def mark_unaided(
    body: ChainBody, state: FilterState, fixed: IntArray, time_s: float, status: StatusArray
) -> None:
    """Tells in ``status`` (n,), in place, which chains have lost all their local devices."""
    n = len(body.parents)
    chain, held_up = np.arange(n), np.zeros(n)  # 1: by nothing any more, 2: by a device
    for s in range(n):
        if body.parents[s] >= 0:
            chain[s] = chain[body.parents[s]]
    for d in range(len(fixed)):
        c, age_s = chain[body.device_segment[d]], state.device_age_s[d]
        is_heard = age_s < AIDED_S or (age_s == np.inf and time_s < STARTING_S)
        held_up[c] = max(held_up[c], 2.0 if is_heard or fixed[d] else 1.0)
    for s in range(n):
        if held_up[chain[s]] == 1.0 and status[s] <= INTERPOLATED:
            status[s] = UNAIDED


@compiled
def _fixed_row(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    d: int,
    s: int,
    K: FloatArray,
    motion: float,
    dt: float,
) -> None:
    """A point of segment s that does not move."""
    if state.device_covariance[d, 0, 0] == 0.0:
        for i in range(3):
            state.device_covariance[d, i, i] = noise.lever_arm_offset**2
            state.device_covariance[d, 3 + i, 3 + i] = noise.force_bias**2
    u = felt_at(state.force[s], K, body.device_arm[d], state.device_shift[d])
    variance = chain_rows.row_variance(noise, motion, dt)
    at_once = variance * dt / noise.row_memory_s
    variance += learn_device_arm(state, noise, d, s, u, -body.gravity, K, variance, at_once, dt)
    chain_rows.known_row(evidence, state, noise, s, u, -body.gravity, variance, False)


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
        _turn_beyond(body, s, angle, turns)


@compiled
def _turn_beyond(body: ChainBody, s: int, angle: float, turns: FloatArray) -> None:
    """Segment s and all beyond it."""
    beyond = np.zeros(len(body.parents))
    beyond[s] = 1.0
    for c in range(s, len(body.parents)):
        if body.parents[c] >= 0 and beyond[body.parents[c]] > 0.0:
            beyond[c] = 1.0
        if beyond[c] > 0.0:
            turns[c, 2] += angle


@compiled
def _joint_rows(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    is_valid: FloatArray,
    K: FloatArray,
    motion: FloatArray,
    dt: float,
    anchored: FloatArray,
    turns: FloatArray,
) -> FloatArray:
    """Rows of all joints; chains that no device holds up get an unaided row.

    Returns the specific force at the proximal joints as their own segments see it, (n, 3), world.
    """
    n, settled_s = len(body.parents), SETTLED * noise.smoothing_s
    chain, U = np.arange(n), np.zeros((n, 3))
    for s in range(n):
        p = body.parents[s]
        U[s] = felt_at(state.force[s], K[s], body.to_joint[s], state.arm[s, :3])
        if p < 0 or is_valid[s] < 2.0 or is_valid[p] < 2.0:
            continue
        if state.fresh_s[s] < settled_s or state.fresh_s[p] < settled_s:
            continue
        chain[s] = chain[p]
        anchored[chain[p]] = max(anchored[chain[p]], anchored[s])
        _joint_row(evidence, body, state, noise, s, p, U[s], K, motion, dt, turns)
    _unaided_rows(evidence, body, state, noise, is_valid, chain, anchored, dt)
    return U


@compiled
def _unaided_rows(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    is_valid: FloatArray,
    chain: IntArray,
    anchored: FloatArray,
    dt: float,
) -> None:
    """All segments of a chain that nothing holds up share one: that averages their accelerometers' errors."""
    sharing = np.zeros(len(chain))
    for s in range(len(chain)):
        if is_valid[s] == 2.0:
            sharing[chain[s]] += 1.0
    for s in range(len(chain)):
        if anchored[chain[s]] == 0.0 and is_valid[s] == 2.0:
            chain_rows.unaided_row(evidence, state, noise, s, body.gravity, sharing[chain[s]], dt)


@compiled
def _joint_row(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    s: int,
    p: int,
    u: FloatArray,
    K: FloatArray,
    motion: FloatArray,
    dt: float,
    turns: FloatArray,
) -> None:
    """Of segment s and its parent p; u (3,), which corrected lever arms change."""
    u_p = felt_at(state.force[p], K[p], body.from_parent[s], state.arm[s, 3:])
    moved = math.hypot(motion[s], motion[p])
    variance = chain_rows.row_variance(noise, moved, dt)
    if body.is_bridged[s]:
        u = felt_at(state.force[s], K[s], body.to_joint[s] - body.beyond[s], state.arm[s, :3])
        variance += (body.slack[s] * moved) ** 2 * noise.row_memory_s / dt
    if state.is_open[s]:
        uncertain = variance + tilt_spread(state, s, dt) + tilt_spread(state, p, dt)
        gather_heading(state, s, u, u_p, uncertain, dt)
        shown, angle = shown_heading(state, noise, s)
        if shown > 0.0:
            state.is_open[s] = 0
            _settle(evidence, s, shown)
            _turn_beyond(body, s, angle, turns)
            return
    elif turns[s, 2] != 0.0 or turns[p, 2] != 0.0:
        return  # this instant's averages are those before the turn
    else:
        at_once = variance * dt / noise.row_memory_s
        variance += learn_joint_arms(state, noise, s, p, u, u_p, K[s], K[p], variance, at_once, dt)
    chain_rows.joint_row(evidence, state, noise, s, p, u, u_p, variance, dt)


@compiled
def _settle(evidence: Evidence, s: int, variance: float) -> None:
    """The heading against the parent is what it is now, to that variance."""
    row, row_p = np.zeros(3), np.zeros(3)
    row[2], row_p[2] = 1.0, -1.0
    add_edge(evidence, s, row, row_p, 0.0, variance)


@compiled
def orientation_sigma(state: FilterState) -> FloatArray:
    """(n,) rad: root of the expected square of the angle of error."""
    sigma = np.full(len(state.is_started), np.nan)
    for s in range(len(sigma)):
        if state.is_started[s]:
            P = state.P[s]
            sigma[s] = min(math.sqrt(P[0, 0] + P[1, 1] + P[2, 2]), 2.0 * OPEN_SIGMA)
    return sigma
