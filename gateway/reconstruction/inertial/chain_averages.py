"""Both sides of every row go through the same low-pass, which differentiates without delay. Compiled.

With ``v = R (ω × r)`` the world velocity of a joint about the module, ``R ([ω̇, ω] ⊳ r) = dv/dt`` exactly. A
first-order low-pass with time constant τ of a derivative is ``(v − average(v)) / τ``: no sample of ω is ever
differenced, and both sides of an equation are delayed alike. Orientation errors in world axes hardly change
within τ, so the row counts as one about now.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray, IntArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot
from gateway.reconstruction.inertial.chain_prediction import velocity, velocity_into
from gateway.reconstruction.inertial.chain_state import ChainBody, FilterState, Noise

SETTLED = 3.0
"""Time constants after which an average has forgotten how it was begun (to 5 %)."""
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
    fixed: IntArray,
    dt: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Accelerations less gravity of each joint seen from the child and from the parent, (n, 3) twice, world;
    of each fixed point, (d, 3); and ‖[ω̇, ω]‖ of each segment, (n,) 1/s². In place: the averages."""
    n, n_devices = len(body.parents), len(body.device_segment)
    U, U_parent, U_device = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n_devices, 3))
    motion, w, f_w, w_w, v = np.zeros(n), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    gain = 1.0 - math.exp(-dt / noise.smoothing_s)
    long_gain = 1.0 - math.exp(-dt / noise.unaided_window_s)
    per_s = gain / dt
    for s in range(n):
        if is_valid[s] < 2.0:
            state.fresh_s[s] = 0.0
            continue
        for i in range(3):
            w[i] = rate[s, i] - state.bias[s, i]
            f_w[i], w_w[i] = force[s, i], w[i]
        rotation_matrix.turn(state.R[s], f_w)
        rotation_matrix.turn(state.R[s], w_w)
        velocity_into(v, state.R[s], w, body.to_joint[s])
        if state.fresh_s[s] == 0.0:
            state.force[s], state.long_force[s], state.turn[s], state.joint_velocity[s] = f_w, f_w, w_w, v
            state.last_force[s] = f_w
        squared = dot(w, w) ** 2
        for i in range(3):
            # the mean over the step, as the difference of v is
            state.force[s, i] += gain * (0.5 * (f_w[i] + state.last_force[s, i]) - state.force[s, i])
            state.last_force[s, i] = f_w[i]
            state.long_force[s, i] += long_gain * (f_w[i] - state.long_force[s, i])
            U[s, i] = state.force[s, i] + per_s * (v[i] - state.joint_velocity[s, i])
            state.joint_velocity[s, i] += gain * (v[i] - state.joint_velocity[s, i])
            squared += (per_s * (w_w[i] - state.turn[s, i])) ** 2
            state.turn[s, i] += gain * (w_w[i] - state.turn[s, i])
        motion[s] = math.sqrt(squared)
        p = body.parents[s]
        if p >= 0 and is_valid[p] >= 2.0:
            for i in range(3):
                w[i] = rate[p, i] - state.bias[p, i]
            velocity_into(v, state.R[p], w, body.from_parent[s])
            if state.fresh_s[s] == 0.0 or state.fresh_s[p] <= 1.5 * dt:
                state.parent_velocity[s] = v
            for i in range(3):
                U_parent[s, i] = state.force[p, i] + per_s * (v[i] - state.parent_velocity[s, i])
                state.parent_velocity[s, i] += gain * (v[i] - state.parent_velocity[s, i])
        state.fresh_s[s] += dt
    for d in range(n_devices):
        s = body.device_segment[d]
        if fixed[d] and is_valid[s] >= 2.0:
            v = velocity(state.R[s], rate[s] - state.bias[s], body.device_arm[d])
            if state.fresh_s[s] <= 1.5 * dt:
                state.device_velocity[d] = v
            U_device[d] = state.force[s] + per_s * (v - state.device_velocity[d])
            state.device_velocity[d] += gain * (v - state.device_velocity[d])
    return U, U_parent, U_device, motion


@compiled
def watch_rest(
    state: FilterState, noise: Noise, s: int, force: FloatArray, rate: FloatArray, dt: float
) -> bool:
    """Whether segment s has rested for a while; ``state.rest[s, :3]`` is then its mean rate, the bias."""
    gain = 1.0 - math.exp(-dt / REST_WINDOW_S)
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
