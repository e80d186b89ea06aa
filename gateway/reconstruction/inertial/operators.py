"""The articulated method of JP4989660B2 (US8055021): one instant, rank by rank outward from the root.

1. ``a_n = a_{n−1} + R_{n−1} ([ω̇, ω]_{n−1} ⊳ L_{n−1})``: acceleration of the joint P_n.
2. ``f_n − [ω̇, ω]_n ⊳ U_n = R_nᵀ (a_n − g)``, ``x_n = R_nᵀ h``: two vectors known on both sides, hence R_n.
   With ``U_n = 0`` (special case) ω is not needed, with gyroscopes it is measured.
3. With ``U_n ≠ 0`` and no gyroscopes ω depends on the R_n sought: ``next_rotation``.
4. ω and ω̇ by backward differences: of the last three orientations, or ω measured and differenced once.

State and body are arrays in named tuples; ``advance`` returns new ones and changes no argument.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, IntArray, Status, StatusArray
from gateway.geometry import derivatives, quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.derivatives import point_acceleration
from gateway.geometry.vectors import cross, is_finite, norm, skew
from gateway.reconstruction.inertial.observations import SegmentObservations

INTERPOLATED, MISSING, WARMING_UP = Status.INTERPOLATED.value, Status.MISSING.value, Status.WARMING_UP.value


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
    """The state from one instant to the next; by segment."""

    n_orientations: IntArray  # successive orientations known, up to 2
    time_ns: IntArray  # of the last one
    step: FloatArray  # s, between the last two
    R: FloatArray  # (n, 3, 3) the last one
    rate: FloatArray  # (n, 3) between the last two
    covariance: FloatArray  # (n, 6, 6) of R and rate, where gyro_free is at work
    is_started: IntArray  # 1 where gyro_free has its two earlier orientations
    has_measured: IntArray  # 1 where a measured rate is kept
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
    """Return the state of n segments before the first instant."""
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


class Instant(NamedTuple):
    """The inputs of one instant."""

    time_ns: int
    root_acceleration: FloatArray  # (3,) of the root's P, world, m/s²
    root_position: FloatArray  # (3,) m
    observed: SegmentObservations


@compiled
def advance(
    chain: Chain,
    state: ChainState,
    weights: Weights,
    longest_gap_s: float,
    now: Instant,
) -> tuple[ChainState, Pose]:
    """Solve one instant of the whole body; return the state after it, and the pose."""
    state = _remembered(state, now.time_ns, longest_gap_s)
    motion = _undefined(len(chain.order))
    for s in chain.order:
        if chain.entered_from[s] < 0:
            motion.acceleration[s], motion.position[s] = now.root_acceleration, now.root_position
        else:
            _carry_outward(chain, motion, s)
        _measure_rate(state, motion, now.observed.angular_rate[s], s, now.time_ns)
        motion.status[s] = _status_before_solving(chain, motion, now.observed, s)
        if motion.status[s] <= INTERPOLATED:
            _solve(chain, state, weights, motion, now, s)
    return state, _pose(chain, motion)


@compiled
def _remembered(state: ChainState, time_ns: int, longest_gap_s: float) -> ChainState:
    """Return a copy of the state without what is too old to take differences from.

    What is not older than ``time_ns`` is left out as well.
    """
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
    """Set acceleration and position of the segment's P from the segment it is entered from; operator 1."""
    n, L = chain.entered_from[s], chain.L[s]
    lever = derivatives.point_acceleration(motion.rate_derivative[n], motion.rate[n], L)
    motion.acceleration[s] = motion.acceleration[n] + rotation_matrix.rotate(motion.R[n], lever)
    motion.position[s] = motion.position[n] + rotation_matrix.rotate(motion.R[n], L)


@compiled
def _status_before_solving(chain: Chain, motion: Motion, observed: SegmentObservations, s: int) -> int:
    """Return the status of a segment as far as it is known before its orientation is.

    MISSING cuts the chain: nothing beyond the segment is defined either. WARMING_UP: its joint's acceleration
    is not yet defined.
    """
    n = chain.entered_from[s]
    if observed.status[s] > INTERPOLATED or not is_finite(observed.magnetic_field[s]):
        return MISSING
    if n >= 0 and motion.status[n] == MISSING:
        return MISSING
    return observed.status[s] if is_finite(motion.acceleration[s]) else WARMING_UP


@compiled
def _measure_rate(state: ChainState, motion: Motion, rate: FloatArray, s: int, time_ns: int) -> None:
    """Set the measured rate of a segment and, from the last one, its derivative.

    Operator 4 with gyroscopes.
    """
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
    now: Instant,
    s: int,
) -> None:
    """Solve one segment, operators 2 to 4."""
    has_gyroscopes = is_finite(motion.rate[s])
    if chain.on_joint[s] or has_gyroscopes:
        f = now.observed.specific_force[s]
        if not chain.on_joint[s]:
            f = f - derivatives.point_acceleration(motion.rate_derivative[s], motion.rate[s], chain.U[s])
        known = motion.acceleration[s] - chain.gravity
        R = rotation_matrix.from_two_vectors(f, now.observed.magnetic_field[s], known, chain.field)
        if not is_finite(R[0]):
            motion.status[s] = WARMING_UP
            return
        motion.R[s] = R
        _difference_orientations(state, motion, s, now.time_ns, not has_gyroscopes)
    elif state.is_started[s]:
        _advance_gyro_free(chain, state, weights, motion, now, s)
    else:
        motion.status[s] = WARMING_UP


@compiled
def _difference_orientations(
    state: ChainState, motion: Motion, s: int, time_ns: int, use_differences: bool
) -> None:
    """Set rate and its derivative by differences of orientations, operator 4 without gyroscopes.

    With ``use_differences`` False only the state is updated, in case the gyroscopes fail later.
    """
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
    instant: Instant,
    s: int,
) -> None:
    """Solve one segment without gyroscopes whose module is off the joint, operators 3 and 4.

    At the instant of the start itself the given rotation is the result.
    """
    now = Rotation(state.R[s], state.rate[s], np.zeros(3), state.covariance[s])
    dt = (instant.time_ns - state.time_ns[s]) * 1e-9
    if dt > 0.0:
        now = next_rotation(
            now,
            state.step[s] if state.step[s] > 0.0 else dt,
            dt,
            Felt(
                instant.observed.specific_force[s],
                instant.observed.magnetic_field[s],
                motion.acceleration[s] - chain.gravity,
                chain.field,
            ),
            chain.U[s],
            weights,
        )
        state.step[s], state.time_ns[s] = dt, instant.time_ns
        state.R[s], state.rate[s], state.covariance[s] = now.R, now.rate, now.covariance
    motion.R[s], motion.rate[s], motion.rate_derivative[s] = now.R, now.rate, now.rate_derivative


@compiled
def _pose(chain: Chain, motion: Motion) -> Pose:
    """Return the pose: motion moved from P to the proximal joints, matrices as quaternions."""
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


# Operator 3 without gyroscopes: the orientation of a segment whose module sits off the joint
#
# The equations of one instant t_k, with s = a_n − g; all vectors but s and h in segment axes:
#
#     (f)  f = R_kᵀ s + [ω̇, ω] ⊳ U        (x)  x = R_kᵀ h
#     ω_k = log(R_{k−1}ᵀ R_k) / Δt          ω̇_k = (ω_k − ω_{k−1}) / Δt
#
# Why they cannot be solved with the two earlier orientations taken as exact. Through ω̇, (f) reacts to
# R_k with |U|/Δt² (77 000 m/s² a radian at 0.12 m and 800 Hz), to gravity with 9.8. Putting the last ω̇ into
# (f) and iterating therefore diverges; solving for R_k exactly amounts to integrating a pendulum. Let φ be
# a small error about h (x holds the two others), c = x × U, y = R_kᵀ s. Of (f) there remains
#   along h: nothing, a turn of the whole motion about h changes nothing;
#   along U: 0 = (y × x)·U φ − 2 (ω × U)·c φ̇           without ω̇, since U·(ω̇ × U) = 0;
#   along c: 0 = (y × x)·c φ + |c|² φ̈ + …               a pendulum, upside down where U lies along y.
# The last grows like exp(t √(|y|/|U|)), nine-fold in a quarter of a second. Only the one along U
# holds φ to the truth. (Measured: the four-segment arm of the tests is off by more than 100° after 2 s.)
#
# What is done. The two earlier orientations come with their uncertainty: (R_{k−1}, R_{k−2}), or what is the
# same, (R_{k−1}, ω_{k−1}), has errors (δ, ν) of covariance P (6 × 6). Unknown at t_k are these six and ω̇_k,
# linked by the differences above and by nothing else; (f) and (x) are six more rows. Their weighted
# least squares is one Kalman update in nine unknowns. Rows heavy in derivatives then act as a prediction,
# the others correct, and P knows in which direction which is the case. The warm start is a constant rate;
# (f) is linear in ω̇ and R_k so near that one Gauss–Newton step suffices.
#
# Not observable: at rest with f, U and x in one plane, (y × x)·U = 0, and nothing holds φ. From a start that
# is 1° wrong about h (0.12 m, 200 Hz, 25° dip): module across that plane, 0.01° after a quarter of a second;
# hanging below the joint, it swings within 0.8° and dies away in 5 s; above the joint 5° after half a
# second and 14° after 10 s; on the horizontal north of it, lost after 2 s. The arm of the tests, its modules
# east of its joints, holds over 30 s; a trunk that sways with its module north of or above the hip does
# not (15° RMS within 3 s). A prior of 30 rad/s² on ω̇ across U was tried: it keeps that trunk within 2.5°, and
# loses the arm at 1600 Hz. Upright segments need gyroscopes, or a module on the joint.


class Weights(NamedTuple):
    """Standard deviations that weigh the rows against each other."""

    specific_force_sigma: float
    """m/s²: accelerometer, and what backward differences miss."""
    direction_sigma: float
    """rad: direction of sensor X."""
    second_difference_sigma: float
    """rad: ω̇ Δt² about zero. Well above ``direction_sigma`` it leaves ω̇ to the equations."""


class Rotation(NamedTuple):
    """Orientation of one segment with its derivatives and their uncertainty."""

    R: FloatArray  # (3, 3) segment to world
    rate: FloatArray  # (3,) ω over the last step, rad/s
    rate_derivative: FloatArray  # (3,) ω̇, rad/s²
    covariance: FloatArray  # (6, 6) of the errors of R (rad) and rate (rad/s), segment axes


class Felt(NamedTuple):
    """Two vectors that are known on both sides, (3,) each."""

    f: FloatArray  # specific force, segment axes, m/s²
    x: FloatArray  # sensor X, segment axes, any length
    s_w: FloatArray  # a_n − g, world, m/s²
    h_w: FloatArray  # field of sensor X, world, any length


@compiled
def next_rotation(
    before: Rotation, dt_before: float, dt: float, felt: Felt, U: FloatArray, weights: Weights
) -> Rotation:
    """Return the orientation at t_k from the one before and the module's reading.

    U (3,) joint to module. dt: t_k − t_{k−1}, dt_before: t_{k−1} − t_{k−2}, s.
    """
    f, x, s_w, h_w = felt
    w = before.rate
    turn = rotation_matrix.from_rotation_vector(w * dt)
    R = rotation_matrix.multiply(before.R, turn)
    P = _predicted_covariance(before.covariance, turn, w, dt, 0.5 * (dt_before + dt), weights)

    y, direction = rotation_matrix.rotate_inverse(R, s_w), rotation_matrix.rotate_inverse(R, h_w / norm(h_w))
    force_residual = f - y - point_acceleration(np.zeros(3), w, U)
    direction_residual = x / norm(x) - direction
    # columns: δ_k, ν_k, ω̇_k
    H = np.zeros((6, 9))
    _put(H, 0, 0, skew(y), 1.0)
    _put(H, 0, 3, skew(cross(w, U)), -1.0)
    _put(H, 0, 3, rotation_matrix.multiply(skew(w), skew(U)), -1.0)
    _put(H, 0, 6, skew(U), -1.0)
    _put(H, 3, 0, skew(direction), 1.0)

    correction = np.zeros(9)
    for i in range(3):
        correction, P = _with_row(correction, P, H[i], force_residual[i], weights.specific_force_sigma)
        correction, P = _with_row(correction, P, H[i + 3], direction_residual[i], weights.direction_sigma)
    R = rotation_matrix.multiply(R, rotation_matrix.from_rotation_vector(correction[:3]))
    return Rotation(R, w + correction[3:6], correction[6:].copy(), P[:6, :6].copy())


@compiled
def _predicted_covariance(
    P: FloatArray, turn: FloatArray, w: FloatArray, dt: float, dt_middles: float, weights: Weights
) -> FloatArray:
    """Return the covariance (9, 9) of (δ_k, ν_k, ω̇_k).

    ν_k = ν_{k−1} + Δt ω̇_k and δ_k = turnᵀ δ_{k−1} + Δt J ν_k.
    """
    J = np.eye(3) - 0.5 * dt * skew(w)
    F, Q = np.zeros((9, 9)), np.zeros((9, 9))  # F: from (δ_{k−1}, ν_{k−1}, ω̇_k)
    _put(F, 0, 0, turn.T, 1.0)
    _put(F, 0, 3, J, dt)
    _put(F, 3, 3, np.eye(3), 1.0)
    _put(F, 0, 6, J, dt * dt_middles)
    _put(F, 3, 6, np.eye(3), dt_middles)
    _put(F, 6, 6, np.eye(3), 1.0)
    Q[:6, :6] = P
    _put(Q, 6, 6, np.eye(3), (weights.second_difference_sigma / (dt * dt_middles)) ** 2)
    return _product(_product(F, Q), F.T)


@compiled
def _with_row(
    correction: FloatArray, P: FloatArray, row: FloatArray, residual: float, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Return correction (9,) and covariance (9, 9) after one more row of the least squares.

    Rows whose errors are independent may come one by one.
    """
    Ph = np.zeros(9)
    for i in range(9):
        for j in range(9):
            Ph[i] += P[i, j] * row[j]
    variance, expected = sigma * sigma, 0.0
    for i in range(9):
        variance += row[i] * Ph[i]
        expected += row[i] * correction[i]
    new_P = np.empty((9, 9))
    for i in range(9):
        for j in range(9):
            new_P[i, j] = P[i, j] - Ph[i] * Ph[j] / variance
    return correction + Ph * ((residual - expected) / variance), new_P


@compiled
def _product(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return A B, (9, 9). Loops compile in a fraction of the time that a call of BLAS takes to compile."""
    C = np.zeros((9, 9))
    for i in range(9):
        for j in range(9):
            for k in range(9):
                C[i, j] += A[i, k] * B[k, j]
    return C


@compiled
def _put(M: FloatArray, row: int, column: int, block: FloatArray, scale: float) -> None:
    """Add a scaled (3, 3) block to M, in place."""
    for i in range(3):
        for j in range(3):
            M[row + i, column + j] += scale * block[i, j]
