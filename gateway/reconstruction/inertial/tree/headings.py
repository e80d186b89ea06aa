"""Headings by the magnetic field and by the sun in the tree filter. Compiled."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gateway.frames import FloatArray, ImuFrame, IntArray, SunSight
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot
from gateway.reconstruction.inertial.tree.rows import _horizontal_square
from gateway.reconstruction.inertial.tree.start import compass_turn, turn_heading_sums
from gateway.reconstruction.inertial.tree.state import (
    Body,
    ExpectedField,
    FieldWatch,
    Heading,
    Link,
    Segment,
    SegmentWork,
    State,
    SunSums,
    Validity,
    Work,
    World,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import Three, add_own

OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value
RATE = Validity.RATE.value


# The field


@compiled
def follow_field(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Section 8: a row where the heading is observed; where it is not the field leads it as a compass."""
    expected, world = work.shared.expected, body.world
    links, segments, works = body.segments, state.segments, work.segments
    expect_field(expected, world, tuning, dt)
    for s in range(len(links)):
        segment, now = segments[s], works[s]
        m = now.magnetic_field
        if now.validity < RATE:
            continue  # a saturated gyroscope has lost it: the field would seem disturbed
        if not math.isfinite(m[0] + m[1] + m[2]):
            continue
        watch_field(segment, now, world, expected, tuning, dt)
        if segment.heading == OBSERVED:
            field_row(segment, links[s], now, expected, tuning, dt)
            continue
        now.turn[2] = compass_turn(segment, now, tuning, dt)
    for s in range(len(links)):
        p, sums = links[s].parent, segments[s].heading_sums
        turn_heading_sums(sums, works[s].turn[2])
        if p >= 0:
            turn_heading_sums(sums, -works[p].turn[2])


@compiled
def expect_field(expected: ExpectedField, world: World, tuning: Tuning, dt: float) -> None:
    """For (28) to (31): ``expected`` ← for an instant dt (s) after the one before."""
    h = world.magnetic_field
    level, square = h[0] * h[0] + h[1] * h[1], dot(h, h)
    horizontal = max(level / square, tuning.least_horizontal**2)
    expected.norm = math.sqrt(square)
    expected.dip = math.atan2(h[2], math.sqrt(level))
    expected.horizontal = horizontal
    gravity = world.gravity
    expected.by_tilt = tuning.force_bias**2 / dot(gravity, gravity) * (1.0 / horizontal - 1.0)
    expected.gain = 1.0 - math.exp(-dt / tuning.field_memory_s)
    expected.change_gain = 1.0 - math.exp(-dt / tuning.field_change_s)
    expected.smoothing_gain = 1.0 - math.exp(-dt / tuning.field_smoothing_s)


@compiled
def watch_field(
    segment: Segment, now: SegmentWork, world: World, expected: ExpectedField, tuning: Tuning, dt: float
) -> None:
    """(27), (30), D of (33): ``now.field_off``, ``now.disturbance`` ← of a segment's field.

    How much its norm and dip change while the segment moves goes to ``segment.field_watch``, and how much of
    that lasts: means of a change to and fro are small. So does how far they are from what they should be: at
    once where that is more than before, with the turning of the module where it is less.
    """
    h, m, mean = world.magnetic_field, now.magnetic_field, segment.field_watch
    seen = _seen(segment.R, m)
    now.field_off = math.atan2(h[0] * seen[1] - h[1] * seen[0], h[0] * seen[0] + h[1] * seen[1])
    length, dip = math.sqrt(dot(m, m)), math.atan2(seen[2], math.sqrt(_horizontal_square(seen)))
    _watch_changes(mean, length, dip, expected, tuning, dt)
    stronger = (1.0 + mean.norm_change) * mean.norm / expected.norm - 1.0
    steeper = mean.dip_change + mean.dip - expected.dip
    wrong, w, proof = stronger * stronger + steeper * steeper, segment.rate, expected.change_gain
    if not wrong > mean.error_square:
        proof = math.sqrt(dot(w, w)) * dt / tuning.field_proof
    mean.error_square += min(proof, 1.0) * (wrong - mean.error_square)
    steeper = (dip - expected.dip) / tuning.dip_tolerance
    stronger = (length / expected.norm - 1.0) / tuning.norm_tolerance
    now.disturbance = 1.0 + steeper * steeper + stronger * stronger


@compiled
def _seen(R: FloatArray, m: FloatArray) -> Three:
    """R m."""
    return (
        R[0, 0] * m[0] + R[0, 1] * m[1] + R[0, 2] * m[2],
        R[1, 0] * m[0] + R[1, 1] * m[1] + R[1, 2] * m[2],
        R[2, 0] * m[0] + R[2, 1] * m[1] + R[2, 2] * m[2],
    )


@compiled
def _watch_changes(
    mean: FieldWatch, length: float, dip: float, expected: ExpectedField, tuning: Tuning, dt: float
) -> None:
    """(28), and the means of (29): one norm (µT) and dip (rad) more."""
    if mean.seconds == 0.0:
        change = tuning.field_change
        mean.norm, mean.dip, mean.norm_drift, mean.dip_drift = length, dip, change, 0.0
        mean.change_square, mean.error_square = change**2, change**2
    mean.seconds += dt
    gain = max(expected.gain, dt / mean.seconds)
    mean.norm += gain * (length - mean.norm)
    mean.dip += gain * (dip - mean.dip)
    mean.norm_change += expected.smoothing_gain * (length / mean.norm - 1.0 - mean.norm_change)
    mean.dip_change += expected.smoothing_gain * (dip - mean.dip - mean.dip_change)
    of_norm, of_dip = mean.norm_change, mean.dip_change
    mean.change_square += expected.change_gain * (of_norm * of_norm + of_dip * of_dip - mean.change_square)
    mean.norm_drift += expected.change_gain * (of_norm - mean.norm_drift)
    mean.dip_drift += expected.change_gain * (of_dip - mean.dip_drift)


@compiled
def field_row(
    segment: Segment, link: Link, now: SegmentWork, expected: ExpectedField, tuning: Tuning, dt: float
) -> None:
    """(29), (33), (34): heading by the field, weak; after ``watch_field``.

    How far it is off throughout is found beside the heading and taken off: a field that stays as it is holds
    a heading where it was, but does not say where that is. How far it may be off is told by how far norm and
    dip are from what they should be: where they are right while the module turns and travels, it is the
    earth's, and shows headings but for how accelerometers are off. What bends the dip bends the heading too,
    the more the steeper the field: for ``heading_memory_s`` to the same side where the change lasts, for no
    longer than it is watched where it comes and goes.
    """
    seen, offset, heading_variance = segment.field_watch, segment.field_offset, segment.P[2, 2]
    change = seen.change_square / expected.horizontal
    drift_square = seen.change_square - seen.norm_drift * seen.norm_drift - seen.dip_drift * seen.dip_drift
    fleeting = max(0.0, drift_square) / expected.horizontal
    _bound_offset(segment, expected, tuning, dt)
    straying, uncertain = offset.variance + change, min(heading_variance, tuning.unknown_heading**2)
    off = now.field_off - offset.angle
    weight = max(1.0, abs(off) / math.sqrt(straying + uncertain) / tuning.huber) * now.disturbance
    is_alone = link.heading_observable == 0 or segment.joint_nis >= tuning.loose_nis
    is_first = is_alone and heading_variance > straying
    memory_s = tuning.first_look_s if is_first else tuning.heading_memory_s
    varying = (change - fleeting) * memory_s + fleeting * min(memory_s, tuning.field_change_s)
    variance = (offset.variance * memory_s + varying) / dt * weight
    add_own(now.evidence, (0.0, 0.0, 1.0), -off, variance)
    if not is_first:  # what the heading is off by stays as long as the field's own
        white = (uncertain * tuning.heading_memory_s + varying) / dt * weight
        gain = offset.variance / (offset.variance + white)
        offset.angle += gain * off
        offset.variance -= gain * offset.variance


@compiled
def _bound_offset(segment: Segment, expected: ExpectedField, tuning: Tuning, dt: float) -> None:
    """(31), (32): the field's heading may be off otherwise after a while, by no more than norm and dip let
    expect."""
    offset = segment.field_offset
    shown = segment.field_watch.error_square / expected.horizontal + expected.by_tilt
    largest = min(tuning.heading**2, shown)
    offset.variance += largest * dt / tuning.heading_offset_s
    if offset.variance > largest:
        offset.angle *= largest / offset.variance
        offset.variance = largest


# The sun
#
# Of the direction that the cells see only the azimuth counts: light of sky and ground comes from all around
# and shifts its height alone. A wrong tilt θ shifts the azimuth by ``θ tan(height)``; the variance has it.


def stacked_sights(observations: Sequence[ImuFrame]) -> FloatArray:
    """(T, m + 1, 4) where modules see the sun, sensor axes, with its standard deviation; the last row: where
    it stands in the world. (T, 0, 4) if none of the frames has it."""
    if all(observation.sun is None for observation in observations):
        return np.zeros((len(observations), 0, 4))
    m = len(observations[0].status)
    stacked = np.full((len(observations), m + 1, 4), np.nan)
    for rows, observation in zip(stacked, observations, strict=True):
        if observation.sun is not None:
            rows[:m, :3], rows[:m, 3] = observation.sun.direction, observation.sun.sigma
            rows[m, :3] = observation.sun.world
    return stacked


def sight_of(rows: FloatArray) -> SunSight | None:
    """What one frame's rows, (m + 1, 4) or (0, 4), were stacked from; None: it had none."""
    if len(rows) == 0 or np.isnan(rows[-1, 0]):
        return None
    return SunSight(rows[-1, :3], rows[:-1, :3], rows[:-1, 3])


@compiled
def take_sun(work: Work, module_of_segment: IntArray, R_bs: FloatArray, sun: FloatArray) -> None:
    """Rows (m + 1, 4) of modules to segments, segment axes; those without module are left."""
    m = len(sun) - 1
    for i in range(3):
        work.shared.sun[i] = sun[m, i]
    for s in range(len(module_of_segment)):
        row, now = module_of_segment[s], work.segments[s]
        if row >= 0:
            rotation_matrix.rotate_into(now.sun, R_bs[s], sun[row])
            now.sun_sigma = sun[row, 3]


@compiled
def follow_sun(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """A row for every segment that sees the sun; an unobserved heading is turned to it."""
    n, world = len(body.segments), work.shared.sun
    across = math.hypot(world[0], world[1])
    for s in range(n):
        now = work.segments[s]
        now.is_settled = 0
        if now.validity >= RATE and math.isfinite(now.sun[0] + now.sun_sigma + across):
            _follow_sun(state.segments[s], now, world, tuning, dt)
    for s in range(n):
        p, sums = body.segments[s].parent, state.segments[s].heading_sums
        if work.segments[s].is_settled:
            turn_heading_sums(sums, work.segments[s].turn[2])
        elif p >= 0 and work.segments[p].is_settled:
            turn_heading_sums(sums, -work.segments[p].turn[2])


@compiled
def _follow_sun(segment: Segment, now: SegmentWork, world: FloatArray, tuning: Tuning, dt: float) -> None:
    """(35) of one segment; world: (3,) direction of the sun."""
    across, heading_variance = math.hypot(world[0], world[1]), segment.P[2, 2]
    off, height_off = _sun_error(segment.R, now.sun, world)
    tilt = 0.5 * (segment.P[0, 0] + segment.P[1, 1])
    variance = (now.sun_sigma**2 + tilt * world[2] ** 2) / across**2
    variance *= 1.0 + (height_off / tuning.sun_height_tolerance) ** 2
    if segment.heading == UNOBSERVED or heading_variance > tuning.sun_unsure**2:
        angle = _steady_turn(segment.sun, off, tuning, dt)
        if angle != 0.0:
            now.turn[2], now.is_settled = angle, 1
            segment.heading = OBSERVED
            add_own(now.evidence, (0.0, 0.0, 1.0), 0.0, variance)
        return
    sigma = math.sqrt(variance + min(heading_variance, tuning.unknown_heading**2))
    weight = max(1.0, abs(off) / sigma / tuning.huber)
    variance = variance * weight * max(1.0, tuning.sun_memory_s / dt)
    add_own(now.evidence, (0.0, 0.0, 1.0), -off, variance)


@compiled
def _sun_error(R: FloatArray, sun: FloatArray, world: FloatArray) -> tuple[float, float]:
    """Heading and height by which a direction (3,) in segment axes is off the sun, rad."""
    seen = rotation_matrix.rotate(R, sun)
    off = math.atan2(world[0] * seen[1] - world[1] * seen[0], world[0] * seen[0] + world[1] * seen[1])
    height = math.atan2(seen[2], math.hypot(seen[0], seen[1]))
    return off, height - math.atan2(world[2], math.hypot(world[0], world[1]))


@compiled
def _steady_turn(look: SunSums, off: float, tuning: Tuning, dt: float) -> float:
    """The turn that brings an unknown heading to the sun, once it was seen steadily; 0: not yet."""
    decay = math.exp(-dt / tuning.sun_look_memory_s)
    look.along = look.along * decay + math.cos(off) * dt
    look.across = look.across * decay + math.sin(off) * dt
    look.seconds = look.seconds * decay + dt
    length = math.hypot(look.along, look.across)
    if look.seconds < tuning.sun_look_s or length < tuning.sun_steady * look.seconds:
        return 0.0
    angle = -math.atan2(look.across, look.along)
    look.along, look.across, look.seconds = 0.0, 0.0, 0.0
    return angle if angle != 0.0 else -1e-12
