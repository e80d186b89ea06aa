"""Backward differences of samples at uneven instants, and the acceleration of a point of a rigid body."""

from __future__ import annotations

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.rotation_matrix import increment
from gateway.geometry.vectors import cross


@compiled
def angular_rate(R_before: FloatArray, R_now: FloatArray, dt: float) -> FloatArray:
    """Return ω = log(R_beforeᵀ R_now) / Δt, segment axes, rad/s: the mean rate over the step.

    Shapes (3, 3), (3, 3) -> (3,).
    """
    return increment(R_before, R_now) / dt


@compiled
def difference(before: FloatArray, now: FloatArray, dt: float) -> FloatArray:
    """Return the backward difference (now − before) / Δt of a sampled vector (3,), dt in s."""
    return (now - before) / dt


@compiled
def difference_of_means(
    mean_before: FloatArray, mean_now: FloatArray, dt_before: float, dt: float
) -> FloatArray:
    """Return the backward difference of two means (3,) over successive steps, s, which belong to the middles
    of the steps.

    With equal steps this is (now − before) / Δt; with unequal ones only the distance of the middles
    gives a derivative that converges.
    """
    return (mean_now - mean_before) / (0.5 * (dt_before + dt))


@compiled
def point_acceleration(rate_derivative: FloatArray, rate: FloatArray, arm: FloatArray) -> FloatArray:
    """Return the acceleration of a point at ``arm`` from the segment's origin.

    [ω̇, ω] ⊳ r = ω̇ × r + ω × (ω × r), all in segment axes; rad/s², rad/s, m -> m/s²;
    shapes (3,), (3,), (3,) -> (3,).
    """
    return cross(rate_derivative, arm) + cross(rate, cross(rate, arm))
