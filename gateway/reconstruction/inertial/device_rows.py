"""Rows of local devices: the acceleration of a point of the body is known. Compiled."""

from __future__ import annotations

from gateway.frames import FloatArray, Quantity
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial import chain_rows
from gateway.reconstruction.inertial.chain_averages import felt_into
from gateway.reconstruction.inertial.chain_state import (
    Body,
    Device,
    Heading,
    Segment,
    SegmentWork,
    State,
    Validity,
    Work,
    World,
)
from gateway.reconstruction.inertial.heading_start import (
    gather_heading,
    shown_heading,
    tilt_spread,
    turn_beyond,
)
from gateway.reconstruction.inertial.lever_arms import learn_device, learn_fixed_point
from gateway.reconstruction.inertial.local_rows import find_local_pair, note_frame
from gateway.reconstruction.inertial.tree_filter import add_own
from gateway.reconstruction.inertial.tuning import Tuning

AIR_VELOCITY, FIXED_POINT = Quantity.AIR_VELOCITY.value, Quantity.FIXED_POINT.value
FORCE = Validity.FORCE.value
OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value


@compiled
def device_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Rows of all local devices; marks the segments that one of them aids."""
    time_s = work.shared.time_s
    for d in range(len(body.devices)):
        mount, device = body.devices[d], state.devices[d]
        segment, now = state.segments[mount.segment], work.segments[mount.segment]
        device.age_s += dt
        if now.validity < FORCE:
            continue
        if device.covariance[0, 0] == 0.0:
            for i in range(3):
                device.covariance[i, i] = tuning.lever_arm_offset**2
                device.covariance[3 + i, 3 + i] = tuning.force_bias**2
        if mount.kind == FIXED_POINT:
            now.aided = 1  # also while its row waits for the averages
            if segment.averages.seconds > tuning.settled * tuning.smoothing_s:
                _fixed_row(body, state, tuning, work, d, dt)
            continue
        note_frame(device, segment, now, tuning, time_s)
        if find_local_pair(work.shared.pair, device, mount, body.world, tuning, time_s):
            _moving_row(body, state, tuning, work, d)
        if has_spoken(device, tuning) and is_telling(device, tuning):
            now.aided = 1


@compiled
def has_spoken(device: Device, tuning: Tuning) -> bool:
    """Whether a device has told something of late, as its readings follow each other."""
    n, longest_s = device.n_readings, tuning.device_aids_s
    if n > 1:
        longest_s = max(longest_s, 1.5 * (device.readings[n - 1].time_s - device.readings[n - 2].time_s))
    return bool(device.age_s < longest_s)


@compiled
def is_telling(device: Device, tuning: Tuning) -> bool:
    """Whether a device tells more of the mean acceleration than that it is small."""
    return bool(device.fit_density < tuning.unaided_speed**2 / tuning.unaided_window_s)


@compiled
def _fixed_row(body: Body, state: State, tuning: Tuning, work: Work, d: int, dt: float) -> None:
    """A point of a segment that does not move."""
    mount, device, shared = body.devices[d], state.devices[d], work.shared
    segment, now, pair = state.segments[mount.segment], work.segments[mount.segment], shared.pair
    felt_into(pair.u, segment.averages.force, now.K, mount.arm, device.shift, 0)
    for i in range(3):
        pair.y[i] = body.world.at_rest[i]
    variance = chain_rows.row_variance(tuning, now.motion, dt)
    shared.learning.variance, shared.learning.at_once = variance, variance * dt / tuning.row_memory_s
    added = learn_fixed_point(device, segment, now, shared, tuning, dt)
    variance += added * tuning.row_memory_s / dt
    chain_rows.known_row(now, segment, pair.u, pair.y, variance, tuning)


@compiled
def _moving_row(body: Body, state: State, tuning: Tuning, work: Work, d: int) -> None:
    """A point of a segment whose acceleration is told: ``work.shared.pair``."""
    mount, device, shared = body.devices[d], state.devices[d], work.shared
    s, pair, learning = mount.segment, shared.pair, shared.learning
    segment, now = state.segments[s], work.segments[s]
    interval = min(device.age_s, pair.span_s)
    device.age_s, device.fit_density = 0.0, pair.variance * pair.span_s
    for i in range(3):
        for j in range(3):
            pair.u[i] += pair.arm[i, j] * (mount.arm[j] + device.shift[j])
    # overlapping windows share their readings, and frames with their errors
    sharing = max(1.0, pair.span_s / interval)
    learning.at_once = _variance_at_once(segment, now, pair.variance, tuning)
    learning.variance = learning.at_once * sharing
    turns_too = mount.kind == AIR_VELOCITY
    if turns_too:
        _level_only(pair.u, pair.y, body.world)
    variance = learning.variance
    is_unobserved = segment.heading == UNOBSERVED or now.turn[2] != 0.0
    if body.segments[s].parent < 0 and segment.heading == UNOBSERVED:
        uncertain = variance + tilt_spread(segment, tuning, interval)
        gather_heading(segment.heading_sums, pair.u, pair.y, uncertain, tuning, interval)
        _observe_root(body, state, tuning, work, s)
    elif not is_unobserved and not turns_too:
        variance += sharing * learn_device(device, segment, shared, tuning, interval)
    if is_unobserved:
        chain_rows.unobserved_known_row(now, pair.u, pair.y, variance)
    else:
        chain_rows.known_row(now, segment, pair.u, pair.y, variance, tuning)


@compiled
def _variance_at_once(segment: Segment, now: SegmentWork, of_fit: float, tuning: Tuning) -> float:
    """Of a single row of a moving point, (m/s²)²."""
    at_once = of_fit + tuning.specific_force**2 + (tuning.lever_arm * now.motion) ** 2
    at_once += segment.vibration.square
    return float(at_once)


@compiled
def _level_only(u: FloatArray, y: FloatArray, world: World) -> None:
    """Both sides turn with the segment: all that the row shows is where down is."""
    for i in range(3):
        u[i] += -y[i] - world.gravity[i]
        y[i] = world.at_rest[i]


@compiled
def _observe_root(body: Body, state: State, tuning: Tuning, work: Work, s: int) -> None:
    """Once shown, the heading against the world: turns the whole tree."""
    variance, angle = shown_heading(state.segments[s], tuning)
    if variance > 0.0:
        state.segments[s].heading = OBSERVED
        add_own(work.segments[s].evidence, (0.0, 0.0, 1.0), 0.0, variance)
        turn_beyond(body, state, tuning, work, s, angle)
