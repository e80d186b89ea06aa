"""The articulated method of JP4989660B2 (US8055021): one instant, rank by rank outward from the root.

1. ``a_n = a_{n−1} + R_{n−1} ([ω̇, ω]_{n−1} ⊳ L_{n−1})``: acceleration of the joint P_n.
2. ``f_n − [ω̇, ω]_n ⊳ U_n = R_nᵀ (a_n − g)``, ``x_n = R_nᵀ h``: two vectors known on both sides, hence R_n.
   With ``U_n = 0`` (special case) ω is not needed, with gyrometers it is measured.
3. With ``U_n ≠ 0`` and no gyrometers ω depends on the R_n sought: ``gyro_free``.
4. ω and ω̇ by backward differences: of the last three orientations, or ω measured and differenced once.

State and body are arrays in named tuples; ``advance`` returns new ones and changes no argument.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, IntArray, Status, StatusArray
from gateway.geometry import derivatives, quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite
from gateway.reconstruction.inertial import gyro_free
from gateway.reconstruction.inertial.gyro_free import Rotation, Weights
from gateway.reconstruction.inertial.observations import SegmentObservations

MEASURED, INTERPOLATED = Status.MEASURED.value, Status.INTERPOLATED.value
WARMING_UP, MISSING = Status.WARMING_UP.value, Status.MISSING.value


class Chain(NamedTuple):
    """The body as travelled; constant."""

    order: IntArray  # (n_segments,)
    entered_from: IntArray  # (n_segments,) -1 for the root
    L: FloatArray  # (n_segments, 3) to the segment's P, in the axes of the one it is entered from
    U: FloatArray  # (n_segments, 3) P to module
    proximal: FloatArray  # (n_segments, 3) P to proximal joint
    on_joint: IntArray  # (n_segments,) 1 where U = 0: the special case
    gravity: FloatArray  # (3,) world
    field: FloatArray  # (3,) world


class ChainState(NamedTuple):
    """All that is remembered from one instant to the next; by segment."""

    n_orientations: IntArray  # successive orientations known, up to 2
    time_ns: IntArray  # of the last one
    step: FloatArray  # s, between the last two
    R: FloatArray  # (n, 3, 3) the last one
    rate: FloatArray  # (n, 3) between the last two
    covariance: FloatArray  # (n, 6, 6) of R and rate, where gyro_free is at work
    is_started: IntArray  # 1 where gyro_free has its two earlier orientations
    has_measured: IntArray  # 1 where a measured rate is remembered
    measured_time_ns: IntArray
    measured_rate: FloatArray  # (n, 3)


class Motion(NamedTuple):
    """What one instant gives; by segment, NaN where not defined."""

    R: FloatArray  # (n, 3, 3) segment to world
    rate: FloatArray  # (n, 3) segment axes
    rate_derivative: FloatArray  # (n, 3) segment axes
    acceleration: FloatArray  # (n, 3) of P, world
    position: FloatArray  # (n, 3) of P, world
    status: StatusArray  # (n,)


class Pose(NamedTuple):
    """What is handed on; the fields of ``SkeletonFrame``."""

    q_wb: FloatArray
    angular_rate: FloatArray
    joint_acceleration: FloatArray
    p_w: FloatArray
    status: StatusArray


def initial_state(n: int) -> ChainState:
    """Nothing remembered."""
    return ChainState(
        n_orientations=np.zeros(n, np.int64),
        time_ns=np.zeros(n, np.int64),
        step=np.zeros(n),
        R=np.zeros((n, 3, 3)),
        rate=np.zeros((n, 3)),
        covariance=np.zeros((n, 6, 6)),
        is_started=np.zeros(n, np.int64),
        has_measured=np.zeros(n, np.int64),
        measured_time_ns=np.zeros(n, np.int64),
        measured_rate=np.zeros((n, 3)),
    )


@compiled
def advance(
    chain: Chain,
    state: ChainState,
    weights: Weights,
    longest_gap_s: float,
    time_ns: int,
    root_acceleration: FloatArray,
    root_position: FloatArray,
    observed: SegmentObservations,
) -> tuple[ChainState, Pose]:
    """One instant of the whole body: the state after it, and the pose."""
    state = _remembered(state, time_ns, longest_gap_s)
    motion = _undefined(len(chain.order))
    for s in chain.order:
        if chain.entered_from[s] < 0:
            motion.acceleration[s], motion.position[s] = root_acceleration, root_position
        else:
            _carry_outward(chain, motion, s)
        _measure_rate(state, motion, observed.angular_rate[s], s, time_ns)
        motion.status[s] = _status_before_solving(chain, motion, observed, s)
        if motion.status[s] <= INTERPOLATED:
            _solve(chain, state, weights, motion, observed, s, time_ns)
    return state, _pose(chain, motion)


@compiled
def _remembered(state: ChainState, time_ns: int, longest_gap_s: float) -> ChainState:
    """A copy without what is too old to take differences from, or not older than now at all."""
    n_orientations, is_started = state.n_orientations.copy(), state.is_started.copy()
    has_measured = state.has_measured.copy()
    for s in range(len(n_orientations)):
        age = (time_ns - state.time_ns[s]) * 1e-9
        if age <= 0.0 or age > longest_gap_s:
            n_orientations[s] = 0
        if age < 0.0 or age > longest_gap_s:  # the instant of the start itself is age 0
            is_started[s] = 0
        measured_age = (time_ns - state.measured_time_ns[s]) * 1e-9
        if measured_age <= 0.0 or measured_age > longest_gap_s:
            has_measured[s] = 0
    return ChainState(
        n_orientations,
        state.time_ns.copy(),
        state.step.copy(),
        state.R.copy(),
        state.rate.copy(),
        state.covariance.copy(),
        is_started,
        has_measured,
        state.measured_time_ns.copy(),
        state.measured_rate.copy(),
    )


@compiled
def _undefined(n: int) -> Motion:
    return Motion(
        np.full((n, 3, 3), np.nan),
        np.full((n, 3), np.nan),
        np.full((n, 3), np.nan),
        np.full((n, 3), np.nan),
        np.full((n, 3), np.nan),
        np.full(n, MISSING, np.uint8),
    )


@compiled
def _carry_outward(chain: Chain, motion: Motion, s: int) -> None:
    """Operator 1, and the same for positions."""
    n, L = chain.entered_from[s], chain.L[s]
    lever = derivatives.point_acceleration(motion.rate_derivative[n], motion.rate[n], L)
    motion.acceleration[s] = motion.acceleration[n] + rotation_matrix.rotate(motion.R[n], lever)
    motion.position[s] = motion.position[n] + rotation_matrix.rotate(motion.R[n], L)


@compiled
def _status_before_solving(chain: Chain, motion: Motion, observed: SegmentObservations, s: int) -> int:
    """MISSING cuts the chain: nothing beyond the segment is defined either."""
    n = chain.entered_from[s]
    if observed.status[s] > INTERPOLATED or not is_finite(observed.magnetic_field[s]):
        return MISSING
    if n >= 0 and motion.status[n] == MISSING:
        return MISSING
    return observed.status[s] if is_finite(motion.acceleration[s]) else WARMING_UP


@compiled
def _measure_rate(state: ChainState, motion: Motion, rate: FloatArray, s: int, time_ns: int) -> None:
    """Operator 4 with gyrometers."""
    if not is_finite(rate):
        state.has_measured[s] = 0
        return
    motion.rate[s] = rate
    dt = (time_ns - state.measured_time_ns[s]) * 1e-9
    if state.has_measured[s]:
        motion.rate_derivative[s] = derivatives.difference(state.measured_rate[s], rate, dt)
    state.has_measured[s], state.measured_time_ns[s] = 1, time_ns
    state.measured_rate[s] = rate


@compiled
def _solve(
    chain: Chain,
    state: ChainState,
    weights: Weights,
    motion: Motion,
    observed: SegmentObservations,
    s: int,
    time_ns: int,
) -> None:
    """Operators 2 to 4 for one segment."""
    has_gyrometers = is_finite(motion.rate[s])
    if chain.on_joint[s] or has_gyrometers:
        f = observed.specific_force[s]
        if not chain.on_joint[s]:
            f = f - derivatives.point_acceleration(motion.rate_derivative[s], motion.rate[s], chain.U[s])
        known = motion.acceleration[s] - chain.gravity
        R = rotation_matrix.from_two_vectors(f, observed.magnetic_field[s], known, chain.field)
        if not is_finite(R[0]):
            motion.status[s] = WARMING_UP
            return
        motion.R[s] = R
        _difference_orientations(state, motion, s, time_ns, not has_gyrometers)
    elif state.is_started[s]:
        _advance_gyro_free(chain, state, weights, motion, observed, s, time_ns)
    else:
        motion.status[s] = WARMING_UP


@compiled
def _difference_orientations(
    state: ChainState, motion: Motion, s: int, time_ns: int, use_differences: bool
) -> None:
    """Operator 4 without gyrometers; remembers the orientation either way."""
    R, n = motion.R[s], state.n_orientations[s]
    dt = (time_ns - state.time_ns[s]) * 1e-9
    rate = np.full(3, np.nan)
    if n >= 1:
        rate = derivatives.angular_rate(state.R[s], R, dt)
    if use_differences:
        motion.rate[s] = rate
        if n >= 2:
            motion.rate_derivative[s] = derivatives.difference_of_means(
                state.rate[s], rate, state.step[s], dt
            )
    state.R[s], state.rate[s], state.step[s], state.time_ns[s] = R, rate, dt, time_ns
    state.n_orientations[s] = min(n + 1, 2)


@compiled
def _advance_gyro_free(
    chain: Chain,
    state: ChainState,
    weights: Weights,
    motion: Motion,
    observed: SegmentObservations,
    s: int,
    time_ns: int,
) -> None:
    """Operators 3 and 4. At the instant of the start itself the given rotation is the result."""
    now = Rotation(state.R[s], state.rate[s], np.zeros(3), state.covariance[s])
    dt = (time_ns - state.time_ns[s]) * 1e-9
    if dt > 0.0:
        now = gyro_free.next_rotation(
            now,
            state.step[s] if state.step[s] > 0.0 else dt,
            dt,
            observed.specific_force[s],
            observed.magnetic_field[s],
            motion.acceleration[s] - chain.gravity,
            chain.field,
            chain.U[s],
            weights,
        )
        state.step[s], state.time_ns[s] = dt, time_ns
        state.R[s], state.rate[s], state.covariance[s] = now.R, now.rate, now.covariance
    motion.R[s], motion.rate[s], motion.rate_derivative[s] = now.R, now.rate, now.rate_derivative


@compiled
def _pose(chain: Chain, motion: Motion) -> Pose:
    """From P to the proximal joint of every segment, matrices to quaternions."""
    n = len(chain.order)
    q_wb = np.full((n, 4), np.nan)
    acceleration, p_w = motion.acceleration.copy(), motion.position.copy()
    rate = np.full((n, 3), np.nan)
    for s in range(n):
        arm, R = chain.proximal[s], motion.R[s]
        if motion.status[s] <= INTERPOLATED:
            q_wb[s], rate[s] = quaternion.from_matrix(R), motion.rate[s]
        if arm[0] != 0.0 or arm[1] != 0.0 or arm[2] != 0.0:
            lever = derivatives.point_acceleration(motion.rate_derivative[s], motion.rate[s], arm)
            acceleration[s] += rotation_matrix.rotate(R, lever)
            p_w[s] += rotation_matrix.rotate(R, arm)
    return Pose(q_wb, rate, acceleration, p_w, motion.status)
