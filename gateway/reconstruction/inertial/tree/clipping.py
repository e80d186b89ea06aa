"""Sensors at the end of their range: which samples count, and what a clipped gyroscope has missed. Compiled.

Marks of the ends of ranges come with the samples; ``gateway.stages.clipping`` finds those that a module does
not tell.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import Clipped, FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, is_finite
from gateway.reconstruction.inertial.tree.rates import begin_gap, gyroscope_density, mean_rate_into
from gateway.reconstruction.inertial.tree.state import Clip, Gap, Segment, SegmentWork, State, Validity, Work
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import Three

SAME_END = 0.95
"""Of the largest axis of a clipped gyroscope, from where another is clipped too: skewed axes differ."""
RATE_CLIPPED, FORCE_CLIPPED = Clipped.ANGULAR_RATE.value, Clipped.SPECIFIC_FORCE.value
CLIP_LASTS, CLIP_LEFT = Clip.LASTS.value, Clip.LEFT.value
FORCE, NOTHING, RATE, SATURATED_RATE = (
    Validity.FORCE.value,
    Validity.NOTHING.value,
    Validity.RATE.value,
    Validity.SATURATED_RATE.value,
)


@compiled
def judge_samples(state: State, work: Work, tuning: Tuning) -> None:
    """Set ``validity`` of each segment to what of its module's sample counts.

    A sensor is at the end of its range where its module says so, and at the largest range of any sensor.
    """
    works = work.segments
    for s in range(len(works)):
        now, gap = works[s], state.segments[s].gap
        now.validity, now.is_felt = NOTHING, 0
        if now.status <= 1 and is_finite(now.angular_rate):
            now.validity = RATE
            if is_finite(now.specific_force) and now.clipped & FORCE_CLIPPED == 0:
                now.is_felt = 0 if exceeds(now.specific_force, tuning.largest_force) else 1
            if exceeds(now.angular_rate, tuning.largest_rate) or now.clipped & RATE_CLIPPED > 0:
                now.validity = SATURATED_RATE
            elif now.is_felt:
                now.validity = FORCE
        if now.validity == SATURATED_RATE:
            gap.cause = CLIP_LASTS
        elif now.validity >= RATE and gap.cause == CLIP_LASTS:
            # what the gyroscope has missed is known with the slope of its rate, from the next sample on
            gap.cause, now.validity = CLIP_LEFT, SATURATED_RATE
        elif now.validity == NOTHING and gap.cause == CLIP_LEFT:
            gap.cause = CLIP_LASTS


@compiled
def exceeds(v: FloatArray, limit: float) -> bool:
    """Return whether a component of v (3,) reaches the limit, either way."""
    return bool(abs(v[0]) >= limit or abs(v[1]) >= limit or abs(v[2]) >= limit)


@compiled
def is_at_end(rate: FloatArray) -> Three:
    """Return 1 for each axis of a clipped gyroscope that is at the end of its range, else 0.

    They are the largest one of its rate (3,), module axes, and those as large.
    """
    least = SAME_END * max(abs(rate[0]), abs(rate[1]), abs(rate[2]))
    return (
        1.0 if abs(rate[0]) >= least else 0.0,
        1.0 if abs(rate[1]) >= least else 0.0,
        1.0 if abs(rate[2]) >= least else 0.0,
    )


@compiled
def turn_as_clipped(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> float:
    """Set ``now.mean_rate`` by a gyroscope at the end of its range, (2); return its noise, (rad/s)²/Hz.

    An axis that has been within its range again for two samples is made up for at once. What others miss is
    kept apart, as variance in ``gap.missed``, until more can be said.
    """
    gap = segment.gap
    if gap.seconds == 0.0:
        begin_gap(segment)
    mean_rate_into(segment, now, dt)
    density = gyroscope_density(now, tuning)
    if math.isnan(gap.last_slope[0]):  # a silence came before
        density, gap.missed = density + gap.missed / dt, 0.0
    _follow_axes(segment, now, tuning, dt)
    for i in range(3):
        gap.turn[i] += now.mean_rate[i] * dt
        gap.last_slope[i] = (now.angular_rate[i] - segment.rate[i]) / dt
        segment.rate[i], segment.rate_slope[i] = now.angular_rate[i], np.nan
    gap.missed -= missed_square(segment, tuning)
    gap.seconds += dt
    segment.silent_s += dt
    gap.missed += missed_square(segment, tuning)
    lasted_s = max(gap.clip_s[0], gap.clip_s[1], gap.clip_s[2])
    if lasted_s > tuning.longest_clip_s or lasted_s == 0.0:
        density += gap.missed / dt
        gap.missed = 0.0
    return density


@compiled
def _follow_axes(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> None:
    """Follow each axis of the gyroscope through the end of its range, for a step of dt (s).

    ``now.mean_rate`` is given what (70) finds for an axis whose second rate is within the range.
    """
    gap, w = segment.gap, now.mean_rate
    for k in range(3):
        ends = now.clipped_axes[k]
        is_clipped = ends[0] != 0.0 or ends[1] != 0.0 or ends[2] != 0.0
        if is_clipped and gap.clip_left[k] > 1.0:
            for i in range(3):
                gap.clipped_axes[k, i], gap.clip_mean[k, i] = ends[i], 0.0
            gap.clip_rate[k], gap.clip_slope[k] = dot(ends, segment.rate), dot(ends, gap.last_slope)
            gap.clip_turn[k] = 0.0
        gap.clip_left[k] = 0.0 if is_clipped else min(gap.clip_left[k] + 1.0, 3.0)
    _turn_axes(gap, now, dt)
    for k in range(3):
        if gap.clip_left[k] == 2.0:
            along, lasted_s = _missed_about(segment, now, k, tuning, dt), gap.clip_s[k]
            gap.clip_s[k] = 0.0
            gap.made_up += along**2
            for i in range(3):
                w[i] += gap.clip_mean[k, i] / lasted_s * along / dt


@compiled
def _turn_axes(gap: Gap, now: SegmentWork, dt: float) -> None:
    """Follow what (70) knows of clipped axes while ``now.mean_rate`` turns the segment for a step of dt (s).

    Where they were stays in the world. Of those back for their second sample it is left at the step's middle.
    """
    w, half = now.mean_rate, now.rotation
    rotation_matrix.exponential_into(half, -0.5 * w[0] * dt, -0.5 * w[1] * dt, -0.5 * w[2] * dt)
    for k in range(3):
        axis, mean = gap.clipped_axes[k], gap.clip_mean[k]
        rotation_matrix.turn(half, mean)
        if gap.clip_left[k] < 2.0:
            for i in range(3):
                mean[i] += axis[i] * dt
            rotation_matrix.turn(half, mean)
            gap.clip_turn[k] += dot(axis, w) * dt
            gap.clip_s[k] += dt


@compiled
def hold_axes(gap: Gap, now: SegmentWork, dt: float) -> None:
    """Let axes stay at the end of their range over a lost sample of dt (s)."""
    for k in range(3):
        if gap.clip_left[k] < 2.0:
            gap.clip_left[k] = 0.0
    _turn_axes(gap, now, dt)


@compiled
def _missed_about(segment: Segment, now: SegmentWork, k: int, tuning: Tuning, dt: float) -> float:
    """Return what the gyroscope has missed about its axis k, rad, (70); ``gap.is_lost``: that is unknown."""
    gap, axis = segment.gap, segment.gap.clipped_axes[k]
    if gap.clip_s[k] > tuning.longest_clip_s or not math.isfinite(gap.clip_slope[k]):
        gap.is_lost = 1
        return 0.0
    last = dot(axis, segment.rate)
    slope = (dot(axis, now.angular_rate) - last) / dt
    bias = dot(axis, segment.bias)
    return float(
        missed_angle(
            gap.clip_rate[k] - bias, gap.clip_slope[k], last - bias, slope, gap.clip_turn[k], gap.clip_s[k]
        )
    )


@compiled
def missed_square(segment: Segment, tuning: Tuning) -> float:
    """Return V_c of (69), rad², of what a gyroscope at the end of its range may have missed by now."""
    gap, slope_square = segment.gap, 0.0
    for i in range(3):
        slope_square += gap.slope[i] ** 2
    noise = tuning.saturated_noise**2 * gap.seconds
    if not math.isfinite(slope_square):
        return float(noise)
    return float(min(slope_square * gap.seconds**4 / 9.0, noise))


@compiled
def make_up_clip(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> float:
    """Add to ``now.mean_rate`` what the gyroscope has missed at the end of its range, (70).

    Return the variance that the step adds, rad². The rate of an axis is taken to have gone as the cubic
    through values and slopes at both ends.
    """
    gap, w = segment.gap, now.mean_rate
    _follow_axes(segment, now, tuning, dt)
    for i in range(3):
        now.bridge[i] = gap.turn[i] + w[i] * dt
    variance = tuning.missed_share**2 * gap.made_up
    # a cubic that says that nothing was missed does not fit
    if gap.is_lost or gap.made_up == 0.0:
        variance += gap.missed
    gap.missed = 0.0
    return float(variance)


@compiled
def missed_angle(
    rate: float, slope: float, last_rate: float, last_slope: float, shown: float, lasted_s: float
) -> float:
    """Return what a gyroscope at the end of its range has missed about an axis, rad, (70); 0: nothing.

    The rate is taken for the cubic through rates, rad/s, and slopes, rad/s², before and after: it is made up
    for outward alone. shown: rad, what the gyroscope did show. lasted_s: between the two rates.
    """
    # (70)  T / 2 (ω_0 + ω_1) + T² / 12 (ω̇_0 − ω̇_1)
    whole = lasted_s * 0.5 * (rate + last_rate) + lasted_s**2 / 12.0 * (slope - last_slope)
    along = whole - shown
    return along if along * shown > 0.0 else 0.0
