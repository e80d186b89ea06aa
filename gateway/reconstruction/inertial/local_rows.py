"""Local measuring devices: from readings at their own rate to an acceleration and its uncertainty. Compiled.

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
from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, Quantity
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_state import (
    N_HISTORY,
    N_OF_FRAME,
    N_READINGS,
    ChainBody,
    FilterState,
    Noise,
)
from gateway.reconstruction.inertial.observations import SegmentObservations

ACCELERATION, POSITION = Quantity.ACCELERATION.value, Quantity.POSITION.value
VELOCITY = Quantity.VELOCITY.value
LEAST_READINGS = 4
LONGEST_GAP_S = 0.35
"""Between readings; over a longer one nothing is differentiated."""
LONGEST_WINDOW_S = 3.0
"""So long gyrometers keep the directions that are averaged."""
WINDOW_CHANGE = 1.25
"""A window stays as it is while readings' uncertainties ask for one that is longer or shorter by less."""
HISTORY_PER_WINDOW = 80.0


@compiled
def _choose_window(state: FilterState, noise: Noise, d: int, kind: int, sigma: float) -> float:
    """Span (s) of the readings of device d: the less certain they are, the longer.

    n readings of standard deviation σ within T leave ``σ √(720 / n) / T²`` of an acceleration, of velocities
    ``σ √(12 / n) / T``. Those of pressure tubes are as uncertain as the air is slow, and stay as they are.
    """
    wanted = noise.local_window_s
    if kind == POSITION:
        wanted = math.sqrt(sigma * math.sqrt(720.0 / N_READINGS) / noise.local_acceleration)
    elif kind == VELOCITY:
        wanted = sigma * math.sqrt(12.0 / N_READINGS) / noise.local_acceleration
    wanted = min(max(wanted, noise.local_window_s), LONGEST_WINDOW_S)
    fit = state.device_fit[d]
    if not fit[0] / WINDOW_CHANGE < wanted < fit[0] * WINDOW_CHANGE:
        fit[0] = wanted
    window_s: float = fit[0]
    return window_s


@compiled
def take_reading(
    state: FilterState, noise: Noise, d: int, kind: int, time_s: float, value: FloatArray, sigma: float
) -> None:
    """Keeps a reading of device d; those much denser than the window needs are passed over."""
    readings, n = state.readings[d], state.n_readings[d, 0]
    window_s = _choose_window(state, noise, d, kind, sigma)
    if n > 0:
        since = time_s - readings[n - 1, 0]
        if since < 0.8 * window_s / (N_READINGS - 1):
            return
        if since > max(LONGEST_GAP_S, 0.5 * window_s):
            n = 0
    if n == N_READINGS:
        for i in range(N_READINGS - 1):
            for j in range(5):
                readings[i, j] = readings[i + 1, j]
        n -= 1
    readings[n, 0], readings[n, 4] = time_s, sigma
    for i in range(3):
        readings[n, 1 + i] = value[i]
    state.n_readings[d, 0], state.n_readings[d, 1] = n + 1, 1


@compiled
def note_frame(
    body: ChainBody, state: FilterState, noise: Noise, observed: SegmentObservations, d: int, time_s: float
) -> None:
    """Remembers what device d's segment felt, in axes that corrections need not turn: see ``device_turn``."""
    s = body.device_segment[d]
    history, R = state.history[d], state.R[s]
    window_s = max(noise.local_window_s, state.device_fit[d, 0])
    if time_s - history[N_HISTORY - 1, 0] < window_s / HISTORY_PER_WINDOW:
        return
    for j in range(N_HISTORY - 1):
        for i in range(N_OF_FRAME):
            history[j, i] = history[j + 1, i]
    newest, turn = history[N_HISTORY - 1], state.device_turn[d]
    newest[0] = time_s
    f = np.empty(3)
    for i in range(3):
        f[i] = observed.specific_force[s, i] - state.force_bias[s, i]
        newest[13 + i] = observed.angular_rate[s, i] - state.bias[s, i]
    for i in range(3):
        newest[1 + i] = 0.0
        for j in range(3):
            column = turn[0, i] * R[0, j] + turn[1, i] * R[1, j] + turn[2, i] * R[2, j]
            newest[4 + 3 * j + i] = column
            newest[1 + i] += column * f[j]


class LocalPair(NamedTuple):
    """What the two sides of a device's row are made of, world axes."""

    u: FloatArray  # (3,) specific force of the module, R f, averaged with the fit's kernel
    y: FloatArray  # (3,) that of the device, as its readings tell it
    arm: FloatArray  # (3, 3) what a device off the module adds to u, by its place there (segment axes, m)
    turn: FloatArray  # (3, 3) R averaged as u is


def local_pair_of() -> LocalPair:
    """To be used again and again."""
    return LocalPair(np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)))


@compiled
def find_local_pair(
    pair: LocalPair, body: ChainBody, state: FilterState, noise: Noise, d: int, time_s: float
) -> tuple[bool, float, float]:
    """Whether there is a new row (its sides: ``pair``), the fit's variance, the window's span in s."""
    none = (False, 0.0, 0.0)
    n = state.n_readings[d, 0]
    if state.n_readings[d, 1] == 0 or n < LEAST_READINGS or state.readings[d, n - 1, 0] > time_s:
        return none
    state.n_readings[d, 1] = 0
    first = max(0, n - LEAST_READINGS)
    while (
        first > 0
        and state.readings[d, n - 1, 0] - state.readings[d, first - 1, 0] < 1.05 * state.device_fit[d, 0]
    ):
        first -= 1
    t, values = np.empty(n - first), np.empty((n - first, 3))
    for k in range(n - first):
        t[k] = state.readings[d, first + k, 0]
        for i in range(3):
            values[k, i] = state.readings[d, first + k, 1 + i]
    order = 2 if body.device_kind[d] == POSITION else 1
    if body.device_kind[d] == ACCELERATION:
        _sum_up(t, values)
    weights = derivative_weights(t, order)
    if not _average_own_side(pair, state.history[d], t, weights, order):
        return none
    rotation_matrix.turn(state.device_turn[d], pair.u)
    rotation_matrix.turn_columns(state.device_turn[d], pair.arm)
    rotation_matrix.turn_columns(state.device_turn[d], pair.turn)
    variance = 0.0
    for i in range(3):
        pair.y[i] = -body.gravity[i]
    for k in range(len(t)):
        variance += (weights[k] * state.readings[d, first + k, 4]) ** 2
        for i in range(3):
            pair.y[i] += weights[k] * values[k, i]
    if body.device_kind[d] == ACCELERATION:
        variance = state.readings[d, n - 1, 4] ** 2 / len(t)
    return True, variance, t[len(t) - 1] - t[0]


@compiled
def _sum_up(t: FloatArray, values: FloatArray) -> None:
    """Accelerations (n, 3) to velocities, trapezoidal, from zero; in place."""
    for i in range(3):
        before, values[0, i] = values[0, i], 0.0
        for k in range(1, len(t)):
            mean, before = 0.5 * (values[k, i] + before), values[k, i]
            values[k, i] = values[k - 1, i] + (t[k] - t[k - 1]) * mean


@compiled
def derivative_weights(t: FloatArray, order: int) -> FloatArray:
    """w (n,) with Σ w_i p(t_i) the derivative of the polynomial of that order (1, 2) fitted to p."""
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
    pair: LocalPair, history: FloatArray, t: FloatArray, weights: FloatArray, order: int
) -> bool:
    """u and turn averaged with the fit's kernel, and the arm's matrix; whether the frames reach so far."""
    total = 0.0
    for i in range(3):
        pair.u[i] = 0.0
        for j in range(3):
            pair.arm[i, j], pair.turn[i, j] = 0.0, 0.0
    if not _reaches(history, t[0]):
        return False
    for j in range(1, N_HISTORY):
        if history[j - 1, 0] == -np.inf or history[j, 0] < t[0]:
            continue
        step = history[j, 0] - history[j - 1, 0]
        if step > LONGEST_GAP_S:
            return False
        middle = 0.5 * (history[j, 0] + history[j - 1, 0])
        kernel = 0.0
        for i in range(len(t)):
            ahead = t[i] - middle
            if ahead > 0.0:
                kernel += weights[i] * (ahead if order == 2 else 1.0)
        _add_share(pair, history[j - 1], 0.5 * kernel * step)
        _add_share(pair, history[j], 0.5 * kernel * step)
        total += kernel * step
    for k in range(len(t)):
        _add_arm(pair.arm, weights[k], history, t[k], order)
    for i in range(3):
        pair.u[i] /= total  # the kernel's area is 1; what is missing was lost at the ends of the window
        for k in range(3):
            pair.turn[i, k] /= total
    return math.isfinite(total) and total > 0.5


@compiled
def _add_share(pair: LocalPair, frame: FloatArray, share: float) -> None:
    for i in range(3):
        pair.u[i] += share * frame[1 + i]
        for j in range(3):
            pair.turn[i, j] += share * frame[4 + 3 * j + i]


@compiled
def _reaches(history: FloatArray, time_s: float) -> bool:
    """Whether some remembered frame is as old."""
    for j in range(N_HISTORY):
        if history[j, 0] > -np.inf:
            return bool(history[j, 0] <= time_s)
    return False


@compiled
def _add_arm(arm: FloatArray, weight: float, history: FloatArray, time_s: float, order: int) -> None:
    """arm (3, 3) += weight R, of velocities weight R [ω]×, at an instant: between frames linear, the nearest
    one outside."""
    last = N_HISTORY - 1
    while last > 1 and history[last - 1, 0] >= time_s:
        last -= 1
    step = history[last, 0] - history[last - 1, 0]
    part = min(1.0, max(0.0, (time_s - history[last - 1, 0]) / step)) if math.isfinite(step) else 1.0
    if part != 1.0:
        _add_frame(arm, weight * (1.0 - part), history[last - 1], order)
    _add_frame(arm, weight * part, history[last], order)


@compiled
def _add_frame(arm: FloatArray, weight: float, frame: FloatArray, order: int) -> None:
    for i in range(3):
        x, y, z = frame[4 + i], frame[7 + i], frame[10 + i]
        if order == 1:
            a, b, c = frame[13], frame[14], frame[15]
            x, y, z = y * c - z * b, z * a - x * c, x * b - y * a
        arm[i, 0] += weight * x
        arm[i, 1] += weight * y
        arm[i, 2] += weight * z
