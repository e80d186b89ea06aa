"""Local devices in the tree filter: the acceleration of a point of the body is known. Compiled.

A derivative of the readings by least squares over a window is ``Σ w_i p(t_i)``, and for every motion
whatever that is ``∫ K(t) a(t) dt`` with the kernel ``K(t) = Σ w_i (t_i − t)₊`` (Peano; for velocities a step
in place of the ramp). So the module's side of the row is its own acceleration averaged with the same kernel:
neither delay nor bandwidth of the fit is an error of the row, only the readings' noise is, ``σ² Σ w_i²``.
Where the device sits off the module, ``Σ w_i R(t_i) r`` is what the arm adds (of velocities
``Σ w_i R [ω(t_i)]× r``), again without any derivative of ω. Accelerations are summed to velocities over the
window first.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray, Quantity
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.reconstruction.inertial.tree.lever_arms import learn_device, learn_fixed_point
from gateway.reconstruction.inertial.tree.prediction import felt_into
from gateway.reconstruction.inertial.tree.rows import known_row, row_variance, unobserved_known_row
from gateway.reconstruction.inertial.tree.start import gather_heading, shown_heading, tilt_spread, turn_beyond
from gateway.reconstruction.inertial.tree.state import (
    N_HISTORY,
    N_READINGS,
    Body,
    Device,
    Heading,
    LocalPair,
    Mount,
    PastFrame,
    Segment,
    SegmentWork,
    State,
    Validity,
    Work,
    World,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import add_own
from gateway.reconstruction.inertial.tree.vibration import shock_variance

OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value
ACCELERATION, AIR_VELOCITY, FIXED_POINT, POSITION, VELOCITY = (
    Quantity.ACCELERATION.value,
    Quantity.AIR_VELOCITY.value,
    Quantity.FIXED_POINT.value,
    Quantity.POSITION.value,
    Quantity.VELOCITY.value,
)
FORCE = Validity.FORCE.value


# Rows


@compiled
def device_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Add the rows of all local devices and mark the segments that one of them aids, section 7."""
    time_s = work.shared.time_s
    for d in range(len(body.devices)):
        mount, device = body.devices[d], state.devices[d]
        segment, now = state.segments[mount.segment], work.segments[mount.segment]
        device.age_s += dt
        if now.validity < FORCE:
            continue
        if now.bridged_s > tuning.longest_bridge_s:
            _forget_frames(device)
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
        if has_reported(device, tuning) and is_informative(device, tuning):
            now.aided = 1


@compiled
def has_reported(device: Device, tuning: Tuning) -> bool:
    """Return whether a row has come from the device lately.

    How lately depends on the time between its last two readings.
    """
    n, longest_s = device.n_readings, tuning.device_aids_s
    if n > 1:
        longest_s = max(longest_s, 1.5 * (device.readings[n - 1].time_s - device.readings[n - 2].time_s))
    return bool(device.age_s < longest_s)


@compiled
def is_informative(device: Device, tuning: Tuning) -> bool:
    """Return whether the device shows the mean acceleration better than (40) does with a usual speed."""
    return bool(device.fit_density < tuning.unaided_speed**2 / tuning.unaided_memory_s)


@compiled
def _fixed_row(body: Body, state: State, tuning: Tuning, work: Work, d: int, dt: float) -> None:
    """Add the row of a point of a segment that does not move, equations (14) and (18)."""
    mount, device, shared = body.devices[d], state.devices[d], work.shared
    segment, now, pair = state.segments[mount.segment], work.segments[mount.segment], shared.pair
    # (18) u_s at the device, y = −g
    felt_into(pair.u, segment.averages.force, now.K, mount.arm, device.shift, 0)
    for i in range(3):
        pair.y[i] = body.world.at_rest[i]
    variance = row_variance(tuning, now.motion, dt)
    # (20) … + ρ_s + η_s
    variance += segment.vibration.square + shock_variance(segment, mount.arm, tuning, dt)
    shared.learning.variance, shared.learning.at_once = variance, variance * dt / tuning.row_memory_s
    added = learn_fixed_point(device, segment, now, shared, tuning, dt)
    # (20) … + α_s max(1, 1 s / Δt)
    variance += added * max(1.0, tuning.tilt_memory_s / dt)
    known_row(now, segment, pair.u, pair.y, variance, tuning)


@compiled
def _moving_row(body: Body, state: State, tuning: Tuning, work: Work, d: int) -> None:
    """Add the row of a point whose acceleration is measured; equations (14), (25) and (26).

    ``work.shared.pair`` has its two sides.
    """
    mount, device, shared = body.devices[d], state.devices[d], work.shared
    s, pair, learning = mount.segment, shared.pair, shared.learning
    segment, now = state.segments[s], work.segments[s]
    interval = min(device.age_s, pair.span_s)
    device.age_s, device.fit_density = 0.0, pair.variance * pair.span_s
    for i in range(3):
        for j in range(3):
            # (25) … + (Σ w_i R(t_i)) (r_d + e_d)
            pair.u[i] += pair.arm[i, j] * (mount.arm[j] + device.shift[j])
    # overlapping windows share their readings, and frames with their errors
    # (26) max(1, T_d / Δt_d)
    sharing = max(1.0, pair.span_s / interval)
    learning.at_once = _variance_at_once(segment, now, pair, tuning)
    learning.variance = learning.at_once * sharing
    turns_too = mount.kind == AIR_VELOCITY
    if turns_too:
        _level_only(pair.u, pair.y, body.world)
    variance = learning.variance
    is_unobserved = segment.heading == UNOBSERVED or now.turn[2] != 0.0
    if not turns_too and _shows_world(body, state, tuning, work, s, interval):
        is_unobserved = True
    if is_unobserved:
        unobserved_known_row(now, pair.u, pair.y, variance)
        return
    if not turns_too:
        variance += sharing * learn_device(device, segment, shared, tuning, interval)
    known_row(now, segment, pair.u, pair.y, variance, tuning)


@compiled
def _variance_at_once(segment: Segment, now: SegmentWork, pair: LocalPair, tuning: Tuning) -> float:
    """Return the first factor of (26), (m/s²)²: the variance of a single row of a moving point."""
    at_once = pair.variance + tuning.specific_force**2 + (tuning.lever_arm * now.motion) ** 2
    at_once += segment.vibration.square + pair.shock**2 / 3.0
    return float(at_once)


@compiled
def _level_only(u: FloatArray, y: FloatArray, world: World) -> None:
    """Reduce the two sides of an air velocity's row, in place, to what they show of the vertical.

    Both sides turn with the segment, so a row of them shows nothing else.
    """
    for i in range(3):
        u[i] += -y[i] - world.gravity[i]
        y[i] = world.at_rest[i]


@compiled
def _shows_world(body: Body, state: State, tuning: Tuning, work: Work, s: int, interval_s: float) -> bool:
    """Gather what a device on segment s shows of its tree's heading in the world, while that is unobserved.

    Equations (54) and (55); ``work.shared.pair`` and ``learning`` have the device's row. Once the heading is
    shown the whole tree turns to it. Returns whether it was unobserved: such a row must not count as if it
    was known.
    """
    root = _root_that_turns_with(body, state, s)
    if root < 0 or state.segments[root].heading == OBSERVED:
        return False
    segment, sums, pair = state.segments[s], state.segments[root].heading_sums, work.shared.pair
    if work.segments[s].turn[2] == 0.0:
        # (26) has counted already that readings share errors: the density, which counts that again, is undone
        learning, density = work.shared.learning, tuning.heading_density
        uncertain = learning.variance + tilt_spread(segment, tuning, interval_s)
        share = density * learning.at_once / learning.variance
        gather_heading(sums, pair.u, pair.y, uncertain / density, share, tuning, interval_s)
        variance, angle = shown_heading(sums, tuning)
        if variance > 0.0:
            state.segments[root].heading = OBSERVED
            add_own(work.segments[root].evidence, (0.0, 0.0, 1.0), 0.0, variance)
            turn_beyond(body, state, tuning, work, root, angle)
    return True


@compiled
def _root_that_turns_with(body: Body, state: State, s: int) -> int:
    """Return the root of segment s if all headings between the two are observed; else −1.

    In ``outward``, where nothing is handed back to a root, only a root itself has one.
    """
    links = body.segments
    while links[s].parent >= 0:
        if state.segments[s].heading == UNOBSERVED or not body.world.is_tree:
            return -1
        s = links[s].parent
    return s


# From readings to an acceleration


LEAST_READINGS = 4


@compiled
def _choose_window(device: Device, kind: int, sigma: float, tuning: Tuning) -> float:
    """Return the span of the device's readings for a fit, s: the less certain they are, the longer.

    n readings of standard deviation σ within T leave ``σ √(720 / n) / T²`` of an acceleration, of velocities
    ``σ √(12 / n) / T``. Air velocities and accelerations keep the shortest span. The span changes only where
    the wanted one differs by more than the factor ``local_window_change``.
    """
    wanted, change = tuning.local_window_s, tuning.local_window_change
    if kind == POSITION:
        wanted = math.sqrt(sigma * math.sqrt(720.0 / N_READINGS) / tuning.local_acceleration)
    elif kind == VELOCITY:
        wanted = sigma * math.sqrt(12.0 / N_READINGS) / tuning.local_acceleration
    wanted = min(max(wanted, tuning.local_window_s), tuning.local_longest_window_s)
    if not device.fit_span_s / change < wanted < device.fit_span_s * change:
        device.fit_span_s = wanted
    window_s: float = device.fit_span_s
    return window_s


@compiled
def take_reading(
    device: Device, kind: int, time_s: float, value: FloatArray, sigma: float, tuning: Tuning
) -> None:
    """Keep a reading of a device, unless it follows the last one much sooner than the window needs."""
    readings, n = device.readings, device.n_readings
    window_s = _choose_window(device, kind, sigma, tuning)
    if n > 0:
        since = time_s - readings[n - 1].time_s
        if since < 0.8 * window_s / (N_READINGS - 1):
            return
        if since > max(tuning.local_longest_gap_s, 0.5 * window_s):
            n = 0
    if n == N_READINGS:
        for i in range(N_READINGS - 1):
            readings[i] = readings[i + 1]
        n -= 1
    newest = readings[n]
    newest.time_s, newest.sigma = time_s, sigma
    for i in range(3):
        newest.value[i] = value[i]
    device.n_readings, device.is_waiting = n + 1, 1


@compiled
def note_frame(device: Device, segment: Segment, now: SegmentWork, tuning: Tuning, time_s: float) -> None:
    """Keep what a device's segment feels, in axes that corrections need not turn: see ``Device.turn``."""
    history, R, turn = device.history, segment.R, device.turn
    window_s = max(tuning.local_window_s, device.fit_span_s)
    if time_s - history[N_HISTORY - 1].time_s < window_s / tuning.local_frames:
        return
    for j in range(N_HISTORY - 1):
        history[j] = history[j + 1]
    newest = history[N_HISTORY - 1]
    newest.time_s, newest.shock = time_s, segment.vibration.shock
    f = np.empty(3)
    for i in range(3):
        f[i] = now.specific_force[i] - segment.force_bias[i]
        newest.rate[i] = now.angular_rate[i] - segment.bias[i]
    for i in range(3):
        newest.force[i] = 0.0
        for j in range(3):
            column = turn[0, i] * R[0, j] + turn[1, i] * R[1, j] + turn[2, i] * R[2, j]
            newest.R[i, j] = column
            newest.force[i] += column * f[j]


@compiled
def _forget_frames(device: Device) -> None:
    """Forget what the segment felt: since then it has turned by nobody knows what."""
    for j in range(N_HISTORY):
        device.history[j].time_s = -np.inf


@compiled
def find_local_pair(
    pair: LocalPair, device: Device, mount: Mount, world: World, tuning: Tuning, time_s: float
) -> bool:
    """Set ``pair`` to both sides, variance and span of a new fit, (24) and (25).

    Returns whether there is one.
    """
    n, readings = device.n_readings, device.readings
    if device.is_waiting == 0 or n < LEAST_READINGS or readings[n - 1].time_s > time_s:
        return False
    device.is_waiting = 0

    # the last readings that lie within the span, but no fewer than a fit needs
    first = max(0, n - LEAST_READINGS)
    reach = 1.05 * device.fit_span_s
    while first > 0 and readings[n - 1].time_s - readings[first - 1].time_s < reach:
        first -= 1
    t, values = np.empty(n - first), np.empty((n - first, 3))
    for k in range(n - first):
        t[k] = readings[first + k].time_s
        for i in range(3):
            values[k, i] = readings[first + k].value[i]

    order = 2 if mount.kind == POSITION else 1
    if mount.kind == ACCELERATION:
        _sum_up(t, values)
    weights = derivative_weights(t, order)
    if not _average_own_side(pair, device.history, t, weights, order, tuning.local_longest_gap_s):
        return False
    rotation_matrix.turn(device.turn, pair.u)
    rotation_matrix.turn_columns(device.turn, pair.arm)
    rotation_matrix.turn_columns(device.turn, pair.turn)

    pair.variance, pair.span_s = 0.0, t[len(t) - 1] - t[0]
    for i in range(3):
        pair.y[i] = -world.gravity[i]
    for k in range(len(t)):
        # (26) Σ w_i² σ_i²
        pair.variance += (weights[k] * readings[first + k].sigma) ** 2
        for i in range(3):
            # (25) y = Σ w_i z_i − g
            pair.y[i] += weights[k] * values[k, i]
    if mount.kind == ACCELERATION:
        pair.variance = readings[n - 1].sigma ** 2 / len(t)
    return True


@compiled
def _sum_up(t: FloatArray, values: FloatArray) -> None:
    """Integrate accelerations (n, 3) at times t (s) to velocities, by the trapezoid, from zero, in place."""
    for i in range(3):
        before, values[0, i] = values[0, i], 0.0
        for k in range(1, len(t)):
            mean, before = 0.5 * (values[k, i] + before), values[k, i]
            values[k, i] = values[k - 1, i] + (t[k] - t[k - 1]) * mean


@compiled
def derivative_weights(t: FloatArray, order: int) -> FloatArray:
    """Return weights w (n,) of (24): Σ w_i p(t_i) is the derivative of the polynomial fitted to p.

    order: 1 or 2, of both the polynomial and its derivative.
    """
    n, mean, squares, cubes, total = len(t), 0.0, 0.0, 0.0, 0.0
    for k in range(n):
        mean += t[k] / n
    weights = np.empty(n)
    for k in range(n):
        x = t[k] - mean
        squares += x * x
        cubes += x * x * x
    for k in range(n):
        x = t[k] - mean
        weights[k] = x if order == 1 else x * x - cubes / squares * x - squares / n
        total += weights[k] * weights[k]
    for k in range(n):
        weights[k] *= order / total
    return weights


@compiled
def _average_own_side(
    pair: LocalPair,
    history: Records[PastFrame],
    t: FloatArray,
    weights: FloatArray,
    order: int,
    longest_gap_s: float,
) -> bool:
    """Average u and turn of ``pair`` with the fit's kernel, and add up the arm's matrix, (25).

    Returns False where the frames do not reach back to the first reading, or have a gap longer than
    ``longest_gap_s``.
    """
    total, pair.shock = 0.0, 0.0
    for i in range(3):
        pair.u[i] = 0.0
        for j in range(3):
            pair.arm[i, j], pair.turn[i, j] = 0.0, 0.0
    if not _reaches(history, t[0]):
        return False
    for j in range(1, N_HISTORY):
        older, newer = history[j - 1], history[j]
        if older.time_s == -np.inf or newer.time_s < t[0]:
            continue
        step = newer.time_s - older.time_s
        if step > longest_gap_s:
            return False
        middle = 0.5 * (newer.time_s + older.time_s)
        kernel = 0.0
        for i in range(len(t)):
            ahead = t[i] - middle
            if ahead > 0.0:
                # (24) k(t) = Σ w_i (t_i − t)₊, for velocities a step
                kernel += weights[i] * (ahead if order == 2 else 1.0)
        _add_share(pair, older, 0.5 * kernel * step)
        _add_share(pair, newer, 0.5 * kernel * step)
        total += kernel * step
    for k in range(len(t)):
        _add_arm(pair.arm, weights[k], history, t[k], order)
    for i in range(3):
        pair.u[i] /= total  # the kernel's area is 1; what is missing was lost at the ends of the window
        for k in range(3):
            pair.turn[i, k] /= total
    return math.isfinite(total) and total > 0.5


@compiled
def _add_share(pair: LocalPair, frame: PastFrame, share: float) -> None:
    pair.shock += abs(share) * frame.shock
    for i in range(3):
        pair.u[i] += share * frame.force[i]
        for j in range(3):
            pair.turn[i, j] += share * frame.R[i, j]


@compiled
def _reaches(history: Records[PastFrame], time_s: float) -> bool:
    """Return whether the oldest frame kept is as old as that."""
    for j in range(N_HISTORY):
        if history[j].time_s > -np.inf:
            return bool(history[j].time_s <= time_s)
    return False


@compiled
def _add_arm(arm: FloatArray, weight: float, history: Records[PastFrame], time_s: float, order: int) -> None:
    """Add weight R, of velocities weight R [ω]×, at an instant to arm (3, 3), equation (25).

    Linear between two frames; the nearest frame outside them.
    """
    last = N_HISTORY - 1
    while last > 1 and history[last - 1].time_s >= time_s:
        last -= 1
    older, newer = history[last - 1], history[last]
    step = newer.time_s - older.time_s
    part = min(1.0, max(0.0, (time_s - older.time_s) / step)) if math.isfinite(step) else 1.0
    if part != 1.0:
        _add_frame(arm, weight * (1.0 - part), older, order)
    _add_frame(arm, weight * part, newer, order)


@compiled
def _add_frame(arm: FloatArray, weight: float, frame: PastFrame, order: int) -> None:
    R, w = frame.R, frame.rate
    for i in range(3):
        x, y, z = R[i, 0], R[i, 1], R[i, 2]
        if order == 1:
            a, b, c = w[0], w[1], w[2]
            x, y, z = y * c - z * b, z * a - x * c, x * b - y * a
        arm[i, 0] += weight * x
        arm[i, 1] += weight * y
        arm[i, 2] += weight * z
