"""Sensors at the end of their range: which samples count, and what a clipped gyroscope has missed. Compiled.

Marks of the ends of ranges come with the samples; ``gateway.stages.clipping`` finds those that a module does
not tell.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import Clipped, FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite
from gateway.reconstruction.inertial.tree.rates import begin_gap, gyroscope_density, mean_rate_into
from gateway.reconstruction.inertial.tree.state import Clip, Segment, SegmentWork, State, Validity, Work
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

    What it misses is kept apart, as variance in ``gap.missed``, until ``make_up_clip`` can say more.
    """
    gap = segment.gap
    if gap.seconds == 0.0:
        begin_gap(segment)
    mean_rate_into(segment, now, dt)
    for i in range(3):
        gap.turn[i] += now.mean_rate[i] * dt
        segment.rate[i], segment.rate_slope[i] = now.angular_rate[i], np.nan
        if now.clipped_axes[i, 0] != 0.0 or now.clipped_axes[i, 1] != 0.0 or now.clipped_axes[i, 2] != 0.0:
            for j in range(3):
                gap.clipped_axes[i, j] = now.clipped_axes[i, j]
    gap.missed -= missed_square(segment, tuning)
    gap.seconds += dt
    segment.silent_s += dt
    gap.missed += missed_square(segment, tuning)
    density = gyroscope_density(now, tuning)
    if gap.seconds > tuning.longest_clip_s:
        density += gap.missed / dt
        gap.missed = 0.0
    return density


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

    Return the variance that the step adds, rad². The rate is taken to have gone as the cubic through values
    and slopes at both ends. Only axes that were at the end of their range are made up for, outward.
    """
    gap, w = segment.gap, now.mean_rate
    missed, lasted_s, square = gap.missed, gap.seconds, 0.0
    gap.missed = 0.0
    for i in range(3):
        now.bridge[i] = gap.turn[i] + w[i] * dt
    if lasted_s > tuning.longest_clip_s or not is_finite(gap.slope):
        return float(missed)
    slope = now.clip_slope
    for i in range(3):
        slope[i] = (now.angular_rate[i] - segment.rate[i]) / dt
    for k in range(3):
        axis = gap.clipped_axes[k]
        along = missed_along(axis, gap.rate, gap.slope, segment.rate, slope, segment.bias, gap.turn, lasted_s)
        square += along**2
        for i in range(3):
            now.bridge[i] += axis[i] * along
            w[i] += axis[i] * along / dt
    # a cubic that says that nothing was missed does not fit
    return float(tuning.missed_share**2 * square if square > 0.0 else missed)


@compiled
def missed_along(
    axis: FloatArray,
    rate: FloatArray,
    slope: FloatArray,
    last_rate: FloatArray,
    last_slope: FloatArray,
    bias: FloatArray,
    shown: FloatArray,
    lasted_s: float,
) -> float:
    """Return what a gyroscope at the end of its range has missed about an axis, rad, (70); 0: nothing.

    The rate is taken for the cubic through rates (3,), rad/s, bias included, and slopes (3,), rad/s², before
    and after. axis: (3,) unit, or 0. shown: (3,) rad, what the gyroscope did show, less its bias. lasted_s:
    between the two rates.
    """
    along, turned = 0.0, 0.0
    for i in range(3):
        # (70)  T / 2 (ω_0 + ω_1) + T² / 12 (ω̇_0 − ω̇_1) − b T
        whole = lasted_s * (0.5 * (rate[i] + last_rate[i]) - bias[i])
        whole += lasted_s**2 / 12.0 * (slope[i] - last_slope[i])
        along += axis[i] * (whole - shown[i])
        turned += axis[i] * shown[i]
    return along if along * turned > 0.0 else 0.0
