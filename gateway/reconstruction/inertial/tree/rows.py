"""The observations of the tree filter that need no device: joints, standing, rest, bounded speeds. Compiled.

A world vector ``u = R̂ s`` is truly ``exp(δ) R̂ s ≈ u − [u]× δ``. Two sides that must agree therefore give
``u − u_p = [m]× (δ − δ_p)`` with their mean ``m = (u + u_p) / 2``, and a known vector ``y``:
``u − y = [y]× δ``.
With u and u_p in their own places noise would seem to show a turn of both together, which no joint shows.
"""

from __future__ import annotations

import math

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, norm, skew
from gateway.reconstruction.inertial.tree.lever_arms import (
    is_due,
    learn_joint_arms,
    own_covariance,
    relative_covariance,
    spread,
)
from gateway.reconstruction.inertial.tree.prediction import (
    FIRST_SAMPLE_S,
    felt_into,
    is_short_gap,
    row_inflation,
)
from gateway.reconstruction.inertial.tree.start import (
    forget_evidence,
    gather_heading,
    is_apart,
    is_contradicted,
    second_order_variance,
    shown_between,
    take_back_heading,
    tilt_spread,
    turn_beyond,
)
from gateway.reconstruction.inertial.tree.state import (
    Body,
    Heading,
    Joint,
    Learning,
    Segment,
    SegmentWork,
    State,
    Validity,
    Work,
    World,
    ZeroRateWatch,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import Three, add_edge, add_joint, add_known, add_own

OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value
FORCE, NOTHING = Validity.FORCE.value, Validity.NOTHING.value
LEAST_COSINE = -0.9
"""Of what is to be turned at once: of a vector that points the other way no axis is known."""
SECOND_ORDER = 0.375
"""Of the square of an angle's variance: mean square of its second order, as a share of the vector."""


@compiled
def known_row(
    now: SegmentWork, segment: Segment, u: FloatArray, y: FloatArray, variance: float, tuning: Tuning
) -> None:
    """Add the row of a vector u (3,) of the segment that must equal y (3,) in the world, (14) and (14a).

    variance: of each component, before outliers are weighed down by (17).
    """
    residual = u[0] - y[0], u[1] - y[1], u[2] - y[2]
    uncertain = spread(y[0], y[1], y[2], own_covariance(segment))
    longer = _whole_turn(u, y, uncertain, variance)
    variance *= _huber(uncertain, residual, variance, tuning.huber)
    turn = longer * residual[0], longer * residual[1], longer * residual[2]
    add_known(now.evidence, (y[0], y[1], y[2]), turn, longer * longer * variance)


@compiled
def _whole_turn(u: FloatArray, y: FloatArray, uncertain: Three, variance: float) -> float:
    """Return ζ of (14a), by which the residual of (14) shows ``2 tan(θ/2)`` and not ``sin θ``.

    θ is the angle between u and y (3,), as far as it is a turn: by the share of what the orientation makes
    uncertain, (3,), in all that is.
    """
    off = uncertain[0] + uncertain[1] + uncertain[2]
    lengths = norm(u) * norm(y)
    cosine = max(dot(u, y) / lengths, LEAST_COSINE) if lengths > 0.0 else 1.0
    return float(1.0 + off / (off + 3.0 * variance) * (2.0 / (1.0 + cosine) - 1.0))


@compiled
def unobserved_known_row(now: SegmentWork, u: FloatArray, y: FloatArray, variance: float) -> None:
    """Add the row (14) of a segment whose heading is unobserved: section 12, below equation (56).

    Only the vertical parts of u and y (3,) and the lengths of their horizontal parts count.
    """
    residual = u[0] - y[0], u[1] - y[1], u[2] - y[2]
    H, H_y = skew(u), skew(y)
    wide = variance + _horizontal_square(u) + _horizontal_square(y)
    for i in range(3):
        H[i, 2] = 0.0
        for j in range(2):
            H[i, j] = 0.5 * (H[i, j] + H_y[i, j])
        add_own(now.evidence, H[i], residual[i], wide if i < 2 else variance)


@compiled
def _huber(uncertain: Three, residual: Three, variance: float, limit: float) -> float:
    """Return the factor of (17) on the variance: 1 within ``limit`` standard deviations of the innovation.

    uncertain: (3,) variances that the orientation gives to the residual's components.
    """
    square = 0.0
    for i in range(3):
        square += residual[i] ** 2 / (uncertain[i] + variance)
    return max(1.0, math.sqrt(square) / limit)


@compiled
def _horizontal_square(v: FloatArray | Three) -> float:
    square: float = v[0] * v[0] + v[1] * v[1]
    return square


@compiled
def row_variance(tuning: Tuning, motion: float, interval_s: float) -> float:
    """Return the variance of a row of accelerations, (m/s²)², equations (15) and (19).

    motion: ‖[ω̇, ω]‖, 1/s², of a joint the root of the sum of both squares. interval_s: time between rows.
    """
    variance = tuning.specific_force**2 + (tuning.lever_arm * motion) ** 2
    return variance * tuning.row_memory_s / interval_s


# Joints


@compiled
def joint_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Add the rows of all joints and set ``U`` of every segment, section 6.

    Segments whose joints are seen from both sides form one chain. In one filter over the whole tree a foot or
    a device anywhere aids its chain; in ``outward`` only one on the chain's root does.
    """
    settled_s = tuning.settled * tuning.smoothing_s
    links, segments, works = body.segments, state.segments, work.segments
    for s in range(len(links)):
        link, segment, now = links[s], segments[s], works[s]
        p, now.chain = link.parent, s
        # (18) u_s
        felt_into(now.U, segment.averages.force, now.K, link.to_joint, segment.arms.error, 0)
        if p < 0 or not _counts(segment, now, tuning) or not _counts(segments[p], works[p], tuning):
            continue
        if segment.joint_nis < tuning.loose_nis:  # else what aids the one does not aid the other
            # also while its row waits for the averages: after a gap nothing has changed
            now.chain = works[p].chain
        if body.world.is_tree:
            first = works[now.chain]
            first.aided = max(first.aided, now.aided)
        if now.validity < FORCE or works[p].validity < FORCE:
            continue
        if segment.averages.seconds < settled_s or segments[p].averages.seconds < settled_s:
            continue
        # the averages of both have been filled for 3 τ
        joint = Joint(link, segment, segments[p], now, works[p])
        if _joint_row(joint, work.shared.learning, tuning, dt):
            _settle_heading(body, state, tuning, work, s)
        elif segment.heading == OBSERVED and is_contradicted(segment.heading_sums, tuning):
            take_back_heading(body, state, tuning, work, s)


@compiled
def _counts(segment: Segment, now: SegmentWork, tuning: Tuning) -> bool:
    """Return whether a segment belongs to its chain: it has a sample, or lost one only a moment ago."""
    return bool(now.validity == FORCE or is_short_gap(segment, now, tuning))


@compiled
def _joint_row(joint: Joint, learning: Learning, tuning: Tuning, dt: float) -> bool:
    """Add the row of one joint; return whether the child's heading has just been shown.

    If it has, no row is added. Changes ``U`` of the child where it corrects lever arms.
    """
    _, child, parent, now, above = joint
    _see_joint(joint, tuning, dt)
    is_lost = child.heading == UNOBSERVED
    if not is_lost and parent.heading == UNOBSERVED and is_apart(child, parent, True, tuning):
        # the parent has begun anew beside a segment that has not: this shows the parent's heading
        is_lost = True
        uncertain = now.row_variance + tilt_spread(child, tuning, dt) + tilt_spread(parent, tuning, dt)
        gather_heading(parent.heading_sums, now.u_parent, now.u, uncertain, tuning, dt)
    elif is_lost:
        uncertain = now.row_variance + tilt_spread(child, tuning, dt) + tilt_spread(parent, tuning, dt)
        gather_heading(child.heading_sums, now.u, now.u_parent, uncertain, tuning, dt)
        if shown_between(child, parent, tuning)[0] > 0.0:
            return True
    elif now.turn[2] != 0.0 or above.turn[2] != 0.0:
        return False  # this instant's averages are those before the turn
    else:
        uncertain = now.row_variance + tilt_spread(child, tuning, dt) + tilt_spread(parent, tuning, dt)
        gather_heading(child.heading_sums, now.u, now.u_parent, uncertain, tuning, dt)
        _learn_arms(joint, learning, tuning, dt)
    if not is_lost:
        # (20) … (1 + 2 max(χ_s, χ_p))
        now.row_variance *= row_inflation(child, parent, tuning)
    joint_row(joint, is_lost, tuning, dt)
    return False


@compiled
def _settle_heading(body: Body, state: State, tuning: Tuning, work: Work, s: int) -> None:
    """Turn segment s to the heading against its parent that motion has shown, equation (55).

    The relative heading is given the variance of that evidence.
    """
    p = body.segments[s].parent
    variance, angle = shown_between(state.segments[s], state.segments[p], tuning)
    state.segments[s].heading = OBSERVED
    forget_evidence(state.segments[s].heading_sums)
    add_edge(work.segments[s].evidence, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), 0.0, variance)
    turn_beyond(body, state, tuning, work, s, angle)


@compiled
def _see_joint(joint: Joint, tuning: Tuning, dt: float) -> None:
    """Set ``u``, ``u_parent`` and ``row_variance`` of a joint, equations (18) to (21) and (23)."""
    link, child, parent, now, above = joint
    # (18) u_p
    felt_into(now.u_parent, parent.averages.force, above.K, link.from_parent, child.arms.error, 3)
    # (19) μ² = μ_s² + μ_p²
    moved = math.sqrt(now.motion**2 + above.motion**2)
    variance = row_variance(tuning, moved, dt)
    for i in range(3):
        now.u[i] = now.U[i]
    if link.is_bridged:
        for i in range(3):
            for j in range(3):
                # (23) u_s − K_s r_b
                now.u[i] -= now.K[i, j] * link.beyond[j]
        # (23) v_1 + (σ_b μ)²
        variance += (link.slack * moved) ** 2 * tuning.row_memory_s / dt
    # (20) … + ρ_s + ρ_p + ε_s
    variance += child.vibration.square + parent.vibration.square
    now.row_variance = variance + second_order_variance(child, parent, now.u, tuning, dt)
    if child.heading == OBSERVED and parent.heading == OBSERVED:
        now.row_variance += _heading_variance(joint, tuning, dt)


@compiled
def _heading_variance(joint: Joint, tuning: Tuning, dt: float) -> float:
    """Return the heading's part of (21), (m/s²)².

    It is the mean square of ``½ ψ² u``, which a linearised row leaves out of a relative heading ψ.
    """
    _, child, parent, now, _ = joint
    apart = child.P[2, 2] + parent.P[2, 2] - 2.0 * child.C[2, 2]
    square = 0.5 * (_horizontal_square(now.u) + _horizontal_square(now.u_parent))
    return float(SECOND_ORDER * apart * apart * square * max(1.0, tuning.tilt_memory_s / dt))


@compiled
def _learn_arms(joint: Joint, learning: Learning, tuning: Tuning, dt: float) -> None:
    """Learn the joint's lever arms when they are due; add their uncertainty to its row.

    Equations (20) and (46).
    """
    child, now = joint.child, joint.now
    if is_due(child, tuning, dt):
        learning.at_once = now.row_variance * dt / tuning.row_memory_s
        learn_joint_arms(joint, learning, tuning, dt)
        if not joint.link.is_bridged:
            for i in range(3):
                now.U[i] = now.u[i]
    # (20) … + α_s max(1, 1 s / Δt)
    now.row_variance += child.arms.row_variance * max(1.0, tuning.tilt_memory_s / dt)


@compiled
def joint_row(joint: Joint, is_unobserved: bool, tuning: Tuning, dt: float) -> None:
    """Add the row that ``u`` and ``u_parent`` of a joint agree, equations (13), (17) and (22).

    Its variance is ``row_variance``, raised by the joint's NIS and where it is an outlier. A joint that does
    not fit adds none. dt: time between rows, s. is_unobserved: the heading of one segment against the other
    is unknown.
    """
    _, child, parent, now, _ = joint
    u, u_p, variance = now.u, now.u_parent, now.row_variance
    residual = u[0] - u_p[0], u[1] - u_p[1], u[2] - u_p[2]
    middle = 0.5 * (u[0] + u_p[0]), 0.5 * (u[1] + u_p[1]), 0.5 * (u[2] + u_p[2])
    # v_1 with what lasts: outliers are judged by one row
    at_once = variance * min(1.0, dt / tuning.row_memory_s)
    # (16) diagonal of S
    off = spread(middle[0], middle[1], middle[2], relative_covariance(child, parent))
    nis = _nis(off, residual, at_once, 2 if is_unobserved else 0)
    # (22) N_s; a joint of N_s ≥ 9 counts for nothing
    inflation = _watch_joint(child, nis, tuning, dt)
    if inflation >= tuning.loose_nis:
        return
    variance *= inflation
    if is_unobserved:
        tilt = 0.5 * max(child.P[0, 0] + child.P[1, 1], parent.P[0, 0] + parent.P[1, 1])
        variance += SECOND_ORDER * tilt * tilt * dot(u, u) * max(1.0, tuning.tilt_memory_s / dt)
        _unobserved_joint_row(now, residual, variance)
        return
    variance *= _huber(off, residual, inflation * at_once, tuning.huber)
    # (13) u_s − u_p = [m̄]× (δ_s − δ_p)
    add_joint(now.evidence, middle, residual, variance)


@compiled
def _unobserved_joint_row(now: SegmentWork, residual: Three, variance: float) -> None:
    """Add the row (13) where the heading against the parent is unknown.

    Of the horizontal parts only the lengths count.
    """
    u, u_p = now.u, now.u_parent
    H, H_p = skew(u), skew(u_p)
    wide = variance + _horizontal_square(u) + _horizontal_square(u_p)
    for i in range(3):
        H[i, 2], H_p[i, 2] = 0.0, 0.0
        for j in range(2):
            H_p[i, j] *= -1.0
        add_edge(now.evidence, H[i], H_p[i], residual[i], wide if i < 2 else variance)


@compiled
def _nis(uncertain: Three, residual: Three, variance: float, first: int) -> float:
    """Return the normalised innovation squared of (22).

    uncertain: (3,) variances that the orientations give. variance: of each component of the row. first: first
    component that is compared; 2 where the horizontal ones cannot be.
    """
    square, expected = 0.0, 0.0
    for i in range(first, 3):
        square += residual[i] ** 2
        expected += uncertain[i] + variance
    return square / expected


@compiled
def _watch_joint(child: Segment, nis: float, tuning: Tuning, dt: float) -> float:
    """Update N_s of (22) by one NIS; return max(1, N_s) of (20).

    Modules that are worn otherwise than the rig says disagree all the time. When N_s reaches ``loose_nis``,
    what the joint has shown is taken back: the segment becomes as uncertain as at its start, and relies on
    its own module until the joint fits again.
    """
    seen, before = min(nis, tuning.largest_nis), child.joint_nis
    # (22)
    child.joint_nis += (1.0 - math.exp(-dt / tuning.joint_nis_memory_s)) * (seen - before)
    if before < tuning.loose_nis <= child.joint_nis:
        for i in range(3):
            # what it has shown is taken back: the uncertainty of a start
            child.P[i, i] += tuning.start_heading**2 if i == 2 else tuning.start_tilt**2
        child.unaided_square = max(
            child.unaided_square, (tuning.unaided_speed / tuning.unaided_window_s) ** 2
        )
    inflation: float = max(1.0, child.joint_nis)
    return inflation


# Zero rate


@compiled
def zero_rate_rows(state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Add zero-rate rows for all segments that have not turned for a while, section 9."""
    gain = 1.0 - math.exp(-dt / tuning.zero_rate_window_s)
    segments, works = state.segments, work.segments
    for s in range(len(works)):
        segment, now = segments[s], works[s]
        if now.validity > NOTHING and watch_zero_rate(segment.zero_rate, now, tuning, gain, dt):
            zero_rate_row(now, segment, tuning, dt)


@compiled
def watch_zero_rate(watch: ZeroRateWatch, now: SegmentWork, tuning: Tuning, gain: float, dt: float) -> bool:
    """Return whether a segment has not turned for a while.

    ``watch.rate`` then is the gyroscope's bias, rad/s. gain: of a low-pass of ``zero_rate_window_s`` over dt
    (s).
    """
    rate_change, force_change = 0.0, 0.0
    for i in range(3):
        off_rate, off_force = now.angular_rate[i] - watch.rate[i], now.specific_force[i] - watch.force[i]
        rate_change += off_rate * off_rate
        force_change += off_force * off_force
        watch.rate[i] += gain * off_rate
        watch.force[i] += gain * off_force
    watch.rate_square += gain * (rate_change - watch.rate_square)
    watch.force_square += gain * (force_change - watch.force_square)
    is_still = (
        watch.rate_square < tuning.zero_rate_change**2
        and watch.force_square < tuning.zero_rate_force_change**2
    )
    is_still = is_still and dot(watch.rate, watch.rate) < tuning.largest_bias**2
    watch.still_s = watch.still_s + dt if is_still else 0.0
    return bool(watch.still_s > tuning.zero_rate_s)


@compiled
def zero_rate_row(now: SegmentWork, segment: Segment, tuning: Tuning, dt: float) -> None:
    """Add the row that the mean rate of a segment at rest is its gyroscope's bias, equation (36)."""
    # (36) v
    variance = tuning.zero_rate_sigma**2 * tuning.zero_rate_window_s / dt
    for i in range(3):
        now.evidence.own[3 + i, 3 + i] += 1.0 / variance
        now.evidence.own_vector[3 + i] += (segment.zero_rate.rate[i] - segment.bias[i]) / variance


# Zero acceleration: a segment that stands still is the rank-1 segment
#
# In a filter over the whole tree re-rooting needs no new order of the segments: the foot that stands adds one
# row, ``R f = −g`` at its module, and aids its chain; the joint rows carry it on. In walking the feet
# alternate, and the row comes and goes with its uncertainty, so nothing jumps.


@compiled
def note_rolling(state: State, work: Work, dt: float) -> None:
    """Set ``rolling``, ‖ω̇‖ + ‖ω‖² of (38), rad/s², of segments that are taken to stand.

    It is found from this rate and the last one. Called before the prediction, which overwrites the last rate.
    A foot that begins to roll off shows here at once; its acceleration always points ahead, and would tilt
    whoever walks straight on.
    """
    segments, works = state.segments, work.segments
    for s in range(len(segments)):
        segment, now = segments[s], works[s]
        now.rolling = 0.0
        if now.stood_s > 0.0:
            change, square = 0.0, 0.0
            for i in range(3):
                change += (now.angular_rate[i] - segment.rate[i]) ** 2
                square += (now.angular_rate[i] - segment.bias[i]) ** 2
            now.rolling = math.sqrt(change) / dt + square


@compiled
def stance_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Add the rows (38) of segments that stand still, and mark them as aided.

    A segment that is not made to stand on may also move slowly and evenly, which its module's short window
    cannot distinguish from standing: its ``ZeroRateWatch`` must find it at rest as well.
    """
    links, segments, works = body.segments, state.segments, work.segments
    for s in range(len(links)):
        segment, now, stands = segments[s], works[s], links[s].stands
        is_still = stands == 1 or segment.zero_rate.still_s > tuning.zero_rate_s
        if now.stood_s > 0.0 and is_still and now.validity == FORCE:
            u = rotation_matrix.rotate(segment.R, now.specific_force)
            # (38) v
            variance = tuning.stance_acceleration**2 + (tuning.stance_arm * now.rolling) ** 2
            variance *= max(1.0, tuning.row_memory_s / dt)
            # (14) u_s = R f, y = −g
            known_row(now, segment, u, body.world.at_rest, variance, tuning)
            now.aided = 1
            segment.aids_s = tuning.stride_s
        elif stands == 1 and segment.aids_s > 0.0:
            segment.aids_s -= dt
            now.aided = 1


# Unaided: over a while the mean acceleration is small


LEAST_SQUARE = 1e-9
"""(m/s²)²: nothing, but no number so small that processors are slow with it."""


@compiled
def unaided_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Add the rows (39) that mean accelerations are small.

    The segments of an unaided chain share the information of one row, which averages the errors of their
    accelerometers. A segment of an aided chain has a weak row of its own until its tilt is settled.
    """
    decay = math.exp(-dt / tuning.starting_memory_s)
    segments, works = state.segments, work.segments
    for s in range(len(works)):
        segment, now = segments[s], works[s]
        now.sharing, now.lasting_tilt, now.steadiest_square = 0, 0.0, math.inf
        segment.starting_square = max(segment.starting_square * decay, LEAST_SQUARE)
        if now.validity == FORCE:
            note_acceleration(segment, body.world, tuning, dt)
    _inflate_common_tilt(body, state, tuning, work, dt)
    for s in range(len(works)):
        if works[s].validity == FORCE:
            works[works[s].chain].sharing += 1
    for s in range(len(works)):
        segment, now = segments[s], works[s]
        first = works[now.chain]
        if now.validity < FORCE:
            continue
        if now.bridged_s > tuning.longest_bridge_s and segment.averages.long_seconds <= FIRST_SAMPLE_S:
            # (71) v = A_f²: one look at gravity, as good as single samples have been lately
            felt = segment.averages.long_force
            known_row(now, segment, felt, body.world.at_rest, segment.felt_square, tuning)
        if first.aided:
            starting_row(now, segment, body.world, tuning, dt)
        else:
            unaided_row(now, segment, body.world, first.sharing, tuning, dt)


@compiled
def _shows_acceleration(segment: Segment, tuning: Tuning) -> bool:
    """Return whether what a segment feels beside gravity is acceleration: its tilt is known well enough."""
    is_known = segment.P[0, 0] + segment.P[1, 1] <= tuning.aided_tilt**2
    return bool(is_known and segment.averages.long_seconds >= tuning.unaided_window_s)


@compiled
def _inflate_common_tilt(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Make the tilt that an unaided chain has in common as uncertain as its lasting acceleration says, (40a).

    What its steadiest segment feels beside gravity for longer than it accelerates is a tilt. Joints do not
    show it: it is the same for all segments, so what is known of one against another stays as it is.
    """
    segments, works, gravity = state.segments, work.segments, norm(body.world.gravity)
    for s in range(len(works)):
        segment, now = segments[s], works[s]
        first, square = works[now.chain], tuning.acceleration_share * segment.unaided_square
        if now.validity == FORCE and _shows_acceleration(segment, tuning) and square < first.steadiest_square:
            lasting = 0.5 * _horizontal_square(segment.averages.lasting_force) - square
            known = 0.5 * (segment.P[0, 0] + segment.P[1, 1])
            first.steadiest_square = square
            first.lasting_tilt = max(lasting / gravity**2 - known, 0.0)
    gain = 1.0 - math.exp(-dt / tuning.unaided_window_s)
    for s in range(len(works)):
        segment, now, p = segments[s], works[s], body.segments[s].parent
        first = works[now.chain]
        if first.aided:
            continue
        for i in range(2):
            segment.P[i, i] += gain * first.lasting_tilt
            if body.world.is_tree and p >= 0 and works[p].chain == now.chain:
                segment.C[i, i] += gain * first.lasting_tilt


@compiled
def note_acceleration(segment: Segment, world: World, tuning: Tuning, dt: float) -> None:
    """Update A_1² of (40) and A_f² of (71), (m/s²)², mean squares of acceleration, aided or not.

    It counts only while the tilt is known. A tilt that is wrong all the same looks like an acceleration that
    lasts, and no body's acceleration does: what counts is what differs from a mean over several windows.
    """
    averages = segment.averages
    if not _shows_acceleration(segment, tuning):
        for i in range(3):
            averages.lasting_force[i] = averages.long_force[i]
        return
    square, felt = 0.0, 0.0
    gain = 1.0 - math.exp(-dt / tuning.acceleration_memory_s)
    for i in range(3):
        averages.lasting_force[i] += gain * (averages.long_force[i] - averages.lasting_force[i])
        square += (averages.long_force[i] - averages.lasting_force[i]) ** 2 / 3.0
        felt += (averages.last_force[i] - world.at_rest[i]) ** 2 / 3.0
    # (40)
    segment.unaided_square += gain * (square - segment.unaided_square)
    segment.felt_square += gain * (felt - segment.felt_square)


@compiled
def unaided_row(
    now: SegmentWork, segment: Segment, world: World, sharing: int, tuning: Tuning, dt: float
) -> None:
    """Add the row that the mean acceleration of an unaided segment is small, equation (39).

    A² is at least a share of the mean square acceleration that was seen while the tilt was known and, over a
    time shorter than the window, as much larger as speeds are the same. An error stays for the window.
    sharing: number of segments that move together and have such a row each.
    """
    # (39) A²
    square = max(_mean_square(segment, tuning, dt), tuning.acceleration_share * segment.unaided_square)
    # (39) v = A² T_u / Δt n_c
    variance = square * tuning.unaided_window_s / dt * sharing
    known_row(now, segment, segment.averages.long_force, world.at_rest, variance, tuning)


@compiled
def starting_row(now: SegmentWork, segment: Segment, world: World, tuning: Tuning, dt: float) -> None:
    """Add the row (39) without A_1 to a segment of an aided chain, as long as its tilt is hardly known.

    That is so after a start in mid-motion: joints show tilts only one after the other from where the chain is
    aided.
    """
    if segment.P[0, 0] + segment.P[1, 1] > tuning.unsettled_tilt**2:
        variance = _mean_square(segment, tuning, dt) * tuning.unaided_window_s / dt
        known_row(now, segment, segment.averages.long_force, world.at_rest, variance, tuning)


@compiled
def _mean_square(segment: Segment, tuning: Tuning, dt: float) -> float:
    """Return A² of (39) without A_1, (m/s²)².

    Over a time shorter than the window, as after a gap, it is as much larger as speeds are the same; after a
    start in motion it is for some time as large as the first sample lets expect.
    """
    lasted_s = max(segment.averages.long_seconds, dt)
    square = max(tuning.least_acceleration**2, segment.starting_square)
    if lasted_s < tuning.unaided_window_s:
        square = max(square, (tuning.unaided_speed / lasted_s) ** 2)
    return square
