"""One instant of the chain filters: predict, average, open headings, rows, update, correct. Compiled."""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray, IntArray, Status, StatusArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial import chain_rows
from gateway.reconstruction.inertial.chain_averages import (
    REST_WINDOW_S,
    SETTLED,
    average,
    felt_into,
    watch_rest,
)
from gateway.reconstruction.inertial.chain_prediction import (
    note_valid_rows,
    predict,
    start,
    turn_segments,
)
from gateway.reconstruction.inertial.chain_scratch import Scratch
from gateway.reconstruction.inertial.chain_state import OPEN_SIGMA, ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.corrections import note_correction, row_doubt
from gateway.reconstruction.inertial.device_rows import device_rows, is_heard
from gateway.reconstruction.inertial.heading_start import (
    bending,
    compass_turn,
    gather_heading,
    is_apart,
    reopen_headings,
    shown_heading,
    tilt_spread,
    turn_beyond,
    turn_evidence,
)
from gateway.reconstruction.inertial.lever_arms import learn_joint_arms
from gateway.reconstruction.inertial.rest_rows import note_rolling, rest_rows
from gateway.reconstruction.inertial.sun_rows import follow_sun
from gateway.reconstruction.inertial.tree_filter import (
    Evidence,
    add_edge,
    clear,
    update_outward,
    update_tree,
)

INTERPOLATED, UNAIDED = Status.INTERPOLATED.value, Status.UNAIDED.value
LEAST_SQUARE = 1e-9
"""(m/s²)²: nothing, but no number so small that processors are slow with it."""
STARTING_S = 2.0
"""So long a device may take to say its first."""


@compiled
def step(
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    scratch: Scratch,
    fixed: IntArray,
    is_joint: bool,
    sees_sun: bool,
    dt: float,
    time_s: float,
    resting: FloatArray,
    acceleration: FloatArray,
) -> None:
    """dt: since the frame before, s (> 0); time_s: of the frame since the first. resting: (n,) s for how
    long each segment has stood still, 0: not. What was observed is in ``scratch``; ``state`` changes.

    acceleration: (n, 3) is given those of all proximal joints, world; it is left as it was where none is
    known. ``scratch.is_valid`` tells whether a segment's module counted.
    """
    observed, is_valid, K, motion = scratch.observed, scratch.is_valid, scratch.K, scratch.motion
    evidence, turns = scratch.evidence, scratch.turns
    force, rate, field = observed.specific_force, observed.angular_rate, observed.magnetic_field
    note_valid_rows(is_valid, noise, observed)
    note_rolling(scratch.rolling, state, rate, resting, dt)
    predict(body, state, noise, rate, is_valid, is_joint, dt, scratch.before)
    _start_segments(body, state, noise, scratch)
    reopen_headings(body, state)
    average(body, state, noise, force, rate, is_valid, dt, K, motion)
    _forget(scratch)
    if body.uses_field:
        _follow_field(evidence, body, state, noise, is_valid, field, dt, turns)
    if sees_sun:
        follow_sun(evidence, body, state, noise, is_valid, scratch.sun, dt, turns)
    device_rows(body, state, noise, scratch, fixed, dt, time_s)
    rest_rows(evidence, body, state, noise, is_valid, force, resting, scratch.rolling, dt, scratch.anchored)
    _joint_rows(body, state, noise, scratch, is_joint, dt)
    rest_gain = 1.0 - math.exp(-dt / REST_WINDOW_S)
    for s in range(len(is_valid)):
        if is_valid[s] > 0.0 and watch_rest(state, noise, s, force[s], rate[s], rest_gain, dt):
            chain_rows.rest_row(evidence, state, s, REST_WINDOW_S, dt)
    turn_segments(body, state, turns, scratch.rotations)
    if is_joint:
        update_tree(body.parents, state.P, state.C, evidence, scratch.tree)
    else:
        update_outward(body.parents, state.P, evidence, scratch.tree)
    turn_segments(body, state, scratch.tree.x, scratch.rotations)
    for s in range(len(is_valid)):
        if is_valid[s] == 2.0 and scratch.anchored[scratch.chain[s]] > 0.0 and state.is_open[s] == 0:
            note_correction(state, s, scratch.tree.x[s, 0], scratch.tree.x[s, 1], dt)
        for i in range(3):
            state.bias[s, i] += scratch.tree.x[s, 3 + i]
            if is_valid[s] == 2.0:
                acceleration[s, i] = scratch.U[s, i] + body.gravity[i]


@compiled
def _start_segments(body: ChainBody, state: FilterState, noise: Noise, scratch: Scratch) -> None:
    """Where a first sample has come; until then what a module says does not count."""
    observed, is_valid = scratch.observed, scratch.is_valid
    for s in range(len(is_valid)):
        if state.is_started[s] != 1:
            if is_valid[s] == 2.0:
                start(
                    body, state, noise, s, observed.specific_force[s], observed.angular_rate[s],
                    observed.magnetic_field[s],
                )  # fmt: skip
            if state.is_started[s] != 1:
                is_valid[s] = 0.0


@compiled
def _forget(scratch: Scratch) -> None:
    """What the instant before has left."""
    clear(scratch.evidence)
    for s in range(len(scratch.anchored)):
        scratch.anchored[s] = 0.0
        for i in range(3):
            scratch.turns[s, i] = 0.0


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
    expected = chain_rows.expected_field(body, noise, dt)
    for s in range(len(body.parents)):
        if is_valid[s] < 1.0:
            continue  # a saturated gyrometer has lost it: the field would seem disturbed
        if not math.isfinite(field[s, 0] + field[s, 1] + field[s, 2]):
            continue
        off, disturbance = chain_rows.watch_field(body, state, s, field[s], expected, dt)
        if state.is_open[s] == 0:
            chain_rows.field_row(evidence, body, state, noise, s, off, disturbance, expected, dt)
            continue
        turns[s, 2] = compass_turn(state, s, off, disturbance, dt)
    for s in range(len(body.parents)):
        turn_evidence(state, s, turns[s, 2])
        if body.parents[s] >= 0:
            turn_evidence(state, s, -turns[body.parents[s], 2])


@compiled
def mark_unaided(
    body: ChainBody, state: FilterState, scratch: Scratch, fixed: IntArray, time_s: float, status: StatusArray
) -> None:
    """Tells in ``status`` (n,), in place, which chains have lost all their local devices."""
    n, chain, held_up = len(body.parents), scratch.chain, scratch.sharing
    for s in range(n):
        chain[s], held_up[s] = s, 0.0  # 1: by nothing any more, 2: by a device
        if body.parents[s] >= 0:
            chain[s] = chain[body.parents[s]]
    for d in range(len(fixed)):
        c, age_s = chain[body.device_segment[d]], state.device_age_s[d]
        is_aiding = fixed[d] or is_heard(state, d) or (age_s == np.inf and time_s < STARTING_S)
        held_up[c] = max(held_up[c], 2.0 if is_aiding else 1.0)
    for s in range(n):
        if held_up[chain[s]] == 1.0 and status[s] <= INTERPOLATED:
            status[s] = UNAIDED


@compiled
def _joint_rows(
    body: ChainBody, state: FilterState, noise: Noise, scratch: Scratch, is_joint: bool, dt: float
) -> None:
    """Rows of all joints, and ``scratch.U``; chains that nothing holds up get an unaided row.

    In the joint filter a foot or a device anywhere holds up its chain; outward only one on its root does.
    """
    settled_s = SETTLED * noise.smoothing_s
    is_valid, chain, anchored = scratch.is_valid, scratch.chain, scratch.anchored
    for s in range(len(body.parents)):
        p, chain[s] = body.parents[s], s
        felt_into(scratch.U[s], state.force[s], scratch.K[s], body.to_joint[s], state.arm[s], 0)
        if p < 0 or is_valid[s] < 2.0 or is_valid[p] < 2.0:
            continue
        if state.misfit[s] < chain_rows.LOOSE:  # else what holds up the one does not hold up the other
            chain[s] = chain[p]  # also while its row waits for the averages: after a gap nothing has changed
        if is_joint:
            anchored[chain[s]] = max(anchored[chain[s]], anchored[s])
        if state.fresh_s[s] < settled_s or state.fresh_s[p] < settled_s:
            continue
        _joint_row(body, state, noise, scratch, s, p, dt)
    _unaided_rows(body, state, noise, scratch, dt)


@compiled
def _unaided_rows(body: ChainBody, state: FilterState, noise: Noise, scratch: Scratch, dt: float) -> None:
    """All segments of a chain that nothing holds up share one: that averages their accelerometers' errors.

    Where one is held up, its segments have a weak one of their own until their inclinations are settled.
    """
    is_valid, chain, sharing = scratch.is_valid, scratch.chain, scratch.sharing
    decay = math.exp(-dt / noise.starting_memory_s)
    for s in range(len(chain)):
        sharing[s] = 0.0
        state.starting_square[s] = max(state.starting_square[s] * decay, LEAST_SQUARE)
    for s in range(len(chain)):
        if is_valid[s] == 2.0:
            sharing[chain[s]] += 1.0
    for s in range(len(chain)):
        if is_valid[s] < 2.0:
            continue
        if scratch.anchored[chain[s]] > 0.0:
            chain_rows.note_aided(state, noise, s, body.at_rest, dt)
            chain_rows.starting_row(scratch.evidence, state, noise, s, body.at_rest, dt)
        else:
            chain_rows.unaided_row(scratch.evidence, state, noise, s, body.at_rest, sharing[chain[s]], dt)


@compiled
def _joint_row(
    body: ChainBody, state: FilterState, noise: Noise, scratch: Scratch, s: int, p: int, dt: float
) -> None:
    """Of segment s and its parent p; changes ``scratch.U[s]`` where it corrects lever arms."""
    K, motion, evidence, turns = scratch.K, scratch.motion, scratch.evidence, scratch.turns
    u, u_p = scratch.U[s], scratch.U_parent[s]
    felt_into(u_p, state.force[p], K[p], body.from_parent[s], state.arm[s], 3)
    moved = math.sqrt(motion[s] ** 2 + motion[p] ** 2)
    variance = chain_rows.row_variance(noise, moved, dt)
    if body.is_bridged[s]:
        u = scratch.U_beyond[s]
        for i in range(3):
            u[i] = scratch.U[s, i]
            for j in range(3):
                u[i] -= K[s, i, j] * body.beyond[s, j]
        variance += (body.slack[s] * moved) ** 2 * noise.row_memory_s / dt
    variance += state.vibration[s, 0] + state.vibration[p, 0]
    variance += bending(state, s, u, dt) + bending(state, p, u_p, dt)
    is_lost = state.is_open[s] == 1
    if not is_lost and state.is_open[p] == 1 and is_apart(body, state, s):
        # the parent has begun anew beside a segment that has not: this shows the parent's heading
        is_lost = True
        uncertain = variance + tilt_spread(state, s, dt) + tilt_spread(state, p, dt)
        gather_heading(state, p, u_p, u, uncertain, dt)
    elif is_lost:
        uncertain = variance + tilt_spread(state, s, dt) + tilt_spread(state, p, dt)
        gather_heading(state, s, u, u_p, uncertain, dt)
        shown, angle = shown_heading(state, noise, s)
        if shown > 0.0:
            state.is_open[s] = 0
            _settle(evidence, s, shown)
            turn_beyond(body, state, s, angle, turns)
            return
    elif turns[s, 2] != 0.0 or turns[p, 2] != 0.0:
        return  # this instant's averages are those before the turn
    else:
        at_once = variance * dt / noise.row_memory_s
        added = learn_joint_arms(state, noise, scratch.learning, s, p, u, u_p, K[s], K[p], at_once, dt)
        variance += added * noise.row_memory_s / dt
    if not is_lost:
        variance *= row_doubt(state, s, p)
    chain_rows.joint_row(evidence, state, noise, s, p, u, u_p, variance, dt, is_lost)


@compiled
def _settle(evidence: Evidence, s: int, variance: float) -> None:
    """The heading against the parent is what it is now, to that variance."""
    row, row_p = np.zeros(3), np.zeros(3)
    row[2], row_p[2] = 1.0, -1.0
    add_edge(evidence, s, row, row_p, 0.0, variance)


@compiled
def note_sigma(sigma: FloatArray, state: FilterState) -> None:
    """sigma (n,) rad ← root of the expected square of the angle of error; as it was where there is none."""
    for s in range(len(sigma)):
        if state.is_started[s]:
            P = state.P[s]
            sigma[s] = min(math.sqrt(P[0, 0] + P[1, 1] + P[2, 2]), 2.0 * OPEN_SIGMA)
