"""Prediction and correction of the tree filter: everything that turns with a segment. Compiled."""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import Clipped, FloatArray, Quantity
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, is_finite, norm
from gateway.reconstruction.inertial.chain_state import (
    Body,
    Heading,
    Link,
    Segment,
    SegmentWork,
    Started,
    State,
    Validity,
    Work,
    World,
)
from gateway.reconstruction.inertial.corrections import gyroscope_inflation
from gateway.reconstruction.inertial.tree_filter import propagate, propagate_own
from gateway.reconstruction.inertial.tuning import Tuning

FORCE_CLIPPED, RATE_CLIPPED = Clipped.SPECIFIC_FORCE.value, Clipped.ANGULAR_RATE.value
AIR_VELOCITY = Quantity.AIR_VELOCITY.value
NOTHING, SATURATED_RATE = Validity.NOTHING.value, Validity.SATURATED_RATE.value
RATE, FORCE = Validity.RATE.value, Validity.FORCE.value
NOT_STARTED, STARTED, STARTS_AGAIN = Started.NO.value, Started.YES.value, Started.AGAIN.value
OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value


@compiled
def predict(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Turn every started segment over dt by the mean of its last two rates, in place."""
    links, segments, works = body.segments, state.segments, work.segments
    for s in range(len(links)):
        segment, now, parent = segments[s], works[s], links[s].parent
        if segment.started == NOT_STARTED:
            continue
        rotation_matrix.copy_into(now.before, segment.R)
        if now.validity > NOTHING:
            density = _turn_as_measured(segment, now, tuning, dt)
        else:
            density = _coast(segment, now, tuning, dt)
        if segment.silent_s > tuning.longest_silence_s:
            segment.started = STARTS_AGAIN
        w, turn = now.mean_rate, work.shared.rotation
        rotation_matrix.exponential_into(turn, w[0] * dt, w[1] * dt, w[2] * dt)
        rotation_matrix.turn_rows(segment.R, turn)
        propagate_own(segment.P, now.before, dt)
        for i in range(3):
            # an orientation cannot be worse than unknown: keeps a long silence finite
            segment.P[i, i] += density * dt if segment.P[i, i] < tuning.unknown_heading**2 else 0.0
            segment.P[3 + i, 3 + i] += tuning.bias_walk**2 * dt
        if body.world.is_tree and parent >= 0:
            propagate(segment.C, now.before, works[parent].before, dt)


@compiled
def _turn_as_measured(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> float:
    """``now.mean_rate`` ← by the gyroscope; returns the density of its noise, (rad/s)²/Hz."""
    _mean_rate(segment, now, dt)
    speed = norm(now.mean_rate)
    density = tuning.gyroscope**2 + (tuning.gyroscope_scale * speed) ** 2 * tuning.scale_memory_s
    if now.validity < RATE:
        density += tuning.saturated_noise**2
        segment.silent_s += dt
    else:
        segment.silent_s = 0.0
    change = 0.0
    for i in range(3):
        step = now.angular_rate[i] - segment.rate[i]
        change += step**2
        segment.rate_slope[i], segment.rate[i] = step / dt, now.angular_rate[i]
    density += gyroscope_inflation(segment, change, dt)
    return float(density)


@compiled
def _coast(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> float:
    """``now.mean_rate`` ← of a silent module; returns the density of its noise, (rad/s)²/Hz."""
    w = now.mean_rate
    for i in range(3):
        w[i] = (segment.rate[i] - segment.bias[i]) * math.exp(-dt / tuning.longest_coast_s)
        segment.rate[i] = segment.bias[i] + w[i]
        segment.rate_slope[i] = np.nan
    segment.silent_s += dt
    return float((tuning.dead_rate**2 + dot(w, w)) * tuning.longest_coast_s)


@compiled
def _mean_rate(segment: Segment, now: SegmentWork, dt: float) -> None:
    """``now.mean_rate`` ← what turns the segment over dt, rad/s: by its last three rates, error O(dt³) of the
    angle.

    The trapezoid, less its error by Euler and Maclaurin's formula, and the coning of an axis that moves
    (Bortz 1971). At 100 Hz the trapezoid alone is off by up to a degree in fast motion.
    """
    w, rate, bias, last, slope = (
        now.mean_rate, now.angular_rate, segment.bias, segment.rate, segment.rate_slope
    )  # fmt: skip
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
def judge_samples(work: Work, tuning: Tuning) -> None:
    """``validity`` of each segment ← what of its module's sample counts.

    A sensor is at the end of its range where its module says so, and at the largest range there is.
    """
    works = work.segments
    for s in range(len(works)):
        now = works[s]
        now.validity = NOTHING
        if now.status <= 1 and is_finite(now.angular_rate):
            now.validity = RATE
            is_usable = is_finite(now.specific_force) and now.clipped & FORCE_CLIPPED == 0
            if exceeds(now.angular_rate, tuning.largest_rate) or now.clipped & RATE_CLIPPED > 0:
                now.validity = SATURATED_RATE
            elif is_usable and not exceeds(now.specific_force, tuning.largest_force):
                now.validity = FORCE


@compiled
def start_segments(body: Body, state: State, tuning: Tuning, work: Work) -> None:
    """Begin where a first sample has come; until then what a module says does not count."""
    links, segments, works = body.segments, state.segments, work.segments
    for s in range(len(links)):
        segment, now = segments[s], works[s]
        if segment.started != STARTED:
            if now.validity == FORCE:
                _start(segment, links[s], now, body.world, tuning)
            if segment.started != STARTED:
                now.validity = NOTHING


@compiled
def _start(segment: Segment, link: Link, now: SegmentWork, world: World, tuning: Tuning) -> None:
    """From the first sample: level by the specific force, facing as the field says, if any."""
    f, w, m = now.specific_force, now.angular_rate, now.magnetic_field
    secondary, secondary_w = np.zeros(3), np.zeros(3)
    if world.uses_field and is_finite(m):
        for i in range(3):
            secondary[i], secondary_w[i] = m[i], world.magnetic_field[i]
    else:
        secondary[int(abs(f[0]) > abs(f[1]))] = 1.0
        secondary_w[1] = 1.0
    R = rotation_matrix.from_two_vectors(f, secondary, world.at_rest, secondary_w)
    if not is_finite(R[0]):
        return
    rotation_matrix.copy_into(segment.R, R)
    moved = start_acceleration(world.gravity, f, w, tuning)
    segment.starting_square = tuning.starting_share * moved
    tilt = tuning.start_tilt**2 + moved / dot(world.gravity, world.gravity)
    _start_covariance(segment, min(tilt, tuning.unknown_heading**2), tuning)
    segment.started = STARTED
    segment.heading = UNOBSERVED if link.heading_observable else OBSERVED
    segment.silent_s, segment.compass_s, segment.averages.seconds = 0.0, 0.0, 0.0
    segment.joint_nis = 0.0
    _start_watches(segment)
    for i in range(3):
        segment.bias[i], segment.rate[i], segment.rate_slope[i] = 0.0, w[i], np.nan
        # means of one sample: begun at zero, gravity alone would be a change for seconds
        segment.rest.rate[i], segment.rest.force[i] = w[i], f[i]


@compiled
def _start_covariance(segment: Segment, tilt: float, tuning: Tuning) -> None:
    """tilt: rad²."""
    arms = segment.arms
    for i in range(6):
        for j in range(6):
            segment.P[i, j], segment.C[i, j], arms.covariance[i, j] = 0.0, 0.0, 0.0
    for i in range(3):
        segment.P[i, i] = tilt
        segment.P[3 + i, 3 + i] = tuning.bias**2
    segment.P[2, 2] = tuning.unknown_heading**2
    # a module that comes back may sit elsewhere
    for i in range(6):
        arms.covariance[i, i] = tuning.lever_arm_offset**2
    arms.since_s = np.inf
    segment.field_offset.angle, segment.field_offset.variance = 0.0, tuning.heading**2


@compiled
def _start_watches(segment: Segment) -> None:
    """What is said of a module's samples begins anew."""
    seen, heading, rest = segment.corrections, segment.heading_sums, segment.rest
    for i in range(2):
        seen.sums[i], seen.sums_before[i] = 0.0, 0.0
    seen.seconds, seen.product, seen.square, seen.gyroscope, seen.rows = 0.0, 0.0, 0.0, 0.0, 0.0
    heading.along, heading.across, heading.length, heading.seconds = 0.0, 0.0, 0.0, 0.0
    rest.rate_square, rest.force_square, rest.still_s, rest.standing_s = 0.0, 0.0, 0.0, 0.0


@compiled
def start_acceleration(gravity: FloatArray, f: FloatArray, w: FloatArray, tuning: Tuning) -> float:
    """(m/s²)², square of what a module may accelerate by, as its first sample shows: as much as it feels more
    or less than gravity, and as it turns at the end of ``start_arm``."""
    turning = dot(w, w) * tuning.start_arm
    square: float = (norm(f) - norm(gravity)) ** 2 + turning * turning
    return square


@compiled
def turn_segments(body: Body, state: State, work: Work) -> None:
    """Turn segments by their ``turn``, and all remembered that turns with them, in place."""
    segments, works = state.segments, work.segments
    for s in range(len(segments)):
        now, segment = works[s], segments[s]
        if _is_turn(now.turn):
            E, averages = now.rotation, segment.averages
            rotation_matrix.exponential_into(E, now.turn[0], now.turn[1], now.turn[2])
            rotation_matrix.turn_columns(E, segment.R)
            rotation_matrix.turn_columns(E, averages.lever_arm_matrix)
            rotation_matrix.turn(E, averages.force)
            rotation_matrix.turn(E, averages.last_force)
            rotation_matrix.turn(E, averages.long_force)
    for d in range(len(body.devices)):
        mount, device = body.devices[d], state.devices[d]
        now = works[mount.segment]
        if _is_turn(now.turn):
            if mount.kind == AIR_VELOCITY:
                for j in range(device.n_readings):
                    rotation_matrix.turn(now.rotation, device.readings[j].value)
            rotation_matrix.turn_columns(now.rotation, device.turn)


@compiled
def correct(state: State, work: Work) -> None:
    """``turn`` ← the errors found of orientations; those of biases are added."""
    segments, works = state.segments, work.segments
    for s in range(len(works)):
        now = works[s]
        for i in range(3):
            now.turn[i] = now.x[i]
            segments[s].bias[i] += now.x[3 + i]


@compiled
def _is_turn(v: FloatArray) -> bool:
    return bool(v[0] != 0.0 or v[1] != 0.0 or v[2] != 0.0)
