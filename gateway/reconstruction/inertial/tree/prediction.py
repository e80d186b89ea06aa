"""Prediction of the tree filter, and everything that turns with a segment. Compiled.

Averages: both sides of every row go through the same low-pass, which differentiates without delay. With
``W = R [ω]×``, ``R ([ω̇, ω] ⊳ r) = (dW/dt) r`` exactly, for every arm r. A first-order low-pass with time
constant τ of a derivative is the filtered lever-arm matrix ``K = (W − average(W)) / τ``: no sample of ω is
ever differenced, and both sides of an equation are delayed alike. Orientation errors in world axes hardly
change within τ, so the row counts as one about now.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray, Quantity
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.tree.clipping import hold_axes, make_up_clip, turn_as_clipped
from gateway.reconstruction.inertial.tree.compass import turn_compass
from gateway.reconstruction.inertial.tree.rates import (
    begin_gap,
    gyroscope_density,
    is_short_gap,
    mean_rate_into,
)
from gateway.reconstruction.inertial.tree.start import tilt_square, turn_heading_sums
from gateway.reconstruction.inertial.tree.state import (
    Body,
    Clip,
    Corrections,
    Heading,
    Segment,
    SegmentWork,
    SharedWork,
    Started,
    State,
    Validity,
    Work,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.velocity import turn_velocity
from gateway.reconstruction.inertial.tree.vibration import watch_vibration

OBSERVED = Heading.OBSERVED.value
AIR_VELOCITY = Quantity.AIR_VELOCITY.value
CLIP_NONE, CLIP_LEFT = Clip.NONE.value, Clip.LEFT.value
STARTS_AGAIN, NOT_STARTED = Started.AGAIN.value, Started.NO.value
FORCE, RATE, SATURATED_RATE = (
    Validity.FORCE.value,
    Validity.RATE.value,
    Validity.SATURATED_RATE.value,
)


@compiled
def predict(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Turn every started segment over dt (s) and propagate its covariances, section 3."""
    links, segments, works = body.segments, state.segments, work.segments
    for s in range(len(links)):
        segment, now, parent = segments[s], works[s], links[s].parent
        if segment.started == NOT_STARTED:
            continue
        rotation_matrix.copy_into(now.before, segment.R)
        now.tilt_before = tilt_square(segment)
        if now.validity >= RATE:
            density = _turn_as_measured(segment, now, tuning, dt)
        elif now.validity == SATURATED_RATE:
            density = turn_as_clipped(segment, now, tuning, dt)
            segment.rate_vibration.samples, segment.rate_vibration.shock = 0.0, 0.0
        else:
            density = _coast(segment, now, tuning, dt)
        now.density = density
        if segment.silent_s > tuning.longest_silence_s:
            segment.started = STARTS_AGAIN
        w, turn = now.mean_rate, work.shared.rotation
        # (3)  R ← R exp([w Δt]×)
        rotation_matrix.exponential_into(turn, w[0] * dt, w[1] * dt, w[2] * dt)
        rotation_matrix.turn_rows(segment.R, turn)
        # (4)  P ← F P Fᵀ + Q with Q = diag(q Δt, σ_β² Δt)
        propagate_own(segment.P, now.before, dt)
        for i in range(3):
            # an orientation cannot be worse than unknown: keeps a long silence finite
            segment.P[i, i] += density * dt if segment.P[i, i] < tuning.unknown_heading**2 else 0.0
            segment.P[3 + i, 3 + i] += tuning.bias_walk**2 * dt
        # (4)  C ← F_s C F_pᵀ; noise of different segments is independent
        if body.world.is_tree and parent >= 0:
            propagate(segment.C, now.before, works[parent].before, dt)


@compiled
def _turn_as_measured(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> float:
    """Set ``now.mean_rate`` by the gyroscope, (2); return its noise, (rad/s)²/Hz, (5)."""
    lasted_s, gap = _end_gap(segment, now, tuning, dt), segment.gap
    mean_rate_into(segment, now, lasted_s)
    density = gyroscope_density(now, tuning)
    if gap.cause == CLIP_LEFT:
        density += make_up_clip(segment, now, tuning, dt) / dt
    segment.silent_s = 0.0
    change, bend = 0.0, 0.0
    for i in range(3):
        step = now.angular_rate[i] - segment.rate[i]
        slope = step / lasted_s
        change += step**2
        bend += ((slope - segment.rate_slope[i]) / (0.5 * (lasted_s + dt))) ** 2
        segment.rate_slope[i], segment.rate[i] = slope, now.angular_rate[i]
    # (5)  … + ν_s ‖ω_k − ω_{k−1}‖² Δt + …
    density += gyroscope_inflation(segment, change, lasted_s) + _shock_density(segment, now, tuning, dt)
    _note_bend(segment, bend, tuning, lasted_s)
    if now.bridged_s > 0.0 and gap.cause == CLIP_NONE:
        density = _bridge(segment, now, tuning, density * lasted_s, lasted_s, bend) / dt
    gap.seconds, gap.cause = 0.0, CLIP_NONE
    return float(density)


@compiled
def _shock_density(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> float:
    """Return the last term of (5), (rad/s)²/Hz: by how much more a shock may have turned the segment."""
    seen, noise = segment.rate_vibration, tuning.gyroscope / math.sqrt(dt)
    watch_vibration(seen, now.angular_rate, now.bridged_s > 0.0, noise, tuning.rate_shock, tuning, dt)
    return float(2.0 / 3.0 * seen.shock**2 * dt)


@compiled
def _note_bend(segment: Segment, bend: float, tuning: Tuning, lasted_s: float) -> None:
    """Update the mean square of the rate's second derivative by one, (rad/s³)²; NaN: it is not known."""
    if math.isnan(bend):
        return
    if math.isnan(segment.bend_square):
        segment.bend_square = bend
    segment.bend_square += min(1.0, lasted_s / tuning.vibration_memory_s) * (bend - segment.bend_square)


@compiled
def _end_gap(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> float:
    """Return the time since the sample with which this one gives the mean rate, s.

    It is dt, or more where a silence ends. Where a gap ends, ``now.bridged_s`` is set to its length, else to
    0.
    """
    gap = segment.gap
    now.bridged_s = gap.seconds
    if gap.seconds == 0.0 or gap.cause != CLIP_NONE:
        return dt
    for i in range(3):
        if gap.seconds > tuning.longest_bridge_s:
            segment.rate_slope[i] = np.nan
        segment.rate[i] = gap.rate[i]
    return float(gap.seconds + dt)


@compiled
def _bridge(
    segment: Segment, now: SegmentWork, tuning: Tuning, variance: float, lasted_s: float, bend: float
) -> float:
    """Set ``now.mean_rate`` where a gap ends, equation (6); return the variance that the step adds, rad².

    The rate turns the segment by all it has turned since the last sample, less what the prediction has turned
    it by meanwhile. variance: of the gyroscope over ``lasted_s``, rad². bend: square of the rate's second
    derivative over the gap, (rad/s³)²; NaN: it is not known.
    """
    gap, w, memory_s = segment.gap, now.mean_rate, tuning.longest_coast_s
    known_s = 2.0 * memory_s * math.tanh(lasted_s / (2.0 * memory_s))
    is_short = gap.seconds <= tuning.longest_bridge_s
    # over a short time a rate goes evenly, over a long one it fades in between
    counts_s = lasted_s if is_short else known_s
    for i in range(3):
        now.bridge[i] = w[i] * counts_s
        w[i] = (now.bridge[i] - gap.turn[i]) / (lasted_s - gap.seconds)
    # (6) of a process that is known at both ends
    off = _rate_square(segment, tuning) * memory_s * (lasted_s - known_s)
    if not is_short:
        return float(variance + max(off - coasted_square(segment, tuning, gap.seconds), 0.0))
    gap.missed = 0.0
    if not math.isnan(bend):
        # (6a) no more than rates bend
        off = min(off, max(bend, segment.bend_square) * (lasted_s**3 / 12.0) ** 2)
    return float(variance + off)


@compiled
def _rate_square(segment: Segment, tuning: Tuning) -> float:
    """Return σ_dead² + ‖w_0‖² of (6), (rad/s)²."""
    square = tuning.dead_rate**2
    for i in range(3):
        square += (segment.gap.rate[i] - segment.bias[i]) ** 2
    return square


@compiled
def coasted_square(segment: Segment, tuning: Tuning, seconds: float) -> float:
    """Return V of (6), rad²: how far a segment is from the predicted turn after ``seconds`` of silence."""
    memory_s = tuning.longest_coast_s
    t = seconds / memory_s
    faded = math.exp(-t)
    return float(_rate_square(segment, tuning) * memory_s**2 * (t - 1.5 + 2.0 * faded - 0.5 * faded * faded))


@compiled
def _coast(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> float:
    """Set ``now.mean_rate`` of a silent module, (6); return its noise, (rad/s)²/Hz.

    What it may have turned is kept apart in ``gap.missed`` while the gap may still be bridged.
    """
    w, gap = now.mean_rate, segment.gap
    if gap.seconds == 0.0:
        # the rate below fades: what bridges the gap needs that of the last sample
        begin_gap(segment)
    for i in range(3):
        # (6)  w ← w exp(−Δt / T_c)
        w[i] = (segment.rate[i] - segment.bias[i]) * math.exp(-dt / tuning.longest_coast_s)
        segment.rate[i] = segment.bias[i] + w[i]
        gap.turn[i] += w[i] * dt
        gap.last_slope[i] = np.nan
    hold_axes(gap, now, dt)
    segment.silent_s += dt
    gap.seconds += dt
    # (6)  q Δt = V(t) − V(t − Δt)
    before = coasted_square(segment, tuning, gap.seconds - dt)
    variance = coasted_square(segment, tuning, gap.seconds) - before
    if gap.cause == CLIP_NONE:
        gap.missed += variance
        if gap.seconds <= tuning.longest_bridge_s:
            return 0.0
        variance, gap.missed = gap.missed, 0.0
    return float(variance / dt)


@compiled
def propagate(P: FloatArray, R: FloatArray, R_other: FloatArray, dt: float) -> None:
    """Propagate a covariance in place, equation (4): P ← F P F_oᵀ with F = [[I, −R Δt], [0, I]].

    P (6, 6), R (3, 3); F_o has R_other (3, 3) in the place of R.
    """
    for j in range(6):
        x, y, z = dt * P[3, j], dt * P[4, j], dt * P[5, j]
        for i in range(3):
            P[i, j] -= R[i, 0] * x + R[i, 1] * y + R[i, 2] * z
    for i in range(6):
        x, y, z = dt * P[i, 3], dt * P[i, 4], dt * P[i, 5]
        for j in range(3):
            P[i, j] -= x * R_other[j, 0] + y * R_other[j, 1] + z * R_other[j, 2]


@compiled
def propagate_own(P: FloatArray, R: FloatArray, dt: float) -> None:
    """Propagate a segment's own covariance in place, equation (4).

    P (6, 6) stays symmetric to the last bit.
    """
    for i in range(2, -1, -1):
        x, y, z = dt * R[i, 0], dt * R[i, 1], dt * R[i, 2]
        for j in range(i + 1):  # rows up to this one are as they were
            P[i, j] -= x * P[j, 3] + y * P[j, 4] + z * P[j, 5]
        for j in range(3, 6):
            P[i, j] -= x * P[3, j] + y * P[4, j] + z * P[5, j]
            P[j, i] = P[i, j]
        for j in range(i + 1):
            P[i, j] -= dt * (P[i, 3] * R[j, 0] + P[i, 4] * R[j, 1] + P[i, 5] * R[j, 2])
            P[j, i] = P[i, j]


@compiled
def turn_segments(body: Body, state: State, work: Work) -> None:
    """Turn each segment by its ``turn``, equation (1): R ← exp([δ]×) R.

    All averages and readings that are kept in world axes turn with it, and what devices have shown of
    a root's heading. What motion has shown of others is against neighbours, who mostly turn alike.
    """
    segments, works = state.segments, work.segments
    for s in range(len(segments)):
        if body.segments[s].parent < 0:
            turn_heading_sums(segments[s].heading_sums, works[s].turn[2])
    for s in range(len(segments)):
        now, segment = works[s], segments[s]
        now.compass_turn = 0.0
        if _is_turn(now.turn):
            E, averages = now.rotation, segment.averages
            rotation_matrix.exponential_into(E, now.turn[0], now.turn[1], now.turn[2])
            turn_compass(segment, now)
            rotation_matrix.turn_columns(E, segment.R)
            rotation_matrix.turn_columns(E, averages.lever_arm_matrix)
            rotation_matrix.turn(E, averages.force)
            rotation_matrix.turn(E, averages.last_force)
            turn_velocity(E, segment.velocity, body.world)
    for d in range(len(body.devices)):
        mount, device = body.devices[d], state.devices[d]
        now = works[mount.segment]
        if _is_turn(now.turn):
            if mount.kind == AIR_VELOCITY:
                for j in range(device.n_readings):
                    rotation_matrix.turn(now.rotation, device.readings[j].value)
            rotation_matrix.turn_columns(now.rotation, device.turn)


@compiled
def correct(state: State, work: Work) -> None:
    """Set ``turn`` by the orientation error δ found, and correct the bias, b ← b + β; equation (1).

    ``turn_segments`` then applies the turn. What a joint's row finds is exact for ``δ = 2 tan(θ/2)`` times
    the axis; taken for the angle itself, an error of 90° would be turned by 115°.
    """
    segments, works = state.segments, work.segments
    for s in range(len(works)):
        now = works[s]
        length = math.sqrt(now.x[0] ** 2 + now.x[1] ** 2 + now.x[2] ** 2)
        share = 2.0 * math.atan(0.5 * length) / length if length > 0.0 else 1.0
        for i in range(3):
            now.turn[i] = share * now.x[i]
            segments[s].bias[i] += now.x[3 + i]
            segments[s].compass.rate -= segments[s].R[2, i] * now.x[3 + i]


@compiled
def _is_turn(v: FloatArray) -> bool:
    return bool(v[0] != 0.0 or v[1] != 0.0 or v[2] != 0.0)


# Averages


FILLED = 20.0
"""Time constants after which nothing but rounding is missing in an average."""
FIRST_SAMPLE_S = 1e-9
"""Averages of one sample have lasted no time, but have been begun."""


@compiled
def average(state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Set ``K`` and ``motion`` of each segment whose specific force counts, section 4.

    The averages are updated in place.
    """
    gain = 1.0 - math.exp(-dt / tuning.smoothing_s)
    segments, works = state.segments, work.segments
    for s in range(len(segments)):
        segment, now = segments[s], works[s]
        averages = segment.averages
        if now.validity < FORCE:
            if not is_short_gap(segment, now, tuning):
                averages.seconds = 0.0
            continue
        _turn_into_world(segment, now, work.shared)
        is_fresh = averages.seconds == 0.0
        is_bridged = 0.0 < now.bridged_s <= tuning.longest_bridge_s and not is_fresh
        watch_vibration(
            segment.vibration, work.shared.force, is_fresh or is_bridged, tuning.vibration_floor,
            tuning.vibration_shock, tuning, dt,
        )  # fmt: skip
        if is_bridged:
            _bridge_averages(segment, now, work.shared, tuning, dt)
            continue
        if is_fresh:
            _begin_averages(segment, work.shared)
        filled = _filled(averages.seconds + dt, tuning)
        _average_forces(segment, work.shared, gain / filled)
        _average_lever_arm_matrix(segment, now, work.shared, gain / dt / filled, gain)
        averages.seconds += FIRST_SAMPLE_S if is_fresh else dt


@compiled
def _turn_into_world(segment: Segment, now: SegmentWork, shared: SharedWork) -> None:
    """Set f, R f and W of a segment in ``shared``, equation (7).

    The known constant errors of its sensors are taken off.
    """
    R, f, f_w, W = segment.R, shared.force, shared.force_world, shared.lever_arm_matrix
    x, y, z = (
        now.angular_rate[0] - segment.bias[0],
        now.angular_rate[1] - segment.bias[1],
        now.angular_rate[2] - segment.bias[2],
    )
    for i in range(3):
        f[i] = now.specific_force[i] - segment.force_bias[i]
    for i in range(3):
        f_w[i] = R[i, 0] * f[0] + R[i, 1] * f[1] + R[i, 2] * f[2]
    _lever_arm_matrix_into(W, R, x, y, z)


@compiled
def _lever_arm_matrix_into(W: FloatArray, R: FloatArray, x: float, y: float, z: float) -> None:
    """Fill W (3, 3), rad/s, with R [(x, y, z)]×, equation (7)."""
    for i in range(3):
        W[i, 0] = R[i, 1] * z - R[i, 2] * y
        W[i, 1] = R[i, 2] * x - R[i, 0] * z
        W[i, 2] = R[i, 0] * y - R[i, 1] * x


@compiled
def _begin_averages(segment: Segment, shared: SharedWork) -> None:
    averages, f_w, W = segment.averages, shared.force_world, shared.lever_arm_matrix
    averages.force_shock, averages.rate_shock = 0.0, 0.0
    for i in range(3):
        averages.force[i], averages.last_force[i] = f_w[i], f_w[i]
        for j in range(3):
            averages.lever_arm_matrix[i, j] = W[i, j]


@compiled
def _average_forces(segment: Segment, shared: SharedWork, gain: float) -> None:
    averages, f_w = segment.averages, shared.force_world
    # (12b) h̄
    averages.force_shock += gain * (segment.vibration.shock - averages.force_shock)
    averages.rate_shock += gain * (segment.rate_vibration.shock - averages.rate_shock)
    for i in range(3):
        # (10) both sides are delayed alike: the mean over the step, as the difference of W is
        averages.force[i] += gain * (0.5 * (f_w[i] + averages.last_force[i]) - averages.force[i])
        averages.last_force[i] = f_w[i]


@compiled
def _average_lever_arm_matrix(
    segment: Segment, now: SegmentWork, shared: SharedWork, per_s: float, gain: float
) -> None:
    """Set ``now.K`` and ``now.motion`` and update the average, equations (8), (9) and (11).

    per_s: λ / (φ Δt) of (9), 1/s. gain: λ of (8).
    """
    mean, W, K, square = segment.averages.lever_arm_matrix, shared.lever_arm_matrix, now.K, 0.0
    for i in range(3):
        for j in range(3):
            # (9)  K = λ / (φ Δt) (W − W̄ of before)
            K[i, j] = per_s * (W[i, j] - mean[i, j])
            # (8)  W̄ ← W̄ + λ (W − W̄)
            mean[i, j] += gain * (W[i, j] - mean[i, j])
            square += K[i, j] ** 2
    # (11) μ = √(½ ‖K‖²)
    now.motion = math.sqrt(0.5 * square)


@compiled
def _bridge_averages(
    segment: Segment, now: SegmentWork, shared: SharedWork, tuning: Tuning, dt: float
) -> None:
    """Apply (8) to (11) to the sample that ends a gap.

    Both sides are taken to have gone evenly from the sample before the gap to this one. (9) holds for equal
    steps only. After a longer one K itself is carried on, and W̄ is set to what (9) expects of it at the next
    step of dt (s).
    """
    averages, W, last, lasted_s = segment.averages, shared.lever_arm_matrix, now.rotation, dt + now.bridged_s
    gain = 1.0 - math.exp(-lasted_s / tuning.smoothing_s)
    filled = _filled(averages.seconds + lasted_s, tuning)
    _average_forces(segment, shared, gain / filled)
    rate, bias, turn = segment.gap.rate, segment.bias, shared.rotation
    rotation_matrix.exponential_into(turn, -now.bridge[0], -now.bridge[1], -now.bridge[2])
    rotation_matrix.multiply_into(now.before, segment.R, turn)
    _lever_arm_matrix_into(last, now.before, rate[0] - bias[0], rate[1] - bias[1], rate[2] - bias[2])
    faded = math.exp(-dt / tuning.smoothing_s)
    per_s = (1.0 - faded) / dt / faded
    mean, K, square = averages.lever_arm_matrix, now.K, 0.0
    for i in range(3):
        for j in range(3):
            carried = (1.0 - gain) * per_s * (last[i, j] - mean[i, j])
            changed = carried + gain / lasted_s * (W[i, j] - last[i, j])
            K[i, j] = changed / filled
            mean[i, j] = W[i, j] - changed / per_s
            square += K[i, j] ** 2
    now.motion = math.sqrt(0.5 * square)
    averages.seconds += lasted_s


@compiled
def _filled(lasted_s: float, tuning: Tuning) -> float:
    """Return φ of (9): the part of the low-pass that has been filled since it was begun.

    Divided by it, both sides are means over that time alone: what the averages were begun with is not in
    them, neither after a gap nor where a recording begins in motion.
    """
    if lasted_s > FILLED * tuning.smoothing_s:
        return 1.0
    return 1.0 - math.exp(-lasted_s / tuning.smoothing_s)


@compiled
def felt_into(
    u: FloatArray, force: FloatArray, K: FloatArray, arm: FloatArray, error: FloatArray, first: int
) -> None:
    """Fill u (3,) with the specific force at ``arm + error[first:first + 3]``, m/s², world, equation (18).

    force: of the module, averaged, world. arm, error: from the module, segment axes, m.
    """
    for i in range(3):
        u[i] = force[i]
        for j in range(3):
            u[i] += K[i, j] * (arm[j] + error[first + j])


# What the filter's own corrections say of its settings: what it believes too much
#
# Corrections of a filter whose noises are right are new each time. One that believes its gyroscopes too much
# corrects in the same direction again and again; one that believes its rows too much goes to and fro (Kailath
# 1968, Mehra 1970). So the tilt's corrections, summed over half a second, are compared with those of
# the half before. Where they go on, gyroscopes are taken to be off by part of what their rates change by from
# sample to sample: sampled too slowly for the motion, or shaken. Where they go to and fro, as with modules
# that move on their segments, joints count for less. Neither is known beforehand. Headings are shown too
# slowly for that.


@compiled
def note_corrections(state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Pass corrections of tilts to ``note_correction``.

    Only segments count whose chain is aided and whose heading is observed.
    """
    segments, works = state.segments, work.segments
    for s in range(len(works)):
        segment, now = segments[s], works[s]
        if now.validity == FORCE and works[now.chain].aided and segment.heading == OBSERVED:
            note_correction(segment.corrections, now.x[0], now.x[1], tuning, dt)


@compiled
def note_correction(seen: Corrections, x: float, y: float, tuning: Tuning, dt: float) -> None:
    """Update the noise inflations of gyroscope and joint rows by one correction, equations (58) to (61).

    x, y: rotation about the horizontal world axes by which the segment was corrected, rad. dt: s since the
    one before.
    """
    now, before = seen.sums, seen.sums_before
    now[0] += x
    now[1] += y
    seen.seconds += dt
    if seen.seconds < tuning.correction_block_s:
        return
    # (58) γ, θ over blocks
    gain = 1.0 - math.exp(-seen.seconds / tuning.correction_memory_s)
    square = 0.5 * (now[0] ** 2 + now[1] ** 2 + before[0] ** 2 + before[1] ** 2)
    seen.product += gain * (now[0] * before[0] + now[1] * before[1] - seen.product)
    seen.square += gain * (square - seen.square)
    if seen.square > 0.0:
        # (59) Δ = 0.05 γ / θ
        step = tuning.correction_gain * seen.product / seen.square
        # (60) ν_s
        seen.gyroscope = min(1.0, max(0.0, seen.gyroscope + step))
        # (61) χ_s
        seen.rows = min(1.0, max(0.0, seen.rows - step))
    for i in range(2):
        before[i], now[i] = now[i], 0.0
    seen.seconds = 0.0


@compiled
def gyroscope_inflation(segment: Segment, square: float, dt: float) -> float:
    """Return the last term of (5), (rad/s)²/Hz, by which the gyroscope's noise is raised.

    square: of the change of its rate over dt (s), (rad/s)².
    """
    return float(segment.corrections.gyroscope * square * dt)


@compiled
def row_inflation(child: Segment, parent: Segment, tuning: Tuning) -> float:
    """Return 1 + 2 max(χ_s, χ_p) of (20), the factor on the variance of a joint's row."""
    return float(1.0 + tuning.row_inflation * max(child.corrections.rows, parent.corrections.rows))
