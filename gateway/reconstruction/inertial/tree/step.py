"""Frames of a suit through the tree filter in one call: modules to segments, step, outputs. Compiled.

A live frame and a whole recording go through the same function, so they agree bit for bit. ``step`` is one
instant: predict, average, observe headings, rows, update, correct.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from gateway.body.kinematics import joint_positions_into
from gateway.body.skeleton import LocalDevice, WornSuit
from gateway.frames import Clipped, FloatArray, IntArray, Quantity, Status, StatusArray
from gateway.geometry import quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records, array_of
from gateway.geometry.vectors import dot, is_finite
from gateway.reconstruction.inertial.observations import sensor_to_segment_matrices
from gateway.reconstruction.inertial.tree.clipping import is_at_end, judge_samples
from gateway.reconstruction.inertial.tree.compass import follow_field, share_headings, shows_world
from gateway.reconstruction.inertial.tree.devices import device_rows, has_reported, take_reading
from gateway.reconstruction.inertial.tree.headings import define_headings, follow_sun, open_headings, take_sun
from gateway.reconstruction.inertial.tree.prediction import (
    average,
    correct,
    note_corrections,
    predict,
    turn_segments,
)
from gateway.reconstruction.inertial.tree.rows import joint_rows
from gateway.reconstruction.inertial.tree.start import lose_headings, start_segments
from gateway.reconstruction.inertial.tree.state import (
    NEVER_NS,
    Body,
    Clock,
    Device,
    Link,
    Mount,
    Segment,
    SegmentWork,
    SharedWork,
    Started,
    State,
    Validity,
    Work,
    World,
)
from gateway.reconstruction.inertial.tree.stuck import leave_out_stuck_fields
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.unaided import (
    note_rolling,
    stance_rows,
    unaided_rows,
    zero_rate_rows,
)
from gateway.reconstruction.inertial.tree.update import clear, update_outward, update_tree
from gateway.reconstruction.inertial.tree.velocity import predict_velocities

AIR_VELOCITY, FIXED_POINT = Quantity.AIR_VELOCITY.value, Quantity.FIXED_POINT.value
NOT_STARTED, STARTED = Started.NO.value, Started.YES.value
INTERPOLATED, MISSING, PREDICTED, UNAIDED = (
    Status.INTERPOLATED.value,
    Status.MISSING.value,
    Status.PREDICTED.value,
    Status.UNAIDED.value,
)
FORCE, NOTHING, RATE = Validity.FORCE.value, Validity.NOTHING.value, Validity.RATE.value
RATE_CLIPPED = Clipped.ANGULAR_RATE.value
SHORTEST_STEP_S = 1e-5


class Wearing(NamedTuple):
    """How the suit is worn, as far as the filter itself need not know; constant."""

    module_of_segment: IntArray  # (n_segments,) −1: none
    R_bs: FloatArray  # (n_segments, 3, 3) sensor to segment
    parents: IntArray  # (n_segments,) of the skeleton
    offsets: FloatArray  # (n_segments, 3) of the skeleton, m
    root_device: IntArray  # (1,) segment whose device measures where it is; −1: nothing does
    root_arm: FloatArray  # (3,) that device on it, segment axes, m
    nominal_interval_ns: IntArray  # (1,)


class Filter(NamedTuple):
    """Everything that a pose is computed from beside the measurements."""

    wearing: Wearing
    body: Body
    state: State
    tuning: Tuning
    work: Work

    def arrays(self) -> tuple[Any, ...]:
        """Return the filter's parts as the arguments of ``advance``.

        Numba finds the type of an array that is an argument of its own five times as fast as that of an array
        in a tuple or of a single record.
        """
        return (
            *self.wearing, self.body.segments, self.body.devices, array_of(self.body.world),
            self.state.segments, self.state.devices, array_of(self.state.clock), array_of(self.tuning),
            self.work.segments, array_of(self.work.shared),
        )  # fmt: skip


class Inputs(NamedTuple):
    """T instants of m modules in sensor axes, as in ``ImuFrame``; k readings of local devices in all."""

    time_ns: IntArray  # (T,)
    specific_force: FloatArray  # (T, m, 3)
    angular_rate: FloatArray  # (T, m, 3)
    magnetic_field: FloatArray  # (T, m, 3)
    status: StatusArray  # (T, m)
    clipped: StatusArray  # (T, m)
    root_position: FloatArray  # (T, 3) measured, m; of no meaning without a device for it
    readings_end: IntArray  # (T,) how many of the readings have come with this instant
    readings: FloatArray  # (k, 8) device of the filter, s since the first frame, value, standard deviation
    sun: FloatArray  # (T, m + 1, 4) direction and standard deviation, last row: in the world; (T, 0, 4): none


class Outputs(NamedTuple):
    """Room for T poses of n segments, as in ``SkeletonFrame``."""

    q_wb: FloatArray  # (T, n, 4)
    angular_rate: FloatArray  # (T, n, 3)
    joint_acceleration: FloatArray  # (T, n, 3)
    p_w: FloatArray  # (T, n, 3)
    sigma: FloatArray  # (T, n)
    status: StatusArray  # (T, n)


def room_for(n_frames: int, n: int) -> Outputs:
    """Return arrays for T poses of n segments, not yet filled."""
    rate, acceleration, p_w = (np.empty((n_frames, n, 3)) for _ in range(3))
    status = np.empty((n_frames, n), np.uint8)
    return Outputs(np.empty((n_frames, n, 4)), rate, acceleration, p_w, np.empty((n_frames, n)), status)


def wearing_of(suit: WornSuit, root_device: LocalDevice | None, nominal_interval_s: float) -> Wearing:
    """Return how the suit is worn, in the arrays of ``Wearing``.

    root_device: the device that measures the position of its segment; None: no device does.
    """
    return Wearing(
        suit.module_of_segment.astype(np.int64),
        sensor_to_segment_matrices(suit),
        suit.skeleton.parents.astype(np.int64),
        np.array(suit.skeleton.offsets, np.float64),
        np.array([-1 if root_device is None else root_device.segment], np.int64),
        np.zeros(3) if root_device is None else np.array(root_device.position, np.float64),
        np.array([round(nominal_interval_s * 1e9)], np.int64),
    )


@compiled
def advance(
    stood_s: FloatArray,
    covariance: FloatArray,
    time_ns: IntArray,
    specific_force: FloatArray,
    angular_rate: FloatArray,
    magnetic_field: FloatArray,
    status: StatusArray,
    clipped: StatusArray,
    root_position: FloatArray,
    readings_end: IntArray,
    readings: FloatArray,
    sun: FloatArray,
    module_of_segment: IntArray,
    R_bs: FloatArray,
    parents: IntArray,
    offsets: FloatArray,
    root_device: IntArray,
    root_arm: FloatArray,
    nominal_interval_ns: IntArray,
    links: Records[Link],
    mounts: Records[Mount],
    world: Records[World],
    segments: Records[Segment],
    devices: Records[Device],
    clock: Records[Clock],
    tuning: Records[Tuning],
    segments_work: Records[SegmentWork],
    shared: Records[SharedWork],
    first: int,
    q_wb: FloatArray,
    rate: FloatArray,
    acceleration: FloatArray,
    p_w: FloatArray,
    sigma: FloatArray,
    status_found: StatusArray,
) -> None:
    """Advance the filter over all instants in turn and fill the outputs.

    The arguments after the first two are the fields of ``Inputs``, the parts of a ``Filter``, and the fields
    of ``Outputs``, which are filled from row ``first`` on.

    stood_s: (T, n) for how long each segment has stood still, s. covariance: (T, n, 2, 3, 3) is filled with
    the covariance of the orientation errors, world axes, rad²: first the estimate's own, then the published
    one. An empty array leaves it out.
    """
    inputs = Inputs(
        time_ns, specific_force, angular_rate, magnetic_field, status, clipped, root_position, readings_end,
        readings, sun,
    )  # fmt: skip
    wearing = Wearing(
        module_of_segment, R_bs, parents, offsets, root_device, root_arm, nominal_interval_ns
    )  # fmt: skip
    body = Body(links, mounts, world[0])
    state, work = State(segments, devices, clock[0]), Work(segments_work, shared[0])
    outputs = Outputs(q_wb, rate, acceleration, p_w, sigma, status_found)
    _advance(Filter(wearing, body, state, tuning[0], work), inputs, stood_s, covariance, outputs, first)


@compiled
def _advance(
    held: Filter, inputs: Inputs, stood_s: FloatArray, covariance: FloatArray, outputs: Outputs, first: int
) -> None:
    wearing, body, state, tuning, work = held
    n, taken = len(wearing.parents), 0
    for t in range(len(inputs.time_ns)):
        q_wb, p_w, status = outputs.q_wb[first + t], outputs.p_w[first + t], outputs.status[first + t]

        _observe(work, wearing, inputs, stood_s[t], t)
        dt = _tick(state.clock, inputs.time_ns[t], wearing.nominal_interval_ns[0])
        work.shared.time_s = (inputs.time_ns[t] - state.clock.first_ns) * 1e-9
        if dt > SHORTEST_STEP_S:
            _take(body, state, tuning, work, dt, inputs.readings[taken : inputs.readings_end[t]])
            step(body, state, tuning, work, dt)
        else:
            for s in range(n):
                work.segments[s].validity = NOTHING
        taken = inputs.readings_end[t]

        _statuses(held, status)
        publish_covariances(body, state, tuning, work)
        _outputs(
            held, q_wb, outputs.angular_rate[first + t], outputs.joint_acceleration[first + t],
            outputs.sigma[first + t],
        )  # fmt: skip
        mark_unaided(body, state, tuning, work, status)

        if len(covariance) > 0:
            for s in range(n):
                _own_covariance(covariance[t, s, 0], state.segments[s], body.world)
                rotation_matrix.copy_into(covariance[t, s, 1], state.segments[s].published)
        _place(p_w, wearing, q_wb, inputs.root_position[t])


@compiled
def step(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Advance the filter by one instant. The observations are read from ``work``; ``state`` changes in place.

    dt: time since the frame before, s (> 0). Afterwards ``U`` of each segment whose ``validity`` is FORCE is
    the specific force at its proximal joint.
    """
    # section 14: which sensors count
    judge_samples(state, work, tuning)
    note_rolling(state, work, dt)

    # section 3: prediction; section 8: fields that are stuck; section 14: start; (57): headings that are lost
    predict(body, state, tuning, work, dt)
    if body.world.uses_field:
        leave_out_stuck_fields(state, tuning, work, dt)
    start_segments(body, state, tuning, work)
    lose_headings(body.segments, state.segments, tuning)

    # section 4: averages; section 9: velocities
    average(state, tuning, work, dt)
    predict_velocities(body, state, tuning, work, dt)

    # rows. Section 8: the sun
    _forget(work)
    if work.shared.sees_sun:
        open_headings(body, state, tuning, work)
        follow_sun(body, state, tuning, work, dt)

    # section 7: local devices; section 9: zero acceleration
    device_rows(body, state, tuning, work, dt)
    stance_rows(body, state, tuning, work, dt)

    # section 6: joints, with sections 10 and 12; section 9: unaided, zero rate
    joint_rows(body, state, tuning, work, dt)
    unaided_rows(body, state, tuning, work, dt)
    zero_rate_rows(state, tuning, work, dt)

    # section 12: headings that were shown; section 11: the update, and its correction
    turn_segments(body, state, work)
    if body.world.is_tree:
        update_tree(body.segments, state.segments, work)
    else:
        update_outward(body.segments, state.segments, work)
    correct(state, work)
    turn_segments(body, state, work)

    # section 13: what the corrections say
    note_corrections(state, tuning, work, dt)

    # section 12: what is not shown at all
    define_headings(body, state, tuning)

    # section 8: what the field says of headings
    if body.world.uses_field:
        follow_field(body, state, tuning, work, dt)
    share_headings(body, state, tuning, work, dt)


@compiled
def _forget(work: Work) -> None:
    """Reset what rows of the instant before have left: evidence, aid and turns."""
    segments = work.segments
    for s in range(len(segments)):
        now = segments[s]
        clear(now.evidence)
        now.aided = 0
        for i in range(3):
            now.turn[i] = 0.0


@compiled
def _observe(work: Work, wearing: Wearing, inputs: Inputs, stood_s: FloatArray, t: int) -> None:
    """Copy the measurements of instant t from modules to their segments, rotated into segment axes."""
    work.shared.sees_sun = inputs.sun.shape[1] > 0
    if work.shared.sees_sun:
        take_sun(work, wearing.module_of_segment, wearing.R_bs, inputs.sun[t])
    works, module_of_segment, all_R_bs = work.segments, wearing.module_of_segment, wearing.R_bs
    forces, rates, fields = inputs.specific_force[t], inputs.angular_rate[t], inputs.magnetic_field[t]
    status, clipped = inputs.status[t], inputs.clipped[t]
    for s in range(len(works)):
        row, now, R_bs = module_of_segment[s], works[s], all_R_bs[s]
        now.stood_s = stood_s[s]
        if row >= 0:
            rotation_matrix.rotate_into(now.specific_force, R_bs, forces[row])
            rotation_matrix.rotate_into(now.angular_rate, R_bs, rates[row])
            rotation_matrix.rotate_into(now.magnetic_field, R_bs, fields[row])
            now.status = status[row] if is_finite(now.specific_force) else MISSING
            now.clipped = clipped[row]
            _note_clipped_axes(now, rates[row], R_bs)


@compiled
def _note_clipped_axes(now: SegmentWork, rate: FloatArray, R_bs: FloatArray) -> None:
    """Set ``clipped_axes`` where the gyroscope is at the end of its range: its largest, and those as large.

    rate: (3,) rad/s, module axes.
    """
    is_clipped = now.clipped & RATE_CLIPPED > 0
    ends = is_at_end(rate)
    for j in range(3):
        for i in range(3):
            now.clipped_axes[j, i] = ends[j] * R_bs[i, j] if is_clipped else 0.0


@compiled
def _tick(clock: Clock, time_ns: int, nominal_interval_ns: int) -> float:
    """Return the time since the frame before, s. A frame that is not later leaves the clock as it is.

    The first frame counts as one nominal interval after the start.
    """
    if clock.first_ns == NEVER_NS:
        clock.last_ns, clock.first_ns = time_ns - nominal_interval_ns, time_ns
    dt = 1e-9 * float(time_ns - clock.last_ns)
    if dt > SHORTEST_STEP_S:
        clock.last_ns = time_ns
    return dt


@compiled
def _take(body: Body, state: State, tuning: Tuning, work: Work, dt: float, readings: FloatArray) -> None:
    """Hand the readings (k, 8) of an instant to their devices, in world axes.

    dt: time since the frame that the orientations belong to, s. An air velocity is rotated by the orientation
    that the segment's last rate predicts for the time of the reading. The largest known component of the
    standard deviation counts for all three.
    """
    turn, value, before_s = work.shared.rotation, work.shared.reading, work.shared.time_s - dt
    for k in range(len(readings)):
        reading, d, sigma = readings[k], int(readings[k, 0]), 0.0
        mount, segment = body.devices[d], state.segments[body.devices[d].segment]
        for i in range(3):
            value[i] = reading[2 + i]
        is_own = mount.kind == AIR_VELOCITY
        if is_own:
            w, b, since = segment.rate, segment.bias, reading[1] - before_s
            rotation_matrix.exponential_into(
                turn, (w[0] - b[0]) * since, (w[1] - b[1]) * since, (w[2] - b[2]) * since
            )
            rotation_matrix.turn(turn, value)
            rotation_matrix.turn(segment.R, value)
        if is_finite(value) and not (is_own and segment.started != STARTED):
            for i in range(5, 8):
                if not math.isnan(reading[i]):
                    sigma = max(sigma, min(reading[i], np.finfo(np.float64).max))
            take_reading(state.devices[d], mount.kind, reading[1], value, sigma, tuning)


@compiled
def _statuses(held: Filter, status: StatusArray) -> None:
    """Set ``status`` (n,) of every segment.

    PREDICTED: the module is silent or its gyroscope saturated; also a segment without a module below one that
    has an orientation. UNAIDED: the accelerometer is saturated, so that the gyroscope alone turns the
    segment. MISSING: before the first sample. Else the module's status.
    """
    segments, works = held.state.segments, held.work.segments
    parents, module_of_segment = held.wearing.parents, held.wearing.module_of_segment
    for s in range(len(parents)):
        now, p = works[s], parents[s]
        if module_of_segment[s] < 0:
            status[s] = PREDICTED if p >= 0 and status[p] != MISSING else MISSING
        elif segments[s].started == NOT_STARTED:
            status[s] = MISSING
        elif now.validity < RATE:
            status[s] = PREDICTED
        else:
            status[s] = UNAIDED if now.validity == RATE else now.status


@compiled
def _outputs(
    held: Filter, q_wb: FloatArray, rate: FloatArray, acceleration: FloatArray, sigma: FloatArray
) -> None:
    """Fill orientation (n, 4), angular rate (n, 3), joint acceleration (n, 3) and sigma (n,), equation (67).

    A segment without a module takes orientation and rate from its parent. What is undefined is NaN.
    """
    q_wb[:], rate[:], acceleration[:], sigma[:] = np.nan, np.nan, np.nan, np.nan
    gravity, unknown = held.body.world.gravity, 2.0 * held.tuning.unknown_heading
    turned = np.zeros(4)
    segments, works = held.state.segments, held.work.segments
    parents, module_of_segment = held.wearing.parents, held.wearing.module_of_segment

    for s in range(len(parents)):
        segment, now, p = segments[s], works[s], parents[s]
        error = segment.compass.error
        if now.validity == FORCE:
            c, d = math.cos(error), math.sin(error)
            acceleration[s, 0] = c * now.U[0] + d * now.U[1] + gravity[0]
            acceleration[s, 1] = c * now.U[1] - d * now.U[0] + gravity[1]
            acceleration[s, 2] = now.U[2] + gravity[2]

        if segment.started != NOT_STARTED:
            P = segment.published
            sigma[s] = min(math.sqrt(P[0, 0] + P[1, 1] + P[2, 2]), unknown)

        if module_of_segment[s] < 0:
            if p >= 0:
                for i in range(4):
                    q_wb[s, i] = q_wb[p, i]
                for i in range(3):
                    rate[s, i] = rate[p, i]
        elif segment.started != NOT_STARTED:
            quaternion.from_matrix_into(q_wb[s], segment.R)
            if error != 0.0:
                turned[0], turned[3] = math.cos(0.5 * error), -math.sin(0.5 * error)
                q_wb[s] = quaternion.canonical(quaternion.multiply(turned, q_wb[s]))
            for i in range(3):
                rate[s, i] = segment.rate[i] - segment.bias[i]


@compiled
def _own_covariance(P: FloatArray, segment: Segment, world: World) -> None:
    """Fill P (3, 3) with the covariance of the estimate's orientation error, rad², world axes.

    Smoothing weighs estimates by it. Where the field is used the variance of the heading is that of the
    compass, if that is smaller.
    """
    rotation_matrix.copy_into(P, segment.P)
    for i in range(3):
        P[i, i] += segment.gap.missed
    compass = segment.compass
    P[2, 2] += segment.defined_square
    if world.uses_field and P[2, 2] > compass.error_variance:
        share = math.sqrt(compass.error_variance / P[2, 2])
        for i in range(3):
            P[2, i] *= share
            P[i, 2] *= share


@compiled
def publish_covariances(body: Body, state: State, tuning: Tuning, work: Work) -> None:
    """Set ``published`` and ``tilt_share`` of every segment, equation (68); rad², world axes.

    Published is P with the tilt scaled by how well the joints around the segment agree, but for what all of
    an unaided chain have in common, plus the tilt that a constant error of the accelerometer leaves, which is
    the less the more joints accelerate; the heading's variance is that of the compass where the field is
    used, if that is smaller.
    """
    links, segments, works = body.segments, state.segments, work.segments
    _compare_tilts(links, segments, works, tuning)
    is_world_shown = shows_world(links, segments)
    gravity_square = dot(body.world.gravity, body.world.gravity)
    for s in range(len(links)):
        now, segment = works[s], segments[s]
        first, P, published = works[now.chain], segment.P, segment.published
        lasting = tuning.force_bias**2 / gravity_square
        if now.agreeing > 0:
            # (68) ν_s
            segment.tilt_share = tuning.tilt_nis * now.agreement / now.agreeing
            # (68) g_s²
            lasting *= (gravity_square / (gravity_square + 2.0 * segment.felt_square)) ** 2
        else:
            segment.tilt_share = 1.0
        share = segment.tilt_share
        if first.aided == 0 and share < 1.0 and segment.started != NOT_STARTED:
            # (68) joints do not tell of a tilt that all of the chain have in common
            share += (1.0 - share) * first.least_tilt / (P[0, 0] + P[1, 1])
        for i in range(2):
            for j in range(2):
                published[i, j] = share * P[i, j] + (lasting if i == j else 0.0)
            published[i, 2], published[2, i] = 0.0, 0.0
        published[2, 2] = P[2, 2]
        if body.world.uses_field:
            of_field = segment.compass.error_variance
            published[2, 2] = min(P[2, 2], of_field) if is_world_shown else of_field
        elif not is_world_shown:
            published[2, 2] = max(P[2, 2], tuning.unknown_heading**2)
        for i in range(3):
            published[i, i] += segment.gap.missed


@compiled
def _compare_tilts(
    links: Records[Link], segments: Records[Segment], works: Records[SegmentWork], tuning: Tuning
) -> None:
    """Set how well the joints around each segment agree, and the tilt known best in each chain."""
    for s in range(len(links)):
        works[s].agreement, works[s].agreeing, works[s].least_tilt = 0.0, 0, math.inf
    for s in range(len(links)):
        p, segment = links[s].parent, segments[s]
        if p >= 0 and segment.started == STARTED and segment.joint_nis < tuning.loose_nis:
            for k in (s, p):
                works[k].agreement += segment.joint_nis
                works[k].agreeing += 1
        if segment.started != NOT_STARTED:
            first = works[works[s].chain]
            first.least_tilt = min(first.least_tilt, segment.P[0, 0] + segment.P[1, 1])


@compiled
def _place(p_w: FloatArray, wearing: Wearing, q_wb: FloatArray, root_position: FloatArray) -> None:
    """Fill p_w (n, 3), m, with the proximal joints.

    The device that measures a position places them; without one the root is at the origin.
    """
    carrier, shift = wearing.root_device[0], np.zeros(3)
    joint_positions_into(p_w, wearing.parents, wearing.offsets, q_wb, shift)
    if carrier >= 0:
        quaternion.rotate_into(shift, q_wb[carrier], wearing.root_arm)
        for i in range(3):
            shift[i] = root_position[i] - p_w[carrier, i] - shift[i]
        for s in range(len(p_w)):
            for i in range(3):
                p_w[s, i] += shift[i]


@compiled
def mark_unaided(body: Body, state: State, tuning: Tuning, work: Work, status: StatusArray) -> None:
    """Mark segments of chains that have lost all their local devices.

    ``status`` (n,) becomes UNAIDED, in place, where it is MEASURED or INTERPOLATED.
    """
    links, works = body.segments, work.segments
    for s in range(len(links)):
        now, p = works[s], links[s].parent
        now.chain, now.sharing = s, 0  # 1: aided by nothing any more, 2: by a device
        if p >= 0:
            now.chain = works[p].chain
    for d in range(len(body.devices)):
        mount, device = body.devices[d], state.devices[d]
        is_starting = device.age_s == math.inf and work.shared.time_s < tuning.device_start_s
        is_aiding = mount.kind == FIXED_POINT or has_reported(device, tuning) or is_starting
        first = works[works[mount.segment].chain]
        first.sharing = max(first.sharing, 2 if is_aiding else 1)
    for s in range(len(links)):
        if works[works[s].chain].sharing == 1 and status[s] <= INTERPOLATED:
            status[s] = UNAIDED
