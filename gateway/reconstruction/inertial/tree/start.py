"""How a segment starts, and headings that nothing has shown yet. Compiled.

While a segment's heading against its parent is unobserved, a linearised filter may converge to anything. But
the horizontal accelerations of the joint seen from both sides are the same vector up to one angle ψ, whose
posterior is von Mises: ``exp(κ cos(ψ − ψ₀))`` with ``κ e^{iψ₀} = Σ u_p ū / σ²`` (horizontal parts as complex
numbers). Once κ is large enough both sides are turned apart by ψ₀ and the filter takes over.
Until then the field, if there is one, leads the heading as a compass does; it counts as evidence of its own.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.geometry.vectors import dot, is_finite, norm
from gateway.reconstruction.inertial.tree.state import (
    Body,
    Compass,
    Heading,
    HeadingSums,
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

OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value
NOT_STARTED, STARTED = Started.NO.value, Started.YES.value
FORCE, NOTHING = Validity.FORCE.value, Validity.NOTHING.value


# Start


@compiled
def start_segments(body: Body, state: State, tuning: Tuning, work: Work) -> None:
    """Start segments at their first sample of specific force, section 14.

    Until then their samples do not count.
    """
    links, segments, works = body.segments, state.segments, work.segments
    for s in range(len(links)):
        segment, now = segments[s], works[s]
        if segment.started != STARTED:
            if now.validity == FORCE:
                _start(segment, links[s], now, body.world, tuning)
                if segment.started == STARTED:
                    _part_from_children(links, segments, s)
            if segment.started != STARTED:
                now.validity = NOTHING


@compiled
def root_of(links: Records[Link], s: int) -> int:
    """Return the root of the tree in which segment s is."""
    while links[s].parent >= 0:
        s = links[s].parent
    return s


@compiled
def _start(segment: Segment, link: Link, now: SegmentWork, world: World, tuning: Tuning) -> None:
    """Start a segment from its first sample, equations (62) to (65).

    It is level by the specific force and faces as the field says. Without a usable field the heading is
    arbitrary. If the two directions define no orientation the segment does not start.
    """
    f, w, m = now.specific_force, now.angular_rate, now.magnetic_field
    secondary, secondary_w = np.zeros(3), np.zeros(3)
    if world.uses_field and is_finite(m):
        for i in range(3):
            secondary[i], secondary_w[i] = m[i], world.magnetic_field[i]
    else:
        # of x and y the axis that is further from vertical: near it the heading would be ill-defined
        secondary[int(abs(f[0]) > abs(f[1]))] = 1.0
        secondary_w[1] = 1.0
    # (62) R f ∥ −g, R m in the half-plane of h
    R = rotation_matrix.from_two_vectors(f, secondary, world.at_rest, secondary_w)
    if not is_finite(R[0]):
        return
    rotation_matrix.copy_into(segment.R, R)
    # (64) a_0²
    moved = start_acceleration(world.gravity, f, w, tuning)
    # (63) σ_t0² + a_0² / ‖g‖²
    tilt = tuning.start_tilt**2 + moved / dot(world.gravity, world.gravity)
    _start_covariance(segment, min(tilt, tuning.unknown_heading**2), tuning)
    segment.started = STARTED
    segment.heading = UNOBSERVED if link.heading_observable else OBSERVED
    segment.silent_s, segment.averages.seconds, segment.velocity.waits_s = 0.0, 0.0, math.inf
    segment.joint_nis, segment.bend_square = 1.0, np.nan
    segment.velocity.square = starting_speed_square(moved, tuning)
    segment.felt_square = tuning.start_tilt**2 * dot(world.gravity, world.gravity)
    _start_watches(segment)
    for i in range(3):
        segment.bias[i], segment.rate[i], segment.rate_slope[i] = 0.0, w[i], np.nan
        # means of one sample: begun at zero, gravity alone would be a change for seconds
        segment.zero_rate.rate[i], segment.zero_rate.force[i] = w[i], f[i]


@compiled
def _part_from_children(links: Records[Link], segments: Records[Segment], s: int) -> None:
    """Forget what segments have in common with their parent s, which starts with errors of its own.

    Kept beside a P that is new, such a C would be no covariance.
    """
    for c in range(s + 1, len(links)):
        if links[c].parent == s:
            segments[c].C[...] = 0.0


@compiled
def _start_covariance(segment: Segment, tilt: float, tuning: Tuning) -> None:
    """Set P and C of a segment, and its lever arms' covariance, to those of a start, (63).

    tilt: variance, rad².
    """
    arms = segment.arms
    for i in range(6):
        for j in range(6):
            segment.P[i, j], segment.C[i, j], arms.covariance[i, j] = 0.0, 0.0, 0.0
    for i in range(3):
        segment.P[i, i] = tilt
        segment.P[3 + i, 3 + i] = tuning.bias**2
    segment.P[2, 2], segment.defined_square = tuning.unknown_heading**2, 0.0
    # a module that comes back may sit elsewhere
    for i in range(6):
        arms.covariance[i, i] = tuning.lever_arm_offset**2
    arms.since_s = np.inf
    start_compass(segment.compass, tuning)


@compiled
def start_compass(compass: Compass, tuning: Tuning) -> None:
    """Reset a compass to an unknown error of the heading."""
    compass.angle, compass.rate, compass.covariance, compass.seconds = 0.0, 0.0, 0.0, 0.0
    compass.misread, compass.tilt_square = 0.0, 0.0
    compass.variance, compass.rate_variance = tuning.unknown_heading**2, tuning.bias**2
    compass.scatter, compass.offset_square = tuning.compass_scatter**2, tuning.start_heading**2
    compass.error, compass.error_variance, compass.settled_s = 0.0, tuning.unknown_heading**2, 0.0
    compass.share, compass.unseen_square, compass.unseen_turned = 0.0, 0.0, 0.0


@compiled
def _start_watches(segment: Segment) -> None:
    """Reset all statistics of a module's samples."""
    seen, heading, watch = segment.corrections, segment.heading_sums, segment.zero_rate
    for i in range(2):
        seen.sums[i], seen.sums_before[i] = 0.0, 0.0
    seen.seconds, seen.product, seen.square, seen.gyroscope, seen.rows = 0.0, 0.0, 0.0, 0.0, 0.0
    forget_evidence(heading)
    watch.rate_square, watch.rate_lasting, watch.force_lasting = 0.0, 0.0, 0.0
    watch.still_s, segment.aids_s = 0.0, 0.0
    for i in range(3):
        watch.off_rate[i], watch.off_force[i] = 0.0, 0.0


@compiled
def start_acceleration(gravity: FloatArray, f: FloatArray, w: FloatArray, tuning: Tuning) -> float:
    """Return a_0² of (64), (m/s²)²: square of the acceleration that a module may have at its first sample.

    It is by how much the module feels more or less than gravity, and by how it turns at the end of
    ``start_arm``. f: specific force, m/s², w: angular rate, rad/s; (3,).
    """
    turning = dot(w, w) * tuning.start_arm
    square: float = (norm(f) - norm(gravity)) ** 2 + turning * turning
    return square


@compiled
def starting_speed_square(moved: float, tuning: Tuning) -> float:
    """Return the mean square speed, (m/s)², that the acceleration of a first sample lets expect, (65).

    moved: a_0² of (64), (m/s²)².
    """
    return float(max(tuning.unaided_speed**2, tuning.starting_share * moved * tuning.unaided_memory_s**2))


# Headings that nothing has shown yet


LEAST_GIVE = 1e-12
"""rad²."""
NO_FIELD = (0.0, 0.0, 0.0)
"""What compasses add to the evidence of motion where there are none."""
GRAVITY = 9.81


@compiled
def tilt_square(segment: Segment) -> float:
    """Return the variance of a component of a segment's tilt, rad²."""
    return float(0.5 * (segment.P[0, 0] + segment.P[1, 1]))


@compiled
def tilt_spread(segment: Segment, tuning: Tuning, interval_s: float) -> float:
    """Return the last term of (54)'s denominator, (m/s²)².

    It is what an uncertain tilt adds to the variance of a row's horizontal part. A tilt error stays for
    ``tilt_memory_s``, so rows every ``interval_s`` do not average it out. At the start it is all there is:
    two segments at rest that are tilted alike would otherwise seem to show their headings.
    """
    variance: float = GRAVITY**2 * tilt_square(segment) * max(1.0, tuning.tilt_memory_s / interval_s)
    return variance


@compiled
def second_order_variance(
    child: Segment, parent: Segment, u: FloatArray, tuning: Tuning, interval_s: float
) -> float:
    """Return ε_s of (21), (m/s²)²: the variance of what a joint's linearised row leaves out.

    u: (3,) at the joint, m/s². interval_s: time between rows. About the mean of both sides a row leaves out
    ``½ (δ_s × δ_p) × u``: nothing where one side is known, however wrong the other is. Where both tilts are
    as uncertain as at a start in motion that is larger than the noise, and lasts as long as the tilts: taken
    for linear, a few rows would make wrong tilts certain.
    """
    of_child = tilt_square(child)
    of_parent = tilt_square(parent)
    return float(4.0 * of_child * of_parent * dot(u, u) * max(1.0, tuning.tilt_memory_s / interval_s))


@compiled
def gather_heading(
    sums: HeadingSums,
    u: FloatArray,
    y: FloatArray,
    variance: float,
    share: float,
    tuning: Tuning,
    interval_s: float,
) -> None:
    """Add one pair of vectors to the sums of (54) and (55).

    u: (3,) of the segment, y: (3,) what it must agree with; world. variance: of the pair's components,
    (m/s²)². share: of it that one pair is off by; the rest is for errors that pairs have in common.
    interval_s: time since the pair before.
    """
    decay = math.exp(-interval_s / tuning.heading_forgets_s)
    # (54) κ e^{iψ_0}: real part …
    sums.along = sums.along * decay + (y[0] * u[0] + y[1] * u[1]) / variance
    # (54) … imaginary part …
    sums.across = sums.across * decay + (y[1] * u[0] - y[0] * u[1]) / variance
    # (55) … and how large κ could be
    length = math.hypot(u[0], u[1]) * math.hypot(y[0], y[1])
    sums.length = sums.length * decay + length / variance
    # … and of what does not agree, beside what is expected
    both = u[0] * u[0] + u[1] * u[1] + y[0] * y[0] + y[1] * y[1]
    sums.square = sums.square * decay + both / variance
    sums.expected = sums.expected * decay + 2.0 * share
    sums.seconds += interval_s


@compiled
def shown_heading(sums: HeadingSums, tuning: Tuning) -> tuple[float, float]:
    """Return variance (rad²) and angle (rad) of a heading that motion has shown, (55); 0: not yet."""
    return _shown(sums, NO_FIELD, tuning)


@compiled
def shown_between(segment: Segment, parent: Segment, tuning: Tuning) -> tuple[float, float]:
    """Return variance (rad²) and angle (rad) of a heading against the parent, (55), (56); 0: not yet.

    Where both have seen the field, their compasses count beside the motion.
    """
    by_field, compass, above = NO_FIELD, segment.compass, parent.compass
    if compass.seconds > 0.0 and above.seconds > 0.0:
        off = compass.angle - above.angle
        variance = compass.variance + compass.offset_square + above.variance + above.offset_square
        length = tuning.heading_density / variance
        by_field = length * math.cos(off), -length * math.sin(off), length
    return _shown(segment.heading_sums, by_field, tuning)


@compiled
def agreed(sums: HeadingSums, by_field: Three, tuning: Tuning) -> float:
    """Return κ of (54), less where the two sides' horizontal accelerations do not agree, (55).

    by_field: what compasses add to ``along``, ``across`` and ``length``, (56).
    """
    length = sums.length + by_field[2]
    if length == 0.0 or sums.expected == 0.0:
        return 0.0
    concentration = math.hypot(sums.along + by_field[0], sums.across + by_field[1])
    agreement = concentration / length / tuning.heading_coherence
    left = (sums.square + 2.0 * (by_field[2] - concentration)) / sums.expected
    return float(concentration * min(agreement, 1.0) ** 6 / max(left, 1.0) ** 2)


@compiled
def _shown(sums: HeadingSums, by_field: Three, tuning: Tuning) -> tuple[float, float]:
    """Return variance (rad²) and angle (rad) of the heading by the sums of (54), (55); 0: not yet."""
    concentration = agreed(sums, by_field, tuning)
    if sums.seconds < tuning.heading_time_s or concentration < tuning.heading_evidence:
        return 0.0, 0.0
    angle = math.atan2(sums.across + by_field[1], sums.along + by_field[0])
    return tuning.heading_density / concentration, angle


@compiled
def is_apart(segment: Segment, parent: Segment, has_parent: bool, tuning: Tuning) -> bool:
    """Return whether the heading of a segment is lost, equation (57).

    Against its parent, if it has one, else in the world.
    """
    variance = segment.P[2, 2]
    if has_parent:
        variance += parent.P[2, 2] - 2.0 * segment.C[2, 2]
    return bool(variance > tuning.lost_heading**2)


@compiled
def _is_left_behind(segment: Segment, parent: Segment, above: Link, tuning: Tuning) -> bool:
    """Return whether only the parent's heading is lost: that is found anew, and the segment keeps its own."""
    if segment.P[2, 2] > tuning.lost_heading**2:
        return False
    is_silent = parent.started != STARTED and above.heading_observable == 1
    return bool(parent.heading == UNOBSERVED or is_silent)


@compiled
def lose_headings(links: Records[Link], segments: Records[Segment], tuning: Tuning) -> None:
    """Mark headings as unobserved that the filter itself no longer knows, (57).

    So it is after a gyroscope was saturated. A linearised filter would not find them back; the next motion
    shows them, in closed form.
    """
    for s in range(len(links)):
        p, segment = links[s].parent, segments[s]
        parent, above = segments[max(p, 0)], links[max(p, 0)]
        is_observable = links[s].heading_observable == 1
        if segment.heading == UNOBSERVED or not is_observable or segment.started != STARTED:
            continue
        is_left_behind = p >= 0 and _is_left_behind(segment, parent, above, tuning)
        if is_apart(segment, parent, p >= 0, tuning) and not is_left_behind:
            segment.heading = UNOBSERVED
            forget_evidence(segment.heading_sums)


@compiled
def forget_evidence(sums: HeadingSums) -> None:
    """Reset what motion has shown of a heading."""
    sums.along, sums.across, sums.length = 0.0, 0.0, 0.0
    sums.square, sums.expected, sums.seconds = 0.0, 0.0, 0.0


@compiled
def is_contradicted(sums: HeadingSums, tuning: Tuning) -> bool:
    """Return whether motion clearly shows that a heading that was taken as shown is far off."""
    shown = agreed(sums, NO_FIELD, tuning)
    is_clear = shown > tuning.heading_contradiction * tuning.heading_evidence
    is_far_off = sums.along < math.cos(tuning.heading_far_off) * math.hypot(sums.along, sums.across)
    return bool(is_clear and is_far_off)


@compiled
def take_back_heading(body: Body, state: State, tuning: Tuning, work: Work, s: int) -> None:
    """Mark the heading of segment s as unobserved again, since motion contradicts it, and keep the evidence.

    The headings of one side become unknown against those of the other: of that which gives way more.
    """
    links, segments, works = body.segments, state.segments, work.segments
    root, more = root_of(links, s), tuning.unknown_heading**2
    segments[s].heading = UNOBSERVED
    beyond_gives, before_gives = _gives(body, state, tuning, work, s, root)
    is_beyond = links[s].parent < 0 or beyond_gives >= before_gives
    for c in range(root, len(links)):
        now, p = works[c], links[c].parent
        if now.is_beyond if is_beyond else now.is_before:
            segments[c].P[2, 2] += more
            if p >= 0 and (works[p].is_beyond if is_beyond else works[p].is_before):
                segments[c].C[2, 2] += more


@compiled
def turn_heading_sums(sums: HeadingSums, angle: float) -> None:
    """Turn the evidence as its segment was turned, by ``angle`` (rad) about the vertical.

    For a turn of its parent the angle is negative.
    """
    if angle == 0.0:
        return
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y = sums.along, sums.across
    sums.along, sums.across = x * cosine + y * sine, y * cosine - x * sine


@compiled
def give_of(segment: Segment, tuning: Tuning) -> float:
    """Return how easily a segment turns in the world beside what it is joined to: P_33² over σ_max², rad².

    The square is there so that one module that comes back does not turn the sixteen that have stayed.
    """
    return float(segment.P[2, 2] ** 2 / tuning.unknown_heading**2 + LEAST_GIVE)


@compiled
def turn_beyond(body: Body, state: State, tuning: Tuning, work: Work, s: int, angle: float) -> None:
    """Turn segment s and all beyond it against all before it, by ``angle`` (rad).

    Each side turns by its share of what both give way. The stiffest segment of a side stands for it: a
    segment that comes back amid a body does not turn the body. The side beyond ends where a segment has kept
    its own heading while that of s was lost; a root turns with all of them.
    """
    links, segments, works = body.segments, state.segments, work.segments
    root, first = root_of(links, s), links[s].parent
    beyond_gives, before_gives = _gives(body, state, tuning, work, s, root)
    beyond = 1.0 if first < 0 else beyond_gives / (beyond_gives + before_gives)
    if first < 0 or max(beyond, 1.0 - beyond) < tuning.lone_share:
        segments[root].compass.settled_s = 0.0
    for c in range(root, len(links)):
        now = works[c]
        if now.is_beyond:
            now.turn[2] += beyond * angle
        elif now.is_before:
            now.turn[2] -= (1.0 - beyond) * angle


@compiled
def _gives(body: Body, state: State, tuning: Tuning, work: Work, s: int, root: int) -> tuple[float, float]:
    """Return how easily the side beyond the joint of s turns, and that before it; mark which is which."""
    segments, works = state.segments, work.segments
    _mark_sides(body, state, tuning, work, s, root)
    beyond, before = np.inf, np.inf
    for c in range(root, len(segments)):
        give = give_of(segments[c], tuning)
        beyond = min(beyond, give) if works[c].is_beyond else beyond
        before = min(before, give) if works[c].is_before else before
    return beyond, before


@compiled
def _mark_sides(body: Body, state: State, tuning: Tuning, work: Work, s: int, root: int) -> None:
    """Set ``is_beyond`` and ``is_before`` in the tree of ``root``.

    They are the segments that turn with s, and with the parent of s.
    """
    links, segments, works = body.segments, state.segments, work.segments
    for c in range(root, len(links)):
        now, p = works[c], links[c].parent
        now.is_beyond, now.is_before = 1 if c == s else 0, 1 if c == root and root < s else 0
        if p >= s and works[p].is_beyond:
            is_kept = segments[c].heading != UNOBSERVED and is_apart(segments[c], segments[p], True, tuning)
            now.is_beyond = 0 if is_kept else 1
        if p >= root and works[p].is_before and not now.is_beyond:
            now.is_before = 1
