"""The observations of the tree filter as rows on orientation errors. Compiled.

A world vector ``u = R̂ s`` is truly ``exp(δ) R̂ s ≈ u − [u]× δ``. Two sides that must agree therefore give
``u − u_p = [m]× (δ − δ_p)`` with their mean ``m = (u + u_p) / 2``, and a known vector ``y``:
``u − y = [y]× δ``.
With u and u_p in their own places noise would seem to show a turn of both together, which no joint shows.
"""

from __future__ import annotations

import math

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, skew
from gateway.reconstruction.inertial.chain_state import (
    ExpectedField,
    FieldWatch,
    Joint,
    Link,
    Segment,
    SegmentWork,
    World,
)
from gateway.reconstruction.inertial.lever_arms import own_covariance, relative_covariance, spread
from gateway.reconstruction.inertial.tree_filter import Three, add_edge, add_joint, add_known, add_own
from gateway.reconstruction.inertial.tuning import Tuning


@compiled
def joint_row(joint: Joint, is_unobserved: bool, tuning: Tuning, dt: float) -> None:
    """The joint's acceleration seen from both sides, ``u`` and ``u_parent``, every dt, to ``row_variance``.

    is_unobserved: the heading of one against the other is not known.
    """
    _, child, parent, now, _ = joint
    u, u_p, variance = now.u, now.u_parent, now.row_variance
    residual = u[0] - u_p[0], u[1] - u_p[1], u[2] - u_p[2]
    middle = 0.5 * (u[0] + u_p[0]), 0.5 * (u[1] + u_p[1]), 0.5 * (u[2] + u_p[2])
    at_once = variance * min(1.0, dt / tuning.row_memory_s)
    off = spread(middle[0], middle[1], middle[2], relative_covariance(child, parent))
    nis = _nis(off, residual, at_once, 2 if is_unobserved else 0)
    inflation = _watch_joint(child, nis, tuning, dt)
    if inflation >= tuning.loose_nis:
        return
    variance *= inflation
    if is_unobserved:
        _unobserved_joint_row(now, residual, variance)
        return
    variance *= _huber(off, residual, inflation * at_once, tuning.huber)
    add_joint(now.evidence, middle, residual, variance)


@compiled
def _unobserved_joint_row(now: SegmentWork, residual: Three, variance: float) -> None:
    """Heading against the parent unknown: the horizontal parts are only equally long."""
    u, u_p = now.u, now.u_parent
    H, H_p = skew(u), skew(u_p)
    wide = variance + _horizontal_square(u) + _horizontal_square(u_p)
    for i in range(3):
        H[i, 2], H_p[i, 2] = 0.0, 0.0
        for j in range(2):
            H_p[i, j] *= -1.0
        add_edge(now.evidence, H[i], H_p[i], residual[i], wide if i < 2 else variance)


@compiled
def known_row(
    now: SegmentWork, segment: Segment, u: FloatArray, y: FloatArray, variance: float, tuning: Tuning
) -> None:
    """A vector u of the segment that is known in the world: y; (3,)."""
    residual = u[0] - y[0], u[1] - y[1], u[2] - y[2]
    uncertain = spread(y[0], y[1], y[2], own_covariance(segment))
    variance *= _huber(uncertain, residual, variance, tuning.huber)
    add_known(now.evidence, (y[0], y[1], y[2]), residual, variance)


@compiled
def unobserved_known_row(now: SegmentWork, u: FloatArray, y: FloatArray, variance: float) -> None:
    """The same where the horizontal direction of u says nothing yet."""
    residual = u[0] - y[0], u[1] - y[1], u[2] - y[2]
    H, H_y = skew(u), skew(y)
    wide = variance + _horizontal_square(u) + _horizontal_square(y)
    for i in range(3):
        H[i, 2] = 0.0
        for j in range(2):
            H[i, j] = 0.5 * (H[i, j] + H_y[i, j])
        add_own(now.evidence, H[i], residual[i], wide if i < 2 else variance)


@compiled
def _nis(uncertain: Three, residual: Three, variance: float, first: int) -> float:
    """Normalised innovation squared, per component; first: component from which they are compared, 2 where
    the horizontal ones cannot be."""
    square, expected = 0.0, 0.0
    for i in range(first, 3):
        square += residual[i] ** 2
        expected += uncertain[i] + variance
    return square / expected


@compiled
def _watch_joint(child: Segment, nis: float, tuning: Tuning, dt: float) -> float:
    """By how much the joint to the parent agrees worse than its noise says, variances; 1: no worse. Modules
    worn otherwise than the rig says disagree all the time, and their joint tells little.

    Where that comes out, what the joint has told until then is taken back: the segment is as uncertain as at
    its start, and stands on what its own module tells until the joint fits again.
    """
    seen, before = min(nis, tuning.largest_nis), child.joint_nis
    child.joint_nis += (1.0 - math.exp(-dt / tuning.joint_nis_memory_s)) * (seen - before)
    if before < tuning.loose_nis <= child.joint_nis:
        for i in range(3):
            child.P[i, i] += tuning.start_heading**2 if i == 2 else tuning.start_tilt**2
        child.unaided_square = 0.0
    inflation: float = max(1.0, child.joint_nis)
    return inflation


@compiled
def _horizontal_square(v: FloatArray | Three) -> float:
    square: float = v[0] * v[0] + v[1] * v[1]
    return square


@compiled
def _huber(uncertain: Three, residual: Three, variance: float, limit: float) -> float:
    """By how much the variance is raised: 1 within ``limit`` standard deviations of the innovation.

    uncertain: (3,) variances that the orientation gives it.
    """
    square = 0.0
    for i in range(3):
        square += residual[i] ** 2 / (uncertain[i] + variance)
    return max(1.0, math.sqrt(square) / limit)


@compiled
def _seen(R: FloatArray, m: FloatArray) -> Three:
    """R m."""
    return (
        R[0, 0] * m[0] + R[0, 1] * m[1] + R[0, 2] * m[2],
        R[1, 0] * m[0] + R[1, 1] * m[1] + R[1, 2] * m[2],
        R[2, 0] * m[0] + R[2, 1] * m[1] + R[2, 2] * m[2],
    )


@compiled
def expect_field(expected: ExpectedField, world: World, tuning: Tuning, dt: float) -> None:
    """``expected`` ← for an instant dt (s) after the one before."""
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
    """``now.field_off``, ``now.disturbance`` ← of a segment's field.

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
def _watch_changes(
    mean: FieldWatch, length: float, dip: float, expected: ExpectedField, tuning: Tuning, dt: float
) -> None:
    """One norm (µT) and dip (rad) more."""
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
    """Heading by the field, weak; after ``watch_field``.

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
    """The field's heading may be off otherwise after a while, by no more than norm and dip let expect."""
    offset = segment.field_offset
    shown = segment.field_watch.error_square / expected.horizontal + expected.by_tilt
    largest = min(tuning.heading**2, shown)
    offset.variance += largest * dt / tuning.heading_offset_s
    if offset.variance > largest:
        offset.angle *= largest / offset.variance
        offset.variance = largest


@compiled
def note_aided(segment: Segment, world: World, tuning: Tuning, dt: float) -> None:
    """How far a mean acceleration is from none while the inclination is known: what a row that takes it for
    none will be off by, once nothing aids the chain any more."""
    tilt = segment.P[0, 0] + segment.P[1, 1]
    if segment.averages.seconds < tuning.unaided_window_s or tilt > tuning.aided_tilt**2:
        return
    square = 0.0
    for i in range(3):
        square += (segment.averages.long_force[i] - world.at_rest[i]) ** 2 / 3.0
    memory_s = tuning.aided_rise_s if square > segment.unaided_square else tuning.aided_fall_s
    segment.unaided_square += (1.0 - math.exp(-dt / memory_s)) * (square - segment.unaided_square)


@compiled
def unaided_row(
    now: SegmentWork, segment: Segment, world: World, sharing: int, tuning: Tuning, dt: float
) -> None:
    """Mean acceleration over a window is small, where nothing tells what it is: no smaller than it was while
    that was known, and over a shorter time as much larger as speeds are the same. It stays for the window on
    either side. sharing: segments that move together and have such a row each."""
    square = max(_mean_square(segment, tuning, dt), 2.0 * segment.unaided_square)
    variance = square * tuning.unaided_window_s / dt * sharing
    known_row(now, segment, segment.averages.long_force, world.at_rest, variance, tuning)


@compiled
def starting_row(now: SegmentWork, segment: Segment, world: World, tuning: Tuning, dt: float) -> None:
    """The same of a segment whose chain is aided, as long as its inclination is hardly known: after a start
    in mid-motion. Joints show it only then, one after the other from where the chain is aided."""
    if segment.P[0, 0] + segment.P[1, 1] > tuning.unsettled_tilt**2:
        variance = _mean_square(segment, tuning, dt) * tuning.unaided_window_s / dt
        known_row(now, segment, segment.averages.long_force, world.at_rest, variance, tuning)


@compiled
def _mean_square(segment: Segment, tuning: Tuning, dt: float) -> float:
    """(m/s²)² of a mean acceleration: over a shorter time, as after a gap, as much larger as speeds are the
    same, and for some time as large as a start in motion has let expect."""
    lasted_s = min(max(segment.averages.seconds, dt), tuning.unaided_window_s)
    square: float = max((tuning.unaided_speed / lasted_s) ** 2, segment.starting_square)
    return square


@compiled
def rest_row(now: SegmentWork, segment: Segment, tuning: Tuning, dt: float) -> None:
    """At rest the mean rate is the bias."""
    variance = tuning.rest_rate_sigma**2 * tuning.rest_window_s / dt
    for i in range(3):
        now.evidence.own[3 + i, 3 + i] += 1.0 / variance
        now.evidence.own_vector[3 + i] += (segment.rest.rate[i] - segment.bias[i]) / variance


@compiled
def row_variance(tuning: Tuning, motion: float, interval_s: float) -> float:
    """(m/s²)² of a row of accelerations that comes every ``interval_s``; motion: ‖[ω̇, ω]‖ or rms sum."""
    variance = tuning.specific_force**2 + (tuning.lever_arm * motion) ** 2
    return variance * tuning.row_memory_s / interval_s
