"""Both sides of every row go through the same low-pass, which differentiates without delay. Compiled.

With ``W = R [ω]×``, ``R ([ω̇, ω] ⊳ r) = (dW/dt) r`` exactly, for every arm r. A first-order low-pass with time
constant τ of a derivative is the swing ``K = (W − average(W)) / τ``: no sample of ω is ever differenced, and
both sides of an equation are delayed alike. Orientation errors in world axes hardly change
within τ, so the row counts as one about now.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot
from gateway.reconstruction.inertial.chain_state import ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.vibration import watch_vibration

SETTLED = 3.0
"""Time constants after which a row counts: over less, it is mostly the noise of rates."""
FILLED = 20.0
"""Time constants after which nothing is missing."""
FIRST_SAMPLE_S = 1e-9
"""Averages of one sample have lasted no time, but have been begun."""
REST_S = 0.7
REST_WINDOW_S = 0.5
REST_FORCE = 0.3
"""m/s²: more change of the specific force than that is no rest."""
LARGEST_BIAS = 0.05
"""rad/s: a steady rate above it is a motion, not a bias."""


@compiled
def average(
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    force: FloatArray,
    rate: FloatArray,
    is_valid: FloatArray,
    dt: float,
    K: FloatArray,
    motion: FloatArray,
) -> None:
    """K, motion ← swing of each segment, (n, 3, 3) 1/s², world, and ‖[ω̇, ω]‖, (n,) 1/s², where its specific
    force counts. In place, too: the averages."""
    f, f_w, W = np.empty(3), np.empty(3), np.empty((3, 3))
    gain = 1.0 - math.exp(-dt / noise.smoothing_s)
    long_gain = 1.0 - math.exp(-dt / noise.unaided_window_s)
    for s in range(len(body.parents)):
        if is_valid[s] < 2.0:
            state.fresh_s[s] = 0.0
            continue
        R = state.R[s]
        for i in range(3):
            f[i] = force[s, i] - state.force_bias[s, i]
        x, y, z = (
            rate[s, 0] - state.bias[s, 0],
            rate[s, 1] - state.bias[s, 1],
            rate[s, 2] - state.bias[s, 2],
        )
        is_fresh = state.fresh_s[s] == 0.0
        watch_vibration(state, s, f, is_fresh, dt)
        filled = _filled(state.fresh_s[s] + dt, noise.smoothing_s)
        per_s, force_gain = gain / dt / filled, gain / filled
        mean_gain = max(long_gain, dt / (state.fresh_s[s] + dt))
        square = 0.0
        for i in range(3):
            f_w[i] = R[i, 0] * f[0] + R[i, 1] * f[1] + R[i, 2] * f[2]
            W[i, 0] = R[i, 1] * z - R[i, 2] * y
            W[i, 1] = R[i, 2] * x - R[i, 0] * z
            W[i, 2] = R[i, 0] * y - R[i, 1] * x
            if is_fresh:
                state.force[s, i], state.last_force[s, i], state.long_force[s, i] = f_w[i], f_w[i], f_w[i]
                state.swing[s, i] = W[i]
            # the mean over the step, as the difference of W is
            state.force[s, i] += force_gain * (0.5 * (f_w[i] + state.last_force[s, i]) - state.force[s, i])
            state.last_force[s, i] = f_w[i]
            state.long_force[s, i] += mean_gain * (f_w[i] - state.long_force[s, i])
            for j in range(3):
                K[s, i, j] = per_s * (W[i, j] - state.swing[s, i, j])
                state.swing[s, i, j] += gain * (W[i, j] - state.swing[s, i, j])
                square += K[s, i, j] ** 2
        motion[s] = math.sqrt(0.5 * square)
        state.fresh_s[s] += FIRST_SAMPLE_S if is_fresh else dt


@compiled
def _filled(lasted_s: float, smoothing_s: float) -> float:
    """Part of the low-pass that has been filled since it was begun.

    Divided by it, both sides are means over that time alone: what the averages were begun with is not in
    them, neither after a gap nor where a recording begins in motion.
    """
    if lasted_s > FILLED * smoothing_s:
        return 1.0
    return 1.0 - math.exp(-lasted_s / smoothing_s)


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
def watch_rest(
    state: FilterState, noise: Noise, s: int, force: FloatArray, rate: FloatArray, gain: float, dt: float
) -> bool:
    """Whether segment s has rested for a while; ``state.rest[s, :3]`` is then its mean rate, the bias.

    gain: of a low-pass of ``REST_WINDOW_S`` over dt.
    """
    rest = state.rest[s]
    rate_change, force_change = 0.0, 0.0
    for i in range(3):
        off_rate, off_force = rate[i] - rest[i], force[i] - rest[3 + i]
        rate_change += off_rate * off_rate
        force_change += off_force * off_force
        rest[i] += gain * off_rate
        rest[3 + i] += gain * off_force
    rest[6] += gain * (rate_change - rest[6])
    rest[7] += gain * (force_change - rest[7])
    is_still = rest[6] < noise.rest_rate**2 and rest[7] < REST_FORCE**2
    is_still = is_still and dot(rest[:3], rest[:3]) < LARGEST_BIAS**2
    rest[8] = rest[8] + dt if is_still else 0.0
    return bool(rest[8] > REST_S)
