"""One segment without gyrometers: an error-state filter that carries the motion instead. Compiled.

The specific force is integrated twice (``v̇ = R f + g``, ``ṗ = v``) and meets whatever is known of the place
of a point of the segment; a wrong ``R`` shows in ``p``. So no place is ever differentiated, and no ``ω̇`` is
needed where the point sits off the module: ``p + R r`` is all there is. ``R`` itself follows a constant-jerk
motion: an angular acceleration that forgets itself (Singer 1970) and an angular rate that dies out slowly,
both in world axes, as noisy as the specific force is lively. The field is a known vector, its horizontal and
vertical strength being learnt, plus a disturbance that forgets itself (the field of a room varies by place).

Errors, 23: ``R = exp(θ) R̂`` (rad, world), ω, ω̇, v, p of the module, an arm (segment axes) by which the point
is off its given place, horizontal and vertical strength of the field, disturbance of the field (world, µT).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import cross, norm, skew
from gateway.reconstruction.inertial.dense import product, product_transposed

N = 23
RATE, SPIN, VELOCITY, PLACE, ARM, STRENGTH, DISTURBANCE = 3, 6, 9, 12, 15, 18, 20
MOST_ROWS = 32
"""Rows that one instant may have; what comes beyond is left out."""


class MotionNoise(NamedTuple):
    """Standard deviations and time constants; one set for all bodies and motions."""

    spin_memory_s: float = 0.15
    rate_memory_s: float = 0.2
    blind_rate_memory_s: float = 0.1
    """While the field is disturbed, turns unseen die out faster."""
    spin: float = 2.0
    """rad/s²: ω̇ of a segment whose specific force stands still …"""
    spin_per_force: float = 3.0
    """… rad/s² more for each m/s² by which it varies …"""
    largest_spin: float = 60.0
    """… and no more than that."""
    accelerometer: float = 0.05
    """m/s²/√Hz, scale and alignment included."""
    field: float = 1.0
    """µT, of a sample."""
    disturbance: float = 1.0
    """µT: how far the field varies in a room, and …"""
    disturbance_memory_s: float = 1.0
    strength: float = 4.0
    """µT: how well the rig knows the field."""
    norm_tolerance: float = 1.5
    """µT by which the norm may be off; more counts …"""
    norm_gain: float = 4.0
    """… so many times as noise, and …"""
    norm_memory_s: float = 1.0
    """… for so long after."""
    arm: float = 0.005
    """m: how well places on the segment are known."""
    huber: float = 4.0
    """Standard deviations beyond which an observation counts less."""


class SegmentState(NamedTuple):
    """Everything remembered of one segment; changed in place."""

    R: FloatArray  # (3, 3)
    values: FloatArray  # (N,) the quantities that the errors belong to; the first three unused
    P: FloatArray  # (N, N)
    before: FloatArray  # (3,) specific force of the instant before, segment axes
    quiet: FloatArray  # (9,) means of force and field (6), their variances, time since both are still
    off_norm: FloatArray  # (1,) µT by which the field's norm is, or was, off


class Rows(NamedTuple):
    """What an instant observed: for the smoother; changed in place."""

    n_rows: FloatArray  # (1,)
    gain: FloatArray  # (MOST_ROWS, N)
    H: FloatArray  # (MOST_ROWS, N)
    innovation: FloatArray  # (MOST_ROWS, 2) residual and its variance


def empty_state() -> SegmentState:
    """Of a segment that has not been seen."""
    return SegmentState(np.eye(3), np.zeros(N), np.zeros((N, N)), np.zeros(3), np.zeros(9), np.zeros(1))


def empty_rows() -> Rows:
    """No row yet."""
    return Rows(np.zeros(1), np.zeros((MOST_ROWS, N)), np.zeros((MOST_ROWS, N)), np.zeros((MOST_ROWS, 2)))


@compiled
def begin(
    state: SegmentState, noise: MotionNoise, R: FloatArray, f: FloatArray, m: FloatArray, h: FloatArray
) -> None:
    """From the first sample: R (3, 3), and the field's strength as measured, h (3,) its direction."""
    state.R[:] = R
    state.values[:] = 0.0
    state.values[STRENGTH] = math.hypot(h[0], h[1]) / norm(h) * norm(m)
    state.values[STRENGTH + 1] = h[2] / norm(h) * norm(m)
    sigmas = (0.3, 0.5, noise.spin, 1.0, 1.0, noise.arm)
    state.P[:] = 0.0
    for i in range(18):
        state.P[i, i] = sigmas[i // 3] ** 2
    for i in range(2):
        state.P[STRENGTH + i, STRENGTH + i] = noise.strength**2
    for i in range(3):
        state.P[DISTURBANCE + i, DISTURBANCE + i] = noise.disturbance**2
    state.before[:] = f
    state.quiet[:3], state.quiet[3:6] = f, m
    state.quiet[6:8], state.quiet[8] = 1.0, 0.0
    state.off_norm[0] = 0.0


@compiled
def predict(state: SegmentState, noise: MotionNoise, f: FloatArray, g: FloatArray, dt: float) -> FloatArray:
    """Over dt (s) to the instant of f (3,), segment axes; the transition of the errors, (N, N)."""
    x, R = state.values, state.R
    w, spin = x[RATE:SPIN].copy(), x[SPIN:VELOCITY].copy()
    turn = rotation_matrix.from_rotation_vector(w * dt + spin * (0.5 * dt * dt))
    after = rotation_matrix.multiply(turn, R)
    force = 0.5 * (rotation_matrix.rotate(R, state.before) + rotation_matrix.rotate(after, f))
    a = force + g
    is_blind = state.off_norm[0] > noise.norm_tolerance + 2.0
    keep = math.exp(-dt / (noise.blind_rate_memory_s if is_blind else noise.rate_memory_s))
    keep_spin, keep_field = math.exp(-dt / noise.spin_memory_s), math.exp(-dt / noise.disturbance_memory_s)
    F = _transition(turn, force, keep, keep_spin, keep_field, dt)
    x[PLACE:ARM] += x[VELOCITY:PLACE] * dt + a * (0.5 * dt * dt)
    x[VELOCITY:PLACE] += a * dt
    x[RATE:SPIN] = (w + spin * dt) * keep
    x[SPIN:VELOCITY] = spin * keep_spin
    x[DISTURBANCE:N] *= keep_field
    state.R[:] = after
    state.before[:] = f
    liveliness = noise.spin + noise.spin_per_force * math.sqrt(state.quiet[6])
    spin_sigma = min(noise.largest_spin, liveliness)
    state.P[:] = product_transposed(product(F, state.P), F)
    for i in range(3):
        state.P[SPIN + i, SPIN + i] += spin_sigma**2 * (1.0 - keep_spin * keep_spin)
        state.P[VELOCITY + i, VELOCITY + i] += noise.accelerometer**2 * dt
        state.P[DISTURBANCE + i, DISTURBANCE + i] += noise.disturbance**2 * (1.0 - keep_field * keep_field)
    return F


@compiled
def _transition(
    turn: FloatArray, force: FloatArray, keep: float, keep_spin: float, keep_field: float, dt: float
) -> FloatArray:
    F, K = np.eye(N), skew(force)
    F[:3, :3] = turn
    for i in range(3):
        F[i, RATE + i], F[i, SPIN + i] = dt, 0.5 * dt * dt
        F[RATE + i, RATE + i], F[RATE + i, SPIN + i] = keep, keep * dt
        F[SPIN + i, SPIN + i] = keep_spin
        F[PLACE + i, VELOCITY + i] = dt
        F[DISTURBANCE + i, DISTURBANCE + i] = keep_field
        for j in range(3):
            F[VELOCITY + i, j] = -K[i, j] * dt
            F[PLACE + i, j] = -K[i, j] * (0.5 * dt * dt)
    return F


@compiled
def watch(state: SegmentState, noise: MotionNoise, f: FloatArray, m: FloatArray, dt: float) -> None:
    """How lively force and field are, and how far the field's norm is off; m may be NaN."""
    quiet, gain = state.quiet, 1.0 - math.exp(-dt / 0.3)
    for sensor in range(2):
        value, change = f if sensor == 0 else m, 0.0
        if not math.isfinite(value[0]):
            continue
        for i in range(3):
            off = value[i] - quiet[3 * sensor + i]
            change += off * off
            quiet[3 * sensor + i] += gain * off
        quiet[6 + sensor] += gain * (change - quiet[6 + sensor])
    if math.isfinite(m[0]):
        off = abs(norm(m) - math.hypot(state.values[STRENGTH], state.values[STRENGTH + 1]))
        state.off_norm[0] = max(off, state.off_norm[0] * math.exp(-dt / noise.norm_memory_s))


@compiled
def add_row(
    state: SegmentState, rows: Rows, x: FloatArray, H: FloatArray, residual: float, variance: float
) -> None:
    """One scalar observation ``residual = H e + noise``; x (N,) gathers the errors found, in place."""
    k = int(rows.n_rows[0])
    if k >= MOST_ROWS:
        return
    P, Ph, expected = state.P, np.zeros(N), 0.0
    for j in range(N):
        if H[j] != 0.0:
            expected += H[j] * x[j]
            for i in range(N):
                Ph[i] += P[i, j] * H[j]
    total = variance
    for j in range(N):
        total += H[j] * Ph[j]
    gain, off = Ph / total, residual - expected
    for i in range(N):
        x[i] += gain[i] * off
        for j in range(N):
            P[i, j] -= gain[i] * Ph[j]
    rows.gain[k], rows.H[k] = gain, H
    rows.innovation[k, 0], rows.innovation[k, 1] = off, total
    rows.n_rows[0] = k + 1


@compiled
def add_vector(
    state: SegmentState,
    rows: Rows,
    x: FloatArray,
    H: FloatArray,
    residual: FloatArray,
    sigma: FloatArray,
    huber: float,
) -> None:
    """Three rows, H (3, N), of standard deviations sigma (3,), less trusted where they surprise."""
    distance = 0.0
    for i in range(3):
        off, variance = residual[i], sigma[i] ** 2
        for j in range(N):
            off -= H[i, j] * x[j]
            if H[i, j] != 0.0:
                for k in range(N):
                    variance += H[i, j] * state.P[j, k] * H[i, k]
        distance += off * off / variance
    inflation = max(1.0, math.sqrt(distance) / huber)
    for i in range(3):
        add_row(state, rows, x, H[i], residual[i], sigma[i] ** 2 * inflation)


@compiled
def add_field(
    state: SegmentState,
    rows: Rows,
    noise: MotionNoise,
    x: FloatArray,
    m: FloatArray,
    north: FloatArray,
    delay: float,
) -> None:
    """The field m (3,) µT, segment axes, as it was ``delay`` s ago; north (3,) the horizontal direction of
    the undisturbed one."""
    v, w = state.values, state.values[RATE:SPIN]
    back = rotation_matrix.from_rotation_vector(w * -delay + v[SPIN:VELOCITY] * (0.5 * delay * delay))
    seen = rotation_matrix.rotate(back, rotation_matrix.rotate(state.R, m))
    known = north * v[STRENGTH] + v[DISTURBANCE:N]
    known[2] += v[STRENGTH + 1]
    H, K = np.zeros((3, N)), skew(seen)
    for i in range(3):
        for j in range(3):
            H[i, j], H[i, RATE + j] = K[i, j], -delay * K[i, j]
        H[i, STRENGTH] = north[i]
        H[i, DISTURBANCE + i] = 1.0
    H[2, STRENGTH + 1] = 1.0
    excess = max(0.0, state.off_norm[0] - noise.norm_tolerance)
    sigma = math.sqrt(noise.field**2 + (noise.norm_gain * excess) ** 2)
    add_vector(state, rows, x, H, seen - known, np.full(3, sigma), noise.huber)


@compiled
def add_position(
    state: SegmentState,
    rows: Rows,
    x: FloatArray,
    place: FloatArray,
    arm: FloatArray,
    sigma: FloatArray,
    age_s: float,
    huber: float,
) -> None:
    """Where a point at ``arm`` (3,) from the module was ``age_s`` ago: place (3,) world, m."""
    v, R = state.values, state.R
    r = rotation_matrix.rotate(R, arm + v[ARM:STRENGTH])
    past = v[PLACE:ARM] + r - age_s * (v[VELOCITY:PLACE] + cross(v[RATE:SPIN], r))
    H, K = np.zeros((3, N)), skew(r)
    for i in range(3):
        H[i, PLACE + i], H[i, VELOCITY + i] = 1.0, -age_s
        for j in range(3):
            H[i, j], H[i, ARM + j] = -K[i, j], R[i, j]
    add_vector(state, rows, x, H, place - past, sigma, huber)


@compiled
def add_velocity(
    state: SegmentState,
    rows: Rows,
    x: FloatArray,
    velocity: FloatArray,
    arm: FloatArray,
    sigma: FloatArray,
    huber: float,
) -> None:
    """How fast a point at ``arm`` (3,) from the module moves: (3,) world, m/s."""
    v = state.values
    r = rotation_matrix.rotate(state.R, arm)
    H, K = np.zeros((3, N)), skew(r)
    W = product(skew(v[RATE:SPIN]), K)
    for i in range(3):
        H[i, VELOCITY + i] = 1.0
        for j in range(3):
            H[i, RATE + j], H[i, j] = -K[i, j], -W[i, j]
    add_vector(state, rows, x, H, velocity - v[VELOCITY:PLACE] - cross(v[RATE:SPIN], r), sigma, huber)


@compiled
def add_acceleration(
    state: SegmentState,
    rows: Rows,
    x: FloatArray,
    a: FloatArray,
    arm: FloatArray,
    sigma: FloatArray,
    g: FloatArray,
    huber: float,
) -> None:
    """How a point at ``arm`` (3,) from the module accelerates, gravity taken out: (3,) world, m/s²."""
    v = state.values
    r = rotation_matrix.rotate(state.R, arm)
    force = rotation_matrix.rotate(state.R, state.before)
    w = v[RATE:SPIN]
    residual = a - g - force - cross(v[SPIN:VELOCITY], r) - cross(w, cross(w, r))
    H, K, M = np.zeros((3, N)), skew(force), skew(r)
    for i in range(3):
        for j in range(3):
            H[i, j], H[i, SPIN + j] = -K[i, j], -M[i, j]
    add_vector(state, rows, x, H, residual, sigma, huber)


@compiled
def add_rest(state: SegmentState, rows: Rows, noise: MotionNoise, x: FloatArray, dt: float) -> bool:
    """The first rows of an instant: where force and field (or a disturbed field) have stood still for a
    while, nothing turns."""
    rows.n_rows[0] = 0.0
    quiet = state.quiet
    is_still = quiet[6] < 0.15**2 and (quiet[7] < 1.0 or state.off_norm[0] > noise.norm_tolerance)
    quiet[8] = quiet[8] + dt if is_still else 0.0
    if quiet[8] < 0.3:
        return False
    for i in range(6):
        H = np.zeros(N)
        H[RATE + i] = 1.0
        add_row(state, rows, x, H, -state.values[RATE + i], (0.02 if i < 3 else 0.2) ** 2)
    return True


@compiled
def correct(state: SegmentState, x: FloatArray) -> None:
    """Takes the errors found, x (N,), out of the state."""
    state.R[:] = rotation_matrix.multiply(rotation_matrix.from_rotation_vector(x[:3]), state.R)
    state.values[3:] += x[3:]
    for i in range(N):
        for j in range(i):
            mean = 0.5 * (state.P[i, j] + state.P[j, i])
            state.P[i, j], state.P[j, i] = mean, mean
