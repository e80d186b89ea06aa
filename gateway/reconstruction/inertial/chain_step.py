"""One instant of the tree filter: predict, average, observe headings, rows, update, correct. Compiled."""

from __future__ import annotations

import math

from gateway.frames import Quantity, Status, StatusArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial import chain_rows
from gateway.reconstruction.inertial.chain_averages import average, felt_into, watch_rest
from gateway.reconstruction.inertial.chain_prediction import (
    correct,
    judge_samples,
    predict,
    start_segments,
    turn_segments,
)
from gateway.reconstruction.inertial.chain_state import (
    Body,
    Heading,
    Joint,
    Learning,
    State,
    Validity,
    Work,
)
from gateway.reconstruction.inertial.corrections import note_correction, row_inflation
from gateway.reconstruction.inertial.device_rows import device_rows, has_spoken
from gateway.reconstruction.inertial.heading_start import (
    compass_turn,
    gather_heading,
    is_apart,
    lose_headings,
    second_order_variance,
    shown_heading,
    tilt_spread,
    turn_beyond,
    turn_heading_sums,
)
from gateway.reconstruction.inertial.lever_arms import is_due, learn_joint_arms
from gateway.reconstruction.inertial.rest_rows import note_rolling, stance_rows
from gateway.reconstruction.inertial.sun_rows import follow_sun
from gateway.reconstruction.inertial.tree_filter import add_edge, clear, update_outward, update_tree
from gateway.reconstruction.inertial.tuning import Tuning

INTERPOLATED, UNAIDED = Status.INTERPOLATED.value, Status.UNAIDED.value
FIXED_POINT = Quantity.FIXED_POINT.value
NOTHING, RATE, FORCE = Validity.NOTHING.value, Validity.RATE.value, Validity.FORCE.value
OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value
LEAST_SQUARE = 1e-9
"""(m/s²)²: nothing, but no number so small that processors are slow with it."""


@compiled
def step(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """dt: since the frame before, s (> 0). What was observed is in ``work``; ``state`` changes.

    ``U`` of each segment whose ``validity`` is FORCE then is the specific force at its proximal joint.
    """
    judge_samples(work, tuning)
    note_rolling(state, work, dt)
    predict(body, state, tuning, work, dt)
    start_segments(body, state, tuning, work)
    lose_headings(body.segments, state.segments, tuning)
    average(state, tuning, work, dt)
    _forget(work)
    if body.world.uses_field:
        _follow_field(body, state, tuning, work, dt)
    if work.shared.sees_sun:
        follow_sun(body, state, tuning, work, dt)
    device_rows(body, state, tuning, work, dt)
    stance_rows(body, state, tuning, work, dt)
    _joint_rows(body, state, tuning, work, dt)
    _unaided_rows(body, state, tuning, work, dt)
    _rest_rows(state, tuning, work, dt)
    turn_segments(body, state, work)
    if body.world.is_tree:
        update_tree(body.segments, state.segments, work)
    else:
        update_outward(body.segments, state.segments, work)
    correct(state, work)
    turn_segments(body, state, work)
    _note_corrections(state, tuning, work, dt)


@compiled
def _forget(work: Work) -> None:
    """What the instant before has left."""
    segments = work.segments
    for s in range(len(segments)):
        now = segments[s]
        clear(now.evidence)
        now.aided = 0
        for i in range(3):
            now.turn[i] = 0.0


@compiled
def _follow_field(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """A row where the heading is observed; where it is not the field leads it as a compass."""
    expected, world = work.shared.expected, body.world
    links, segments, works = body.segments, state.segments, work.segments
    chain_rows.expect_field(expected, world, tuning, dt)
    for s in range(len(links)):
        segment, now = segments[s], works[s]
        m = now.magnetic_field
        if now.validity < RATE:
            continue  # a saturated gyroscope has lost it: the field would seem disturbed
        if not math.isfinite(m[0] + m[1] + m[2]):
            continue
        chain_rows.watch_field(segment, now, world, expected, tuning, dt)
        if segment.heading == OBSERVED:
            chain_rows.field_row(segment, links[s], now, expected, tuning, dt)
            continue
        now.turn[2] = compass_turn(segment, now, tuning, dt)
    for s in range(len(links)):
        p, sums = links[s].parent, segments[s].heading_sums
        turn_heading_sums(sums, works[s].turn[2])
        if p >= 0:
            turn_heading_sums(sums, -works[p].turn[2])


@compiled
def mark_unaided(body: Body, state: State, tuning: Tuning, work: Work, status: StatusArray) -> None:
    """Tells in ``status`` (n,), in place, which chains have lost all their local devices."""
    links, works = body.segments, work.segments
    for s in range(len(links)):
        now, p = works[s], links[s].parent
        now.chain, now.sharing = s, 0  # 1: aided by nothing any more, 2: by a device
        if p >= 0:
            now.chain = works[p].chain
    for d in range(len(body.devices)):
        mount, device = body.devices[d], state.devices[d]
        is_starting = device.age_s == math.inf and work.shared.time_s < tuning.device_start_s
        is_aiding = mount.kind == FIXED_POINT or has_spoken(device, tuning) or is_starting
        first = works[works[mount.segment].chain]
        first.sharing = max(first.sharing, 2 if is_aiding else 1)
    for s in range(len(links)):
        if works[works[s].chain].sharing == 1 and status[s] <= INTERPOLATED:
            status[s] = UNAIDED


@compiled
def _joint_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Rows of all joints, and ``U``; segments whose joints are seen from both sides are one chain.

    In the joint filter a foot or a device anywhere aids its chain; outward only one on its root does.
    """
    settled_s = tuning.settled * tuning.smoothing_s
    links, segments, works = body.segments, state.segments, work.segments
    for s in range(len(links)):
        link, segment, now = links[s], segments[s], works[s]
        p, now.chain = link.parent, s
        felt_into(now.U, segment.averages.force, now.K, link.to_joint, segment.arms.error, 0)
        if p < 0 or now.validity < FORCE or works[p].validity < FORCE:
            continue
        if segment.joint_nis < tuning.loose_nis:  # else what aids the one does not aid the other
            # also while its row waits for the averages: after a gap nothing has changed
            now.chain = works[p].chain
        if body.world.is_tree:
            first = works[now.chain]
            first.aided = max(first.aided, now.aided)
        if segment.averages.seconds < settled_s or segments[p].averages.seconds < settled_s:
            continue
        joint = Joint(link, segment, segments[p], now, works[p])
        if _joint_row(joint, work.shared.learning, tuning, dt):
            _settle_heading(body, state, tuning, work, s)


@compiled
def _unaided_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """All segments of a chain that nothing aids share one: that averages their accelerometers' errors.

    Where one is aided, its segments have a weak one of their own until their inclinations are settled.
    """
    decay = math.exp(-dt / tuning.starting_memory_s)
    segments, works = state.segments, work.segments
    for s in range(len(works)):
        segment = segments[s]
        works[s].sharing = 0
        segment.starting_square = max(segment.starting_square * decay, LEAST_SQUARE)
    for s in range(len(works)):
        if works[s].validity == FORCE:
            works[works[s].chain].sharing += 1
    for s in range(len(works)):
        segment, now = segments[s], works[s]
        first = works[now.chain]
        if now.validity < FORCE:
            continue
        if first.aided:
            chain_rows.note_aided(segment, body.world, tuning, dt)
            chain_rows.starting_row(now, segment, body.world, tuning, dt)
        else:
            chain_rows.unaided_row(now, segment, body.world, first.sharing, tuning, dt)


@compiled
def _joint_row(joint: Joint, learning: Learning, tuning: Tuning, dt: float) -> bool:
    """Whether the child's heading has just been shown; then there is no row. Changes ``U`` where it corrects
    lever arms."""
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
        if shown_heading(child, tuning)[0] > 0.0:
            return True
    elif now.turn[2] != 0.0 or above.turn[2] != 0.0:
        return False  # this instant's averages are those before the turn
    else:
        _learn_arms(joint, learning, tuning, dt)
    if not is_lost:
        now.row_variance *= row_inflation(child, parent, tuning)
    chain_rows.joint_row(joint, is_lost, tuning, dt)
    return False


@compiled
def _settle_heading(body: Body, state: State, tuning: Tuning, work: Work, s: int) -> None:
    """Turn segment s to what motion has shown: against its parent its heading is that, to that variance."""
    variance, angle = shown_heading(state.segments[s], tuning)
    state.segments[s].heading = OBSERVED
    add_edge(work.segments[s].evidence, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), 0.0, variance)
    turn_beyond(body, state, tuning, work, s, angle)


@compiled
def _see_joint(joint: Joint, tuning: Tuning, dt: float) -> None:
    """``u``, ``u_parent``, ``row_variance`` ← of a joint."""
    link, child, parent, now, above = joint
    felt_into(now.u_parent, parent.averages.force, above.K, link.from_parent, child.arms.error, 3)
    moved = math.sqrt(now.motion**2 + above.motion**2)
    variance = chain_rows.row_variance(tuning, moved, dt)
    for i in range(3):
        now.u[i] = now.U[i]
    if link.is_bridged:
        for i in range(3):
            for j in range(3):
                now.u[i] -= now.K[i, j] * link.beyond[j]
        variance += (link.slack * moved) ** 2 * tuning.row_memory_s / dt
    variance += child.vibration.square + parent.vibration.square
    of_child = second_order_variance(child, now.u, tuning, dt)
    now.row_variance = variance + (of_child + second_order_variance(parent, now.u_parent, tuning, dt))


@compiled
def _learn_arms(joint: Joint, learning: Learning, tuning: Tuning, dt: float) -> None:
    """What the lever arms are uncertain of is added to the joint's row, and from time to time is learnt."""
    child, now = joint.child, joint.now
    if is_due(child, tuning, dt):
        learning.at_once = now.row_variance * dt / tuning.row_memory_s
        learn_joint_arms(joint, learning, tuning, dt)
        if not joint.link.is_bridged:
            for i in range(3):
                now.U[i] = now.u[i]
    now.row_variance += child.arms.row_variance * tuning.row_memory_s / dt


@compiled
def _rest_rows(state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Of all segments that have rested for a while."""
    gain = 1.0 - math.exp(-dt / tuning.rest_window_s)
    segments, works = state.segments, work.segments
    for s in range(len(works)):
        segment, now = segments[s], works[s]
        if now.validity > NOTHING and watch_rest(segment.rest, now, tuning, gain, dt):
            chain_rows.rest_row(now, segment, tuning, dt)


@compiled
def _note_corrections(state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Of segments whose inclinations rows have shown."""
    segments, works = state.segments, work.segments
    for s in range(len(works)):
        segment, now = segments[s], works[s]
        if now.validity == FORCE and works[now.chain].aided and segment.heading == OBSERVED:
            note_correction(segment.corrections, now.x[0], now.x[1], tuning, dt)
