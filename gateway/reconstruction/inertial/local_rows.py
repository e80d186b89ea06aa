"""Local measuring devices: from readings at their own rate to an acceleration and its uncertainty. Compiled.

A derivative of the readings by least squares over a window is ``Σ w_i p(t_i)``, and for every motion
whatever that is ``∫ K(t) a(t) dt`` with the kernel ``K(t) = Σ w_i (t_i − t)₊`` (Peano; for velocities a step
in place of the ramp). So the module's side of the row is its own acceleration averaged with the same kernel:
neither delay nor bandwidth of the fit is an error of the row, only the readings' noise is, ``σ² Σ w_i²``.
Where the device sits off the module, ``Σ w_i R r(t_i)`` is what the arm adds, again without any derivative
of ω. Accelerations are summed to velocities over the window first.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray, Quantity
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_prediction import velocity_into
from gateway.reconstruction.inertial.chain_state import (
    N_HISTORY,
    N_READINGS,
    ChainBody,
    FilterState,
    Noise,
)
from gateway.reconstruction.inertial.observations import SegmentObservations

ACCELERATION, POSITION = Quantity.ACCELERATION.value, Quantity.POSITION.value
LEAST_READINGS = 4
LONGEST_GAP_S = 0.35
"""Between readings; over a longer one nothing is differentiated."""
HISTORY_PER_WINDOW = 80.0


@compiled
def take_reading(
    state: FilterState, noise: Noise, d: int, time_s: float, value: FloatArray, sigma: float
) -> None:
    """Keeps a reading of device d; those much denser than the window needs are passed over."""
    readings, n = state.readings[d], state.n_readings[d, 0]
    if n > 0:
        since = time_s - readings[n - 1, 0]
        if since < 0.8 * noise.local_window_s / (N_READINGS - 1):
            return
        if since > LONGEST_GAP_S:
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
    """Remembers what device d's segment felt."""
    s = body.device_segment[d]
    history, R = state.history[d], state.R[s]
    if time_s - history[N_HISTORY - 1, 0] < noise.local_window_s / HISTORY_PER_WINDOW:
        return
    for j in range(N_HISTORY - 1):
        for i in range(7):
            history[j, i] = history[j + 1, i]
    newest = history[N_HISTORY - 1]
    newest[0] = time_s
    f, w = np.empty(3), np.empty(3)
    for i in range(3):
        f[i] = observed.specific_force[s, i] - state.force_bias[s, i]
        w[i] = observed.angular_rate[s, i] - state.bias[s, i]
    rotation_matrix.rotate_into(newest[1:4], R, f)
    if body.device_kind[d] == POSITION:
        rotation_matrix.rotate_into(newest[4:7], R, body.device_arm[d])
    else:
        velocity_into(newest[4:7], R, w, body.device_arm[d])


@compiled
def local_pair(
    body: ChainBody, state: FilterState, noise: Noise, d: int, time_s: float
) -> tuple[bool, FloatArray, FloatArray, float, float]:
    """Whether there is a new row; u, y (3,) that must agree; variance of the fit; span of the window, s."""
    none = (False, np.zeros(3), np.zeros(3), 0.0, 0.0)
    n = state.n_readings[d, 0]
    if state.n_readings[d, 1] == 0 or n < LEAST_READINGS or state.readings[d, n - 1, 0] > time_s:
        return none
    state.n_readings[d, 1] = 0
    first = max(0, n - LEAST_READINGS)
    while (
        first > 0
        and state.readings[d, n - 1, 0] - state.readings[d, first - 1, 0] < 1.05 * noise.local_window_s
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
    is_covered, u, arm = _own_side(state.history[d], t, weights, order)
    if not is_covered:
        return none
    y, variance = np.empty(3), 0.0
    for i in range(3):
        y[i] = -body.gravity[i]
        u[i] += arm[i]
    for k in range(len(t)):
        variance += (weights[k] * state.readings[d, first + k, 4]) ** 2
        for i in range(3):
            y[i] += weights[k] * values[k, i]
    if body.device_kind[d] == ACCELERATION:
        variance = state.readings[d, n - 1, 4] ** 2 / len(t)
    return True, u, y, variance, t[len(t) - 1] - t[0]


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
def _own_side(
    history: FloatArray, t: FloatArray, weights: FloatArray, order: int
) -> tuple[bool, FloatArray, FloatArray]:
    """R f averaged with the fit's kernel, and Σ w_i of what the arm does; world."""
    u, arm, total = np.zeros(3), np.zeros(3), 0.0
    if not _reaches(history, t[0]):
        return False, u, arm
    for j in range(1, N_HISTORY):
        if history[j - 1, 0] == -np.inf or history[j, 0] < t[0]:
            continue
        step = history[j, 0] - history[j - 1, 0]
        if step > LONGEST_GAP_S:
            return False, u, arm
        middle = 0.5 * (history[j, 0] + history[j - 1, 0])
        kernel = 0.0
        for i in range(len(t)):
            ahead = t[i] - middle
            if ahead > 0.0:
                kernel += weights[i] * (ahead if order == 2 else 1.0)
        for i in range(3):
            u[i] += 0.5 * kernel * step * (history[j, 1 + i] + history[j - 1, 1 + i])
        total += kernel * step
    for k in range(len(t)):
        _add_arm(arm, weights[k], history, t[k])
    for i in range(3):
        u[i] /= total  # the kernel's area is 1; what is missing was lost at the ends of the window
    return math.isfinite(total) and total > 0.5, u, arm


@compiled
def _reaches(history: FloatArray, time_s: float) -> bool:
    """Whether some remembered frame is as old."""
    for j in range(N_HISTORY):
        if history[j, 0] > -np.inf:
            return bool(history[j, 0] <= time_s)
    return False


@compiled
def _add_arm(arm: FloatArray, weight: float, history: FloatArray, time_s: float) -> None:
    """arm += weight times its columns at an instant, linear between frames; the nearest outside."""
    last = N_HISTORY - 1
    while last > 1 and history[last - 1, 0] >= time_s:
        last -= 1
    step = history[last, 0] - history[last - 1, 0]
    part = min(1.0, max(0.0, (time_s - history[last - 1, 0]) / step)) if math.isfinite(step) else 1.0
    for i in range(4, 7):
        found = history[last, i]
        if part != 1.0:
            found = history[last - 1, i] + part * (found - history[last - 1, i])
        arm[i - 4] += weight * found
