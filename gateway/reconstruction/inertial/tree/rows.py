"""The observations of the tree filter at joints, and what all of its observations have in common. Compiled.

A world vector ``u = R̂ s`` is truly ``exp(δ) R̂ s ≈ u − [u]× δ``. Two sides that must agree therefore give
``u − u_p = [m]× (δ − δ_p)`` with their mean ``m = (u + u_p) / 2``, and a known vector ``y``:
``u − y = [y]× δ``.
With u and u_p in their own places noise would seem to show a turn of both together, which no joint shows.
"""

from __future__ import annotations

import math

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, horizontal_square, norm, skew
from gateway.reconstruction.inertial.tree.lever_arms import (
    is_due,
    learn_joint_arms,
    own_covariance,
    relative_covariance,
    spread,
)
from gateway.reconstruction.inertial.tree.prediction import (
    felt_into,
    row_inflation,
)
from gateway.reconstruction.inertial.tree.rates import is_short_gap
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
)
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import Three, add_edge, add_joint, add_known, add_own
from gateway.reconstruction.inertial.tree.vibration import shock_variance

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
    wide = variance + horizontal_square(u) + horizontal_square(y)
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
    is_lost, share = child.heading == UNOBSERVED, min(1.0, dt / tuning.row_memory_s)
    uncertain = now.row_variance + tilt_spread(child, tuning, dt) + tilt_spread(parent, tuning, dt)
    if not is_lost and parent.heading == UNOBSERVED and is_apart(child, parent, True, tuning):
        # the parent has begun anew beside a segment that has not: this shows the parent's heading
        is_lost = True
        gather_heading(parent.heading_sums, now.u_parent, now.u, uncertain, share, tuning, dt)
    elif is_lost:
        gather_heading(child.heading_sums, now.u, now.u_parent, uncertain, share, tuning, dt)
        if shown_between(child, parent, tuning)[0] > 0.0:
            return True
    elif now.turn[2] != 0.0 or above.turn[2] != 0.0:
        return False  # this instant's averages are those before the turn
    else:
        gather_heading(child.heading_sums, now.u, now.u_parent, uncertain, share, tuning, dt)
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
    # (20) … + η_s + η_p
    variance += shock_variance(child, link.to_joint, tuning, dt)
    variance += shock_variance(parent, link.from_parent, tuning, dt)
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
    square = 0.5 * (horizontal_square(now.u) + horizontal_square(now.u_parent))
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
    wide = variance + horizontal_square(u) + horizontal_square(u_p)
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
        child.velocity.square = max(child.velocity.square, tuning.unaided_speed**2)
    inflation: float = max(1.0, child.joint_nis)
    return inflation
