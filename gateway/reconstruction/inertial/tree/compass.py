"""Headings by the magnetic field, beside the tree filter. Compiled.

Motion shows how segments head against each other far better than any field in a building does, and a wrong
field must not turn what motion has shown. So the filter has no row for the field. Beside it each module
has a compass: how far the filter's heading seems off by its field, and how fast that grows. What is published
is the filter's heading less the error that compasses and filter together expect: the whole body turns with
the mean of its compasses, a segment alone as far as the filter does not know its heading against its
neighbours.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.geometry.vectors import dot, is_finite
from gateway.reconstruction.inertial.tree.start import NO_FIELD, agreed, give_of, root_of, tilt_square
from gateway.reconstruction.inertial.tree.state import (
    Body,
    Compass,
    ExpectedField,
    FieldWatch,
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
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import Three

UNOBSERVED = Heading.UNOBSERVED.value
NOTHING, RATE = Validity.NOTHING.value, Validity.RATE.value
STARTED = Started.YES.value
LEAST_APART = 1e-9
"""rad²."""


@compiled
def follow_field(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Update the compass of every started module by the field it measures, section 8.

    dt: s since the instant before.
    """
    expected, world = work.shared.expected, body.world
    segments, works = state.segments, work.segments
    expect_field(expected, world, tuning, dt)
    for s in range(len(segments)):
        segment, now = segments[s], works[s]
        compass, m = segment.compass, now.magnetic_field
        if segment.started != STARTED:
            continue
        _drift(segment, now, tuning, dt)
        # a saturated gyroscope has lost it: the field would seem disturbed
        if now.validity >= RATE and math.isfinite(m[0] + m[1] + m[2]):
            watch_field(segment, now, world, expected, tuning, dt)
            shown = segment.field_watch.error_square / expected.horizontal
            bent = tilt_square(segment) * (1.0 / expected.horizontal - 1.0)
            _look(compass, now, bent, tuning, dt)
            compass.tilt_square = compass.misread**2 * bent
            # (29) σ_o²
            by_tilt = expected.by_tilt + compass.tilt_square
            compass.offset_square = min(shown, tuning.largest_offset**2) + by_tilt


@compiled
def expect_field(expected: ExpectedField, world: World, tuning: Tuning, dt: float) -> None:
    """Set ``expected`` for an instant dt (s) after the one before, for equations (27) to (31)."""
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
    expected.smoothing_gain = 1.0 - math.exp(-dt / tuning.smoothing_s)


@compiled
def watch_field(
    segment: Segment, now: SegmentWork, world: World, expected: ExpectedField, tuning: Tuning, dt: float
) -> None:
    """Set ``now.field_off`` and ``now.disturbance`` of a segment; (27), (28) and D of (31).

    The mean square by which norm and dip are wrong, ``segment.field_watch.error_square``, grows soon where
    they are worse than before, and shrinks only as the module turns.
    """
    h, m, mean = world.magnetic_field, now.magnetic_field, segment.field_watch
    seen = _seen(segment.R, m)
    now.field_off = math.atan2(h[0] * seen[1] - h[1] * seen[0], h[0] * seen[0] + h[1] * seen[1])
    length, dip = math.sqrt(dot(m, m)), math.atan2(seen[2], math.hypot(seen[0], seen[1]))
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
    """Return R m: the field m (3,) in the world, as the filter has the segment, µT."""
    return (
        R[0, 0] * m[0] + R[0, 1] * m[1] + R[0, 2] * m[2],
        R[1, 0] * m[0] + R[1, 1] * m[1] + R[1, 2] * m[2],
        R[2, 0] * m[0] + R[2, 1] * m[1] + R[2, 2] * m[2],
    )


@compiled
def _watch_changes(
    mean: FieldWatch, length: float, dip: float, expected: ExpectedField, tuning: Tuning, dt: float
) -> None:
    """Update means and momentary changes of norm and dip, n and d of (28), by one norm (µT) and dip (rad)."""
    if mean.seconds == 0.0:
        change = tuning.field_change
        mean.norm, mean.dip = length, dip
        mean.error_square = change**2
    mean.seconds += dt
    gain = max(expected.gain, dt / mean.seconds)
    mean.norm += gain * (length - mean.norm)
    mean.dip += gain * (dip - mean.dip)
    mean.norm_change += expected.smoothing_gain * (length / mean.norm - 1.0 - mean.norm_change)
    mean.dip_change += expected.smoothing_gain * (dip - mean.dip - mean.dip_change)


@compiled
def _drift(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> None:
    """Predict a compass over dt (s), equation (30).

    The filter's heading drifts by the error of its gyroscope's bias, about an axis that turns with the
    module.
    """
    compass, R, P, w = segment.compass, segment.R, segment.P, segment.rate
    largest = 0.0  # variance of the bias about the vertical
    for i in range(3):
        for j in range(3):
            largest += R[2, i] * P[3 + i, 3 + j] * R[2, j]
    tilt, keep = tilt_square(segment), math.exp(-math.sqrt(dot(w, w)) * dt)
    compass.misread *= tilt / (tilt + now.density * dt)
    compass.angle += compass.rate * dt
    compass.variance += dt * (2.0 * compass.covariance + dt * compass.rate_variance + now.density)
    compass.covariance = keep * (compass.covariance + dt * compass.rate_variance)
    compass.rate *= keep
    compass.rate_variance = keep * keep * compass.rate_variance + (1.0 - keep * keep) * largest
    if compass.rate_variance > largest:
        compass.covariance *= math.sqrt(largest / compass.rate_variance)
        compass.rate_variance = largest
    compass.variance = min(compass.variance, tuning.unknown_heading**2)


@compiled
def turn_compass(segment: Segment, now: SegmentWork) -> None:
    """Turn a compass by the correction ``now.turn`` of its segment, equation (30a).

    A heading's correction turns it alike. A tilt's turns the field that is seen now; what a compass holds of
    looks that were taken with the same error of the tilt turns with it. ``segment.R`` is that of before.
    """
    compass, m, turned = segment.compass, now.magnetic_field, now.turn[2]
    if compass.misread > 0.0 and is_finite(m):
        before = _seen(segment.R, m)
        x, y, _ = _seen(now.rotation, np.array(before))
        by_field = math.atan2(before[0] * y - before[1] * x, before[0] * x + before[1] * y)
        turned += compass.misread * _within_half_a_turn(by_field - now.turn[2])
    compass.angle += turned
    now.compass_turn = turned


@compiled
def _look(compass: Compass, now: SegmentWork, bent: float, tuning: Tuning, dt: float) -> None:
    """Update a compass by one measurement of the field, equation (31).

    How measurements scatter about what is expected decides how much one is worth, earlier ones too: a place
    that seemed quiet while the module rested in it does not outweigh all that is seen after it was left.
    bent: rad², what an uncertain tilt adds in a field that dips; it counts as far as it is not in the compass
    already.
    """
    if compass.seconds == 0.0:  # what stays off to the same side is as little off at the first look
        compass.angle, compass.covariance, compass.seconds = now.field_off, 0.0, dt
        first = (compass.scatter + bent) * now.disturbance
        compass.variance = min(first, tuning.unknown_heading**2)
        compass.misread = 1.0
        return
    off = _within_half_a_turn(now.field_off - compass.angle)
    compass.seconds += dt
    new = 1.0 - compass.misread
    uncertain = compass.variance + new * new * bent
    weight = max(1.0, abs(off) / math.sqrt(uncertain + compass.scatter) / tuning.huber)
    noise = compass.scatter * tuning.heading_memory_s / dt * weight * now.disturbance
    gain = dt / min(compass.seconds + tuning.compass_s, 3.0 * tuning.compass_s)
    compass.scatter += gain * (max(off * off - uncertain, tuning.compass_least**2) - compass.scatter)
    total = uncertain + noise
    gain = max(compass.variance - compass.misread * new * bent, 0.0) / total
    rate_gain = compass.covariance / total
    compass.angle += gain * off
    compass.misread += gain * new
    compass.rate += rate_gain * off
    compass.rate_variance -= rate_gain * compass.covariance
    kept = (1.0 - gain) * (compass.covariance - rate_gain * compass.variance)
    compass.covariance = kept + gain * rate_gain * noise
    shown = (1.0 - gain) ** 2 * compass.variance + gain**2 * noise
    memory = tuning.heading_memory_s
    compass.variance = max(shown, compass.scatter * memory / (memory + compass.seconds))


@compiled
def _within_half_a_turn(angle: float) -> float:
    """Return the angle, rad, less whole turns."""
    return math.atan2(math.sin(angle), math.cos(angle))


@compiled
def share_headings(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Set ``compass.error`` and ``error_variance`` of each segment, equation (32).

    It is a least-squares compromise over the tree: between all compasses, what the filter knows of headings
    against each other, and what motion has shown so far of unobserved ones.
    """
    links, segments, works = body.segments, state.segments, work.segments
    is_world_shown = shows_world(links, segments)
    _compare(links, segments, works, body.world.is_tree == 1, is_world_shown, tuning)
    weigh_compasses(segments, works, tuning)
    variance = _compass_variance(links, segments, works, tuning)
    unseen = _turned_unseen(segments, works, dt)
    # (32) from leaves to root: what a segment and all beyond it say of its error
    for s in range(len(links) - 1, -1, -1):
        now, p = works[s], links[s].parent
        compass = segments[s].compass
        if compass.seconds > 0.0:
            off = _within_half_a_turn(now.unwrapped - compass.error)
            weight = now.knows / (variance + off * off)
            now.information += weight
            now.information_angle += weight * now.unwrapped
        # (32) without any compass: what hangs together turns by its share
        if variance == 0.0 and not now.is_first and segments[s].heading == UNOBSERVED:
            now.information += 1.0 / give_of(segments[s], tuning)
        if not now.is_first:
            passed = 1.0 / (1.0 + now.apart * now.information)
            against = now.information_angle - now.expected * now.information
            works[p].information += passed * now.information
            works[p].information_angle += passed * against
    # (32) from root to leaves
    for s in range(len(links)):
        now, p, compass = works[s], links[s].parent, segments[s].compass
        total = 1.0 + now.apart * now.information
        now.error_before = compass.error
        if not now.is_first:
            above = segments[p].compass
            compass.error = (above.error + now.expected + now.apart * now.information_angle) / total
            compass.error_variance = now.apart / total + above.error_variance / (total * total)
        elif variance > 0.0 and now.information > 0.0:
            share = _compass_share(now, variance)
            compass.error = now.expected + share * (now.information_angle / now.information - now.expected)
            compass.error_variance = now.apart * (1.0 - share)
        else:
            compass.error = (now.expected + now.apart * now.information_angle) / total
            compass.error_variance = segments[s].P[2, 2]
    if variance > 0.0:
        for root in range(len(links)):
            if links[root].parent < 0:
                _turn_body(links, segments, works, root, is_world_shown, variance, unseen, tuning, dt)


@compiled
def shows_world(links: Records[Link], segments: Records[Segment]) -> bool:
    """Return whether anything but the field has shown, or can show, how the body heads in the world.

    Where nothing does, ``P_33`` is what the segments began with. Each joint that finds a lost heading again
    makes less of it, since a tree does not keep what the two sides of a silent segment had in common.
    """
    is_shown = False
    for s in range(len(links)):
        is_root = links[s].parent < 0 and links[s].heading_observable == 1
        is_shown = is_shown or is_root or segments[s].sun.has_shown == 1
    return is_shown


@compiled
def _compare(
    links: Records[Link],
    segments: Records[Segment],
    works: Records[SegmentWork],
    is_tree: bool,
    is_world_shown: bool,
    tuning: Tuning,
) -> None:
    """Set ``expected``, ``apart`` and ``unwrapped`` of each segment for (32).

    The sums of its compasses are reset. ``expected`` and ``apart`` are mean (rad) and variance (rad²) of the
    heading's error less that of its parent, of a first one in the world, without compasses. ``unwrapped`` is
    the compass's angle within half a turn of what the parent's lets expect.
    """
    started, has_compass, unknown = 0, False, tuning.unknown_heading**2
    for s in range(len(links)):
        started += segments[s].started == STARTED
        has_compass = has_compass or segments[s].compass.seconds > 0.0
    for s in range(len(links)):
        segment, now, p = segments[s], works[s], links[s].parent
        before, now.information, now.information_angle = 0.0, 0.0, 0.0
        now.expected, now.is_first = 0.0, 1 if p < 0 else 0
        if p >= 0:
            before = works[p].unwrapped
            shared = segment.C[2, 2] if is_tree else segments[p].P[2, 2]
            now.apart = max(segment.P[2, 2] + segments[p].P[2, 2] - 2.0 * shared, LEAST_APART)
            # it has kept its own while the parent's was lost, and does not turn with what finds that anew
            is_kept = segment.heading != UNOBSERVED and segments[p].heading == UNOBSERVED
            now.is_first = 1 if is_kept and now.apart > tuning.lost_heading**2 else 0
        if now.is_first:
            now.apart = give_of(segment, tuning)
            if has_compass and not is_world_shown:
                now.apart = 1e3 * unknown
            elif has_compass:
                # each segment began with an unknown heading; joined, they seem to know more
                known = 1.0 / max(segment.P[2, 2], LEAST_APART) - started / unknown
                now.apart = 1.0 / max(known, 1e-3 / unknown)
        if segment.heading == UNOBSERVED:
            _expect_unobserved(segment, now, p >= 0, tuning)
        if has_compass:
            before += now.expected
            now.unwrapped = before + _within_half_a_turn(segment.compass.angle - before)


@compiled
def _expect_unobserved(segment: Segment, now: SegmentWork, has_parent: bool, tuning: Tuning) -> None:
    """Set ``expected`` and ``apart`` by what motion has shown of an unobserved heading.

    That counts only where its two sides agree well enough.
    """
    sums, unknown = segment.heading_sums, tuning.unknown_heading**2
    if has_parent:
        now.apart = unknown
    concentration = agreed(sums, NO_FIELD, tuning)
    now.apart = 1.0 / (1.0 / now.apart + concentration / tuning.heading_density)
    # what is next to nothing is noise, and would turn a body at rest
    share = concentration**2 / (concentration**2 + tuning.heading_noise**2)
    now.expected = -math.atan2(sums.across, sums.along) * share


@compiled
def _doubt(variance: float, tuning: Tuning) -> float:
    """Return by how much less a heading counts that is off by a variance (rad²), 1 / κ_V of (34)."""
    return float(1.0 + variance / tuning.compass_clean**2)


@compiled
def weigh_compasses(segments: Records[Segment], works: Records[SegmentWork], tuning: Tuning) -> None:
    """Set ``knows`` of each segment, k_s of (32): 1 of the surest compass, 0 where there is none.

    One whose module has turned unseen counts for little until it has looked again.
    """
    most = 0.0
    for s in range(len(segments)):
        compass, now = segments[s].compass, works[s]
        now.knows = 0.0
        if compass.seconds > 0.0:
            now.knows = 1.0 / _doubt(compass.variance + compass.tilt_square, tuning)
            most = max(most, now.knows)
    for s in range(len(segments)):
        works[s].knows /= max(most, 1e-12)


@compiled
def _compass_variance(
    links: Records[Link], segments: Records[Segment], works: Records[SegmentWork], tuning: Tuning
) -> float:
    """Return V of (33), the variance of a compass, rad²; 0 if there is none.

    It is what norm and dip let expect, or more where compasses differ that by the motion should not. It is
    the same for all: with weights that change, the mean of compasses that are off differently would wander.
    """
    seen, square, weights, differences = 0.0, 0.0, 0.0, 0.0
    for s in range(len(links)):
        compass, now, p = segments[s].compass, works[s], links[s].parent
        if compass.seconds > 0.0:
            seen += now.knows
            square += now.knows * (compass.variance + compass.offset_square)
            if p >= 0 and segments[p].compass.seconds > 0.0:
                weight = now.knows * works[p].knows / _doubt(now.apart, tuning)
                weights += weight
                differences += weight * (now.unwrapped - now.expected - works[p].unwrapped) ** 2
    if seen == 0.0:
        return 0.0
    return max(square / seen, 0.5 * differences / max(weights, 1.0))


@compiled
def _turned_unseen(segments: Records[Segment], works: Records[SegmentWork], dt: float) -> float:
    """Return the variance, rad², by which the body may have turned in this instant without being seen.

    It is 0 while any module has a rate, or had one until a gap that is bridged, over which the filter adds
    nothing: that one holds the headings of all.
    """
    least = np.inf
    for s in range(len(segments)):
        if segments[s].started == STARTED:
            now = works[s]
            least = min(least, now.density * dt if now.validity < RATE else 0.0)
    return least if least < np.inf else 0.0


@compiled
def _compass_share(now: SegmentWork, variance: float) -> float:
    """Return how much of what is published of a root its compasses say, where the filter says the rest."""
    field = variance + 1.0 / now.information  # the building's field is off for all alike too
    return now.apart / (now.apart + field)


@compiled
def _turn_body(
    links: Records[Link],
    segments: Records[Segment],
    works: Records[SegmentWork],
    root: int,
    is_world_shown: bool,
    variance: float,
    unseen: float,
    tuning: Tuning,
    dt: float,
) -> None:
    """Limit by how much the body of ``root`` turns by its compasses in an instant, equation (34).

    It is what its segments turn by on average, each weighed as its compass is: one that was silent, the root
    too, turns by itself when it is found again. Where the world is shown it is what the surest turns by.
    """
    weights, turned, corrected, surest, least = 0.0, 0.0, 0.0, root, np.inf
    for s in range(root, len(links)):
        if segments[s].started == STARTED and root_of(links, s) == root:
            now = works[s]
            weights += now.knows
            turned += now.knows * _within_half_a_turn(segments[s].compass.error - now.error_before)
            corrected += now.knows * now.compass_turn
            if segments[s].P[2, 2] < least:
                surest, least = s, segments[s].P[2, 2]
    if weights == 0.0:
        return
    compass = segments[root].compass
    turned, corrected = turned / weights, corrected / weights
    if is_world_shown:
        turned = segments[surest].compass.error - works[surest].error_before
    # a correction of the filter turns what is published by the filter's share alone
    wanted = turned - compass.share / _doubt(variance, tuning) * corrected
    compass.share = _compass_share(works[root], variance)
    more = _limited_turn(compass, wanted, variance, unseen, tuning, dt) - wanted
    for s in range(root, len(links)):
        if segments[s].started == STARTED and root_of(links, s) == root:
            segments[s].compass.error += more


@compiled
def _limited_turn(
    compass: Compass, wanted: float, variance: float, unseen: float, tuning: Tuning, dt: float
) -> float:
    """Return what of the turn that is wanted (rad) a body makes at once, equation (34).

    It is all of it while headings of the body are being found. Else it is what compasses tell of what the
    body has lately turned unseen, and beyond that no faster than the gyroscope may drift, and hardly at all
    where the field is wrong. compass: of the root. variance: of compasses, rad². unseen: rad², of what may
    be new in this instant.
    """
    compass.settled_s += dt
    kept = math.exp(-dt / tuning.heading_memory_s)
    compass.unseen_square = min(kept * compass.unseen_square + unseen, tuning.unknown_heading**2)
    compass.unseen_turned *= kept
    if compass.settled_s <= tuning.compass_settles_s:
        return wanted
    # (34a) τ_u
    share = compass.unseen_square / max(compass.unseen_square + variance, LEAST_APART)
    at_once = share * (wanted + compass.unseen_turned) - compass.unseen_turned
    if at_once * wanted < 0.0:
        at_once = 0.0
    drift = (math.sqrt(compass.rate_variance) + abs(wanted) / tuning.compass_finds_s) * dt
    largest = abs(at_once) + drift / _doubt(variance, tuning)
    turn = min(max(wanted, -largest), largest)
    compass.unseen_turned += math.copysign(min(abs(turn), abs(at_once)), turn)
    return turn
