"""The observations of the chain filters as rows on orientation errors. Compiled.

A world vector ``u = R̂ s`` is truly ``exp(δ) R̂ s ≈ u − [u]× δ``. Two sides that must agree therefore give
``u − u_p = [m]× (δ − δ_p)`` with their mean ``m = (u + u_p) / 2``, and a known vector ``y``:
``u − y = [y]× δ``.
With u and u_p in their own places noise would seem to show a turn of both together, which no joint shows.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, skew
from gateway.reconstruction.inertial.chain_state import OPEN_SIGMA, ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.lever_arms import own_covariance, relative_covariance, spread
from gateway.reconstruction.inertial.tree_filter import (
    Evidence,
    Three,
    add_edge,
    add_joint,
    add_known,
    add_own,
)

DIP_TOLERANCE = 0.1
"""rad: a field steeper or flatter than it should be by that much is half disturbed."""
NORM_TOLERANCE = 0.1
FIELD_MEMORY_S = 20.0
FIELD_CHANGE_S = 3.0
FIELD_CHANGE = 0.14
"""Of norm (relative) and dip (rad), before any has been seen."""
FIELD_SMOOTHING_S = 0.05
"""What differs from sample to sample is the magnetometer's noise, and no change of place."""
FIELD_PROOF_RAD = 5.0
"""Turned by so much a module has shown whether the field is as it should be."""
LEAST_HORIZONTAL = 0.1
FIRST_LOOK_S = 0.5
"""A heading that nothing else can show is taken from the field within that time."""
AIDED_TILT = 0.15
"""rad: an inclination less sure than that tells no mean acceleration."""
UNSETTLED_TILT = 0.5
"""rad: an inclination less sure than that is helped by gravity, wherever it hangs."""
AIDED_RISE_S, AIDED_FALL_S = 2.0, 30.0
"""How fast larger and smaller mean accelerations are believed."""
MISFIT_S = 5.0
"""Over which a joint's residuals are compared with what is expected of them."""
LARGEST_MISFIT = 1e4
LOOSE = 9.0
"""Misfit of a joint that holds nothing together: three times the deviations expected, for seconds."""
REST_RATE_SIGMA = 0.002
"""rad/s: of a mean rate at rest against the bias."""


@compiled
def joint_row(
    evidence: Evidence,
    state: FilterState,
    noise: Noise,
    s: int,
    p: int,
    u: FloatArray,
    u_p: FloatArray,
    variance: float,
    dt: float,
    is_open: bool,
) -> None:
    """The joint's acceleration seen from both sides, every dt; variance of a component, (m/s²)².

    is_open: the heading of one against the other is not known.
    """
    residual = u[0] - u_p[0], u[1] - u_p[1], u[2] - u_p[2]
    middle = 0.5 * (u[0] + u_p[0]), 0.5 * (u[1] + u_p[1]), 0.5 * (u[2] + u_p[2])
    at_once = variance * min(1.0, dt / noise.row_memory_s)
    off = spread(middle[0], middle[1], middle[2], relative_covariance(state, s, p))
    widened = _misfit(state, noise, s, off, residual, at_once, dt, 2 if is_open else 0)
    if widened >= LOOSE:
        return
    variance *= widened
    if is_open:
        # heading against the parent unknown: the horizontal parts are only equally long
        H, H_p = skew(u), skew(u_p)
        wide = variance + _horizontal_square(u) + _horizontal_square(u_p)
        for i in range(3):
            H[i, 2], H_p[i, 2] = 0.0, 0.0
            for j in range(2):
                H_p[i, j] *= -1.0
            add_edge(evidence, s, H[i], H_p[i], residual[i], wide if i < 2 else variance)
        return
    variance *= _huber(off, residual, widened * at_once, noise.huber)
    add_joint(evidence, s, middle, residual, variance)


@compiled
def known_row(
    evidence: Evidence,
    state: FilterState,
    noise: Noise,
    s: int,
    u: FloatArray,
    y: FloatArray,
    variance: float,
    is_open: bool,
) -> None:
    """A vector that is known in the world; is_open: its horizontal direction says nothing yet."""
    residual = u[0] - y[0], u[1] - y[1], u[2] - y[2]
    if is_open:
        H, H_y = skew(u), skew(y)
        wide = variance + _horizontal_square(u) + _horizontal_square(y)
        for i in range(3):
            H[i, 2] = 0.0
            for j in range(2):
                H[i, j] = 0.5 * (H[i, j] + H_y[i, j])
            add_own(evidence, s, H[i], residual[i], wide if i < 2 else variance)
        return
    variance *= _huber(spread(y[0], y[1], y[2], own_covariance(state, s)), residual, variance, noise.huber)
    add_known(evidence, s, (y[0], y[1], y[2]), residual, variance)


@compiled
def _misfit(
    state: FilterState,
    noise: Noise,
    s: int,
    uncertain: Three,
    residual: Three,
    variance: float,
    dt: float,
    first: int,
) -> float:
    """By how much the joint of segment s and its parent agrees worse than its noise says, variances; 1: no
    worse. Modules worn otherwise than the rig says disagree all the time, and their joint tells little.

    Where that comes out, what the joint has told until then is taken back: the segment is as uncertain as at
    its start, and stands on what its own module tells until the joint fits again. first: component from which
    they are compared; 2 where the horizontal ones cannot be.
    """
    square, expected = 0.0, 0.0
    for i in range(first, 3):
        square += residual[i] ** 2
        expected += uncertain[i] + variance
    surprise, before = min(square / expected, LARGEST_MISFIT), state.misfit[s]
    state.misfit[s] += (1.0 - math.exp(-dt / MISFIT_S)) * (surprise - before)
    if before < LOOSE <= state.misfit[s]:
        for i in range(3):
            state.P[s, i, i] += noise.start_heading**2 if i == 2 else noise.start_tilt**2
        state.unaided_square[s] = 0.0
    widened: float = max(1.0, state.misfit[s])
    return widened


@compiled
def _horizontal_square(v: FloatArray | Three) -> float:
    square: float = v[0] * v[0] + v[1] * v[1]
    return square


@compiled
def _huber(uncertain: Three, residual: Three, variance: float, limit: float) -> float:
    """By how much the variance is raised: 1 within ``limit`` standard deviations of the innovation.

    uncertain: (3,) variances that the orientation gives it.
    """
    square = 0.0
    for i in range(3):
        square += residual[i] ** 2 / (uncertain[i] + variance)
    return max(1.0, math.sqrt(square) / limit)


@compiled
def _seen(R: FloatArray, m: FloatArray) -> Three:
    """R m."""
    return (
        R[0, 0] * m[0] + R[0, 1] * m[1] + R[0, 2] * m[2],
        R[1, 0] * m[0] + R[1, 1] * m[1] + R[1, 2] * m[2],
        R[2, 0] * m[0] + R[2, 1] * m[1] + R[2, 2] * m[2],
    )


class ExpectedField(NamedTuple):
    """What every segment's field is held against, and how fast, the same for all of an instant."""

    norm: float  # µT
    dip: float  # rad, above the horizontal
    horizontal: float  # square of the part of it that shows a heading
    by_tilt: float  # rad², of the heading it shows, by how accelerometers tilt the module
    gain: float  # of a low-pass of ``FIELD_MEMORY_S``
    change_gain: float  # and of ``FIELD_CHANGE_S``
    smoothing_gain: float  # and of ``FIELD_SMOOTHING_S``


@compiled
def expected_field(body: ChainBody, noise: Noise, dt: float) -> ExpectedField:
    """dt: since the instant before, s."""
    h = body.field
    level, square = h[0] * h[0] + h[1] * h[1], dot(h, h)
    horizontal = max(level / square, LEAST_HORIZONTAL**2)
    return ExpectedField(
        math.sqrt(square),
        math.atan2(h[2], math.sqrt(level)),
        horizontal,
        noise.force_bias**2 / dot(body.gravity, body.gravity) * (1.0 / horizontal - 1.0),
        1.0 - math.exp(-dt / FIELD_MEMORY_S),
        1.0 - math.exp(-dt / FIELD_CHANGE_S),
        1.0 - math.exp(-dt / FIELD_SMOOTHING_S),
    )


@compiled
def watch_field(
    body: ChainBody, state: FilterState, s: int, m: FloatArray, expected: ExpectedField, dt: float
) -> tuple[float, float]:
    """Heading by which the field is seen off, rad, and how disturbed it looks (1: not at all).

    How much its norm and dip change while segment s moves goes to ``state.field_seen[s]``, and how much of
    that lasts: means of a change to and fro are small. So does how far they are from what they should be: at
    once where that is more than before, with the turning of the module where it is less.
    """
    h, seen = body.field, _seen(state.R[s], m)
    off = math.atan2(h[0] * seen[1] - h[1] * seen[0], h[0] * seen[0] + h[1] * seen[1])
    length, dip = math.sqrt(dot(m, m)), math.atan2(seen[2], math.sqrt(_horizontal_square(seen)))
    mean = state.field_seen[s]
    if mean[3] == 0.0:
        mean[0], mean[1], mean[2] = length, dip, FIELD_CHANGE**2
        mean[4], mean[5], mean[8] = FIELD_CHANGE, 0.0, FIELD_CHANGE**2
    mean[3] += dt
    gain = max(expected.gain, dt / mean[3])
    mean[0] += gain * (length - mean[0])
    mean[1] += gain * (dip - mean[1])
    mean[6] += expected.smoothing_gain * (length / mean[0] - 1.0 - mean[6])
    mean[7] += expected.smoothing_gain * (dip - mean[1] - mean[7])
    of_norm, of_dip = mean[6], mean[7]
    mean[2] += expected.change_gain * (of_norm * of_norm + of_dip * of_dip - mean[2])
    mean[4] += expected.change_gain * (of_norm - mean[4])
    mean[5] += expected.change_gain * (of_dip - mean[5])
    stronger, steeper = (1.0 + of_norm) * mean[0] / expected.norm - 1.0, of_dip + mean[1] - expected.dip
    wrong, w = stronger * stronger + steeper * steeper, state.rate[s]
    proof = expected.change_gain if wrong > mean[8] else math.sqrt(dot(w, w)) * dt / FIELD_PROOF_RAD
    mean[8] += min(proof, 1.0) * (wrong - mean[8])
    steeper, stronger = (dip - expected.dip) / DIP_TOLERANCE, (length / expected.norm - 1.0) / NORM_TOLERANCE
    return off, 1.0 + steeper * steeper + stronger * stronger


@compiled
def field_row(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    s: int,
    off: float,
    disturbance: float,
    expected: ExpectedField,
    dt: float,
) -> None:
    """Heading by the field, weak. off, disturbance: see ``watch_field``.

    How far it is off throughout is found beside the heading and taken off: a field that stays as it is holds
    a heading where it was, but does not say where that is. How far it may be off is told by how far norm and
    dip are from what they should be: where they are right while the module turns and travels, it is the
    earth's, and shows headings but for how accelerometers are off. What bends the dip bends the heading too,
    the more the steeper the field: for ``heading_memory_s`` to the same side where the change lasts, for no
    longer than it is watched where it comes and goes.
    """
    seen, offset = state.field_seen[s], state.field_offset[s]
    change = seen[2] / expected.horizontal
    fleeting = max(0.0, seen[2] - seen[4] * seen[4] - seen[5] * seen[5]) / expected.horizontal
    largest = min(noise.heading**2, seen[8] / expected.horizontal + expected.by_tilt)
    offset[1] += largest * dt / noise.heading_offset_s
    if offset[1] > largest:
        offset[0] *= largest / offset[1]
        offset[1] = largest
    straying, uncertain = offset[1] + change, min(state.P[s, 2, 2], OPEN_SIGMA**2)
    off -= offset[0]
    weight = max(1.0, abs(off) / math.sqrt(straying + uncertain) / noise.huber) * disturbance
    is_first = (body.opens[s] == 0 or state.misfit[s] >= LOOSE) and state.P[s, 2, 2] > straying
    memory_s = FIRST_LOOK_S if is_first else noise.heading_memory_s
    varying = (change - fleeting) * memory_s + fleeting * min(memory_s, FIELD_CHANGE_S)
    variance = (offset[1] * memory_s + varying) / dt * weight
    add_own(evidence, s, (0.0, 0.0, 1.0), -off, variance)
    if not is_first:  # what the heading is off by stays as long as the field's own
        white = (uncertain * noise.heading_memory_s + varying) / dt * weight
        gain = offset[1] / (offset[1] + white)
        offset[0] += gain * off
        offset[1] -= gain * offset[1]


@compiled
def note_aided(state: FilterState, noise: Noise, s: int, at_rest: FloatArray, dt: float) -> None:
    """How far the mean acceleration of segment s is from none while its inclination is known: what a row
    that takes it for none will be off by, once nothing aids the chain any more."""
    if state.fresh_s[s] < noise.unaided_window_s or state.P[s, 0, 0] + state.P[s, 1, 1] > AIDED_TILT**2:
        return
    square = 0.0
    for i in range(3):
        square += (state.long_force[s, i] - at_rest[i]) ** 2 / 3.0
    memory_s = AIDED_RISE_S if square > state.unaided_square[s] else AIDED_FALL_S
    state.unaided_square[s] += (1.0 - math.exp(-dt / memory_s)) * (square - state.unaided_square[s])


@compiled
def unaided_row(
    evidence: Evidence,
    state: FilterState,
    noise: Noise,
    s: int,
    at_rest: FloatArray,
    sharing: float,
    dt: float,
) -> None:
    """Mean acceleration over a window is small, where nothing tells what it is: no smaller than it was while
    that was known, and over a shorter time as much larger as speeds are the same. It stays for the window on
    either side. sharing: segments that move together and have such a row each."""
    square = max(_mean_square(state, noise, s, dt), 2.0 * state.unaided_square[s])
    variance = square * noise.unaided_window_s / dt * sharing
    known_row(evidence, state, noise, s, state.long_force[s], at_rest, variance, False)


@compiled
def starting_row(
    evidence: Evidence, state: FilterState, noise: Noise, s: int, at_rest: FloatArray, dt: float
) -> None:
    """The same of a segment whose chain is held up, as long as its inclination is hardly known: after a start
    in mid-motion. Joints show it only then, one after the other from where the chain is held."""
    if state.P[s, 0, 0] + state.P[s, 1, 1] > UNSETTLED_TILT**2:
        variance = _mean_square(state, noise, s, dt) * noise.unaided_window_s / dt
        known_row(evidence, state, noise, s, state.long_force[s], at_rest, variance, False)


@compiled
def _mean_square(state: FilterState, noise: Noise, s: int, dt: float) -> float:
    """(m/s²)² of a mean acceleration: over a shorter time, as after a gap, as much larger as speeds are the
    same, and for some time as large as a start in motion has let expect."""
    lasted_s = min(max(state.fresh_s[s], dt), noise.unaided_window_s)
    square: float = max((noise.unaided_speed / lasted_s) ** 2, state.starting_square[s])
    return square


@compiled
def rest_row(evidence: Evidence, state: FilterState, s: int, window_s: float, dt: float) -> None:
    """At rest the mean rate is the bias."""
    variance = REST_RATE_SIGMA**2 * window_s / dt
    for i in range(3):
        evidence.own[s, 3 + i, 3 + i] += 1.0 / variance
        evidence.own_vector[s, 3 + i] += (state.rest[s, i] - state.bias[s, i]) / variance


@compiled
def row_variance(noise: Noise, motion: float, interval_s: float) -> float:
    """(m/s²)² of a row of accelerations that comes every ``interval_s``; motion: ‖[ω̇, ω]‖ or rms sum."""
    variance = noise.specific_force**2 + (noise.lever_arm * motion) ** 2
    return variance * noise.row_memory_s / interval_s
