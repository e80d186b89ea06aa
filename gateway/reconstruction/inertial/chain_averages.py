"""Both sides of every row go through the same low-pass, which differentiates without delay. Compiled.

With ``W = R [ω]×``, ``R ([ω̇, ω] ⊳ r) = (dW/dt) r`` exactly, for every arm r. A first-order low-pass with
time constant τ of a derivative is the filtered lever-arm matrix ``K = (W − average(W)) / τ``: no sample of ω
is ever differenced, and both sides of an equation are delayed alike. Orientation errors in world axes hardly
change within τ, so the row counts as one about now.
"""

from __future__ import annotations

import math

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot
from gateway.reconstruction.inertial.chain_state import (
    RestWatch,
    Segment,
    SegmentWork,
    SharedWork,
    State,
    Validity,
    Work,
)
from gateway.reconstruction.inertial.tuning import Tuning
from gateway.reconstruction.inertial.vibration import watch_vibration

FORCE = Validity.FORCE.value
FIRST_SAMPLE_S = 1e-9
"""Averages of one sample have lasted no time, but have been begun."""


@compiled
def average(state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """``K`` and ``motion`` ← of each segment whose specific force counts. In place, too: the averages."""
    gain = 1.0 - math.exp(-dt / tuning.smoothing_s)
    long_gain = 1.0 - math.exp(-dt / tuning.unaided_window_s)
    segments, works = state.segments, work.segments
    for s in range(len(segments)):
        segment, now = segments[s], works[s]
        averages = segment.averages
        if now.validity < FORCE:
            averages.seconds = 0.0
            continue
        is_fresh = averages.seconds == 0.0
        _turn_into_world(segment, now, work.shared)
        watch_vibration(segment.vibration, work.shared.force, is_fresh, tuning, dt)
        if is_fresh:
            _begin_averages(segment, work.shared)
        filled = _filled(averages.seconds + dt, tuning)
        mean_gain = max(long_gain, dt / (averages.seconds + dt))
        _average_forces(segment, work.shared, gain / filled, mean_gain)
        _average_lever_arm_matrix(segment, now, work.shared, gain / dt / filled, gain)
        averages.seconds += FIRST_SAMPLE_S if is_fresh else dt


@compiled
def _turn_into_world(segment: Segment, now: SegmentWork, shared: SharedWork) -> None:
    """``f``, ``R f`` and ``W = R [ω]×`` of a segment, free of the constant errors that are known."""
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
        W[i, 0] = R[i, 1] * z - R[i, 2] * y
        W[i, 1] = R[i, 2] * x - R[i, 0] * z
        W[i, 2] = R[i, 0] * y - R[i, 1] * x


@compiled
def _begin_averages(segment: Segment, shared: SharedWork) -> None:
    averages, f_w, W = segment.averages, shared.force_world, shared.lever_arm_matrix
    for i in range(3):
        averages.force[i], averages.last_force[i], averages.long_force[i] = f_w[i], f_w[i], f_w[i]
        for j in range(3):
            averages.lever_arm_matrix[i, j] = W[i, j]


@compiled
def _average_forces(segment: Segment, shared: SharedWork, gain: float, long_gain: float) -> None:
    averages, f_w = segment.averages, shared.force_world
    for i in range(3):
        # the mean over the step, as the difference of W is
        averages.force[i] += gain * (0.5 * (f_w[i] + averages.last_force[i]) - averages.force[i])
        averages.last_force[i] = f_w[i]
        averages.long_force[i] += long_gain * (f_w[i] - averages.long_force[i])


@compiled
def _average_lever_arm_matrix(
    segment: Segment, now: SegmentWork, shared: SharedWork, per_s: float, gain: float
) -> None:
    """``now.K``, ``now.motion`` ← by the average's own change, ``per_s`` of the difference."""
    mean, W, K, square = segment.averages.lever_arm_matrix, shared.lever_arm_matrix, now.K, 0.0
    for i in range(3):
        for j in range(3):
            K[i, j] = per_s * (W[i, j] - mean[i, j])
            mean[i, j] += gain * (W[i, j] - mean[i, j])
            square += K[i, j] ** 2
    now.motion = math.sqrt(0.5 * square)


@compiled
def _filled(lasted_s: float, tuning: Tuning) -> float:
    """Part of the low-pass that has been filled since it was begun.

    Divided by it, both sides are means over that time alone: what the averages were begun with is not in
    them, neither after a gap nor where a recording begins in motion.
    """
    if lasted_s > tuning.filled * tuning.smoothing_s:
        return 1.0
    return 1.0 - math.exp(-lasted_s / tuning.smoothing_s)


@compiled
def felt_into(
    u: FloatArray, force: FloatArray, K: FloatArray, arm: FloatArray, error: FloatArray, first: int
) -> None:
    """u (3,) m/s², world ← specific force at ``arm + error[first:]`` from a module that feels ``force``."""
    for i in range(3):
        u[i] = force[i]
        for j in range(3):
            u[i] += K[i, j] * (arm[j] + error[first + j])


@compiled
def watch_rest(rest: RestWatch, now: SegmentWork, tuning: Tuning, gain: float, dt: float) -> bool:
    """Whether a segment has rested for a while; ``rest.rate`` is then the gyroscope's bias.

    gain: of a low-pass of ``rest_window_s`` over dt.
    """
    rate_change, force_change = 0.0, 0.0
    for i in range(3):
        off_rate, off_force = now.angular_rate[i] - rest.rate[i], now.specific_force[i] - rest.force[i]
        rate_change += off_rate * off_rate
        force_change += off_force * off_force
        rest.rate[i] += gain * off_rate
        rest.force[i] += gain * off_force
    rest.rate_square += gain * (rate_change - rest.rate_square)
    rest.force_square += gain * (force_change - rest.force_square)
    is_still = rest.rate_square < tuning.rest_rate**2 and rest.force_square < tuning.rest_force**2
    is_still = is_still and dot(rest.rate, rest.rate) < tuning.largest_bias**2
    rest.still_s = rest.still_s + dt if is_still else 0.0
    return bool(rest.still_s > tuning.rest_s)
