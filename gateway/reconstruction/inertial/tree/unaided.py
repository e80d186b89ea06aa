"""What the tree filter knows without any device: rest, standing and bounded speeds. Compiled.

These are the rows of section 9 of ``docs/explanation/estimator.md``.
"""

from __future__ import annotations

import math

from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, horizontal_square, norm
from gateway.reconstruction.inertial.tree.rows import known_row
from gateway.reconstruction.inertial.tree.start import tilt_square
from gateway.reconstruction.inertial.tree.state import (
    Body,
    Segment,
    SegmentWork,
    State,
    Validity,
    Work,
    World,
    ZeroRateWatch,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.velocity import learn_velocity

FORCE, NOTHING = Validity.FORCE.value, Validity.NOTHING.value


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
    rate_square, rate_lasting, force_lasting = 0.0, 0.0, 0.0
    for i in range(3):
        off_rate, off_force = now.angular_rate[i] - watch.rate[i], now.specific_force[i] - watch.force[i]
        rate_square += off_rate * off_rate
        # noise is new with each sample, motion is not
        rate_lasting += off_rate * watch.off_rate[i]
        force_lasting += off_force * watch.off_force[i]
        watch.off_rate[i], watch.off_force[i] = off_rate, off_force
        watch.rate[i] += gain * off_rate
        watch.force[i] += gain * off_force
    watch.rate_square += gain * (rate_square - watch.rate_square)
    watch.rate_lasting += gain * (rate_lasting - watch.rate_lasting)
    watch.force_lasting += gain * (force_lasting - watch.force_lasting)
    is_still = (
        watch.rate_lasting < tuning.zero_rate_change**2
        and watch.force_lasting < tuning.zero_rate_force_change**2
    )
    is_still = is_still and dot(watch.rate, watch.rate) < tuning.largest_bias**2
    watch.still_s = watch.still_s + dt if is_still else 0.0
    return bool(watch.still_s > tuning.zero_rate_s)


@compiled
def zero_rate_row(now: SegmentWork, segment: Segment, tuning: Tuning, dt: float) -> None:
    """Add the row that the mean rate of a segment at rest is its gyroscope's bias, equation (36)."""
    # (36) v
    watch = segment.zero_rate
    noise = max(watch.rate_square - watch.rate_lasting, 0.0) / 3.0
    variance = tuning.zero_rate_sigma**2 * tuning.zero_rate_window_s / dt + noise
    for i in range(3):
        now.evidence.own[3 + i, 3 + i] += 1.0 / variance
        now.evidence.own_vector[3 + i] += (watch.rate[i] - segment.bias[i]) / variance


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


# Unaided: speeds are bounded


@compiled
def unaided_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Add the rows (40) that speeds are small, aided or not.

    The segments of a chain share the information of one row, which averages the errors of their
    accelerometers. One of an aided chain has a row of its own until its tilt is settled.
    """
    segments, works = state.segments, work.segments
    for s in range(len(works)):
        works[s].sharing, works[s].lasting_tilt, works[s].steadiest_square = 0, 0.0, math.inf
    for s in range(len(works)):
        if works[s].validity == FORCE:
            works[works[s].chain].sharing += 1
            note_speed(segments[s], body.world, tuning, dt)
    inflate_common_tilt(body, state, tuning, work, dt)
    for s in range(len(works)):
        segment, now = segments[s], works[s]
        velocity = segment.velocity
        if now.validity < FORCE:
            continue
        if velocity.tilted_s == 0.0:
            if now.bridged_s > tuning.longest_bridge_s:
                # (71) v = A_f²: one look at gravity, as good as single samples have been lately
                felt = segment.averages.last_force
                known_row(now, segment, felt, body.world.at_rest, segment.felt_square, tuning)
            continue
        # (40) s² T_u / Δt
        look = max(velocity.square, tuning.least_speed**2) * tuning.unaided_memory_s / dt
        first, tilt = works[now.chain], segment.P[0, 0] + segment.P[1, 1]
        is_alone = first.aided == 1 and tilt > tuning.unsettled_tilt**2
        speed_row(now, segment, body.world, look, 1 if is_alone else first.sharing, tuning)
        learn_velocity(velocity, look)


@compiled
def _shows_speed(segment: Segment, tuning: Tuning) -> bool:
    """Return whether the tilt is known well enough that what is felt is a velocity."""
    return bool(segment.P[0, 0] + segment.P[1, 1] <= tuning.aided_tilt**2)


@compiled
def inflate_common_tilt(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Make the tilt that an unaided chain has in common as uncertain as its lasting velocity says, (40b).

    A velocity that its steadiest segment feels for longer than it keeps one is a tilt. Joints do not
    show it: it is the same for all segments, so what is known of one against another stays as it is.
    """
    segments, works, gravity = state.segments, work.segments, norm(body.world.gravity)
    for s in range(len(works)):
        segment, now, velocity = segments[s], works[s], segments[s].velocity
        first = works[now.chain]
        is_judge = now.validity == FORCE and _shows_speed(segment, tuning) and velocity.tilted_s > 0.0
        if is_judge and velocity.square < first.steadiest_square:
            lasting = 0.5 * horizontal_square(velocity.lasting) - velocity.square - velocity.variance
            known = tilt_square(segment)
            first.steadiest_square = velocity.square
            first.lasting_tilt = max(lasting / (gravity * velocity.tilted_s) ** 2 - known, 0.0)
    gain = 1.0 - math.exp(-dt / tuning.unaided_memory_s)
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
def note_speed(segment: Segment, world: World, tuning: Tuning, dt: float) -> None:
    """Update s² of (40a), (m/s)², and A_f² of (71), (m/s²)², aided or not, while the tilt is known.

    A tilt that is wrong all the same looks like a velocity that lasts: what counts is what differs from a
    mean over some seconds.
    """
    if not _shows_speed(segment, tuning):
        for i in range(3):
            segment.velocity.lasting[i] = segment.velocity.felt[i]
        return
    gain, felt = 1.0 - math.exp(-dt / tuning.speed_mean_s), 0.0
    for i in range(3):
        felt += (segment.averages.last_force[i] - world.at_rest[i]) ** 2 / 3.0
    segment.felt_square += gain * (felt - segment.felt_square)
    velocity, square = segment.velocity, 0.0
    for i in range(3):
        velocity.lasting[i] += gain * (velocity.felt[i] - velocity.lasting[i])
    for i in range(2):
        square += 0.5 * (velocity.felt[i] - velocity.lasting[i]) ** 2
    velocity.square += gain * (square - velocity.square)


@compiled
def speed_row(
    now: SegmentWork, segment: Segment, world: World, look: float, sharing: int, tuning: Tuning
) -> None:
    """Add the row (40): a velocity that a segment only seems to have is gravity along a tilt.

    look: variance of the velocity that it may have, of a component, (m/s)². sharing: number of segments that
    move together and have such a row each.
    """
    velocity, mean = segment.velocity, now.mean_force
    # (40) u = −g + v / T
    for i in range(3):
        mean[i] = world.at_rest[i] + velocity.felt[i] / velocity.tilted_s
    variance = (velocity.variance + look) / velocity.tilted_s**2 * sharing
    known_row(now, segment, mean, world.at_rest, variance, tuning)
