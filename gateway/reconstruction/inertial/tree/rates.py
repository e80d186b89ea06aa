"""The rate that turns a segment over a step, how noisy it is, and what of it bridges a gap. Compiled."""

from __future__ import annotations

import math

from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import norm
from gateway.reconstruction.inertial.tree.state import Segment, SegmentWork, Validity
from gateway.reconstruction.inertial.tree.tuning import Tuning

RATE = Validity.RATE.value


@compiled
def mean_rate_into(segment: Segment, now: SegmentWork, dt: float) -> None:
    """Set ``now.mean_rate``, rad/s, that turns the segment over dt (s), equation (2).

    The angle's error is O(dt³). It is the trapezoid, less its error by Euler and Maclaurin's formula from the
    last three rates, plus the coning of an axis that moves (Bortz 1971). At 100 Hz the trapezoid alone is off
    by up to a degree in fast motion.
    """
    w, rate, bias, last, slope = (
        now.mean_rate, now.angular_rate, segment.bias, segment.rate, segment.rate_slope
    )  # fmt: skip
    a = last[0] - bias[0], last[1] - bias[1], last[2] - bias[2]
    b = rate[0] - bias[0], rate[1] - bias[1], rate[2] - bias[2]
    # (2)  (a + c) / 2 + Δt / 12 a × c, c being b here, …
    w[0] = 0.5 * (a[0] + b[0]) + (a[1] * b[2] - a[2] * b[1]) * dt / 12.0
    w[1] = 0.5 * (a[1] + b[1]) + (a[2] * b[0] - a[0] * b[2]) * dt / 12.0
    w[2] = 0.5 * (a[2] + b[2]) + (a[0] * b[1] - a[1] * b[0]) * dt / 12.0
    for i in range(3):
        if math.isfinite(slope[i]):
            # (2)  … less the trapezoid's error, by how the rate's slope has changed
            w[i] -= (rate[i] - last[i] - slope[i] * dt) / 12.0


@compiled
def is_short_gap(segment: Segment, now: SegmentWork, tuning: Tuning) -> bool:
    """Return whether a module has no rate, but so briefly that its averages are bridged."""
    return bool(now.validity < RATE and 0.0 < segment.gap.seconds <= tuning.longest_bridge_s)


@compiled
def gyroscope_density(now: SegmentWork, tuning: Tuning) -> float:
    """Return the noise of a gyroscope within its range, (rad/s)²/Hz, the first terms of (5)."""
    # (5)  σ_ω² + (κ ‖w‖)² τ_κ
    return float(
        tuning.gyroscope**2 + (tuning.gyroscope_scale * norm(now.mean_rate)) ** 2 * tuning.scale_memory_s
    )


@compiled
def begin_gap(segment: Segment) -> None:
    """Keep what bridges the gap that begins: the rate of the last sample, and its slope."""
    gap = segment.gap
    gap.missed, gap.made_up, gap.is_lost = 0.0, 0.0, 0
    for i in range(3):
        gap.rate[i], gap.slope[i], gap.turn[i] = segment.rate[i], segment.rate_slope[i], 0.0
        gap.last_slope[i], gap.clip_s[i], gap.clip_left[i] = segment.rate_slope[i], 0.0, 3.0
        for j in range(3):
            gap.clipped_axes[i, j] = 0.0
