"""One segment without gyroscopes: an error-state filter that carries the motion instead. Compiled.

The specific force is integrated twice (``v̇ = R f + g``, ``ṗ = v``) and meets whatever is known of the place
of a point of the segment; a wrong ``R`` shows in ``p``. So no place is ever differentiated, and no ``ω̇`` is
needed where the point sits off the module: ``p + R r`` is all there is. ``R`` itself follows a constant-jerk
motion: an angular acceleration that forgets itself (Singer 1970) and an angular rate that dies out slowly,
both in world axes, as noisy as the specific force is lively. The field is a known vector, its horizontal and
vertical strength being learnt, plus a disturbance that forgets itself (the field of a room varies by place).

Errors, 23: ``R = exp(θ) R̂`` (rad, world), ω, ω̇, v, p of the module, an arm (segment axes) by which the point
is off its given place, horizontal and vertical strength of the field, disturbance of the field (world, µT).

Fixed-lag smoothing: what was seen later corrects what was estimated before, by the modified Bryson–Frazier
smoother (Bierman 1973): an adjoint ``λ`` runs backward through the rows and transitions that the filter has
written down, and the orientation some time ago is corrected by ``−P λ``. Only products of matrices with
vectors; nothing is inverted.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry import quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Matrix, Record, Records, Vector, constant, records, table_of
from gateway.geometry.vectors import cross, norm, skew

N = 23
RATE, SPIN, VELOCITY, PLACE, ARM, STRENGTH, DISTURBANCE = 3, 6, 9, 12, 15, 18, 20
MOST_ROWS = 32
"""Rows that one instant may have; what comes beyond is left out."""
WATCH_S = 0.3
"""Over which it is watched how lively force and field are."""
STILL_FORCE, STILL_FIELD, STILL_S = 0.15, 1.0, 0.3
"""m/s², µT: less change than that for so long is rest."""


TRIED = "chosen on the arms and rings without gyroscopes of the accuracy suite"


class MotionNoise(Record):
    """Standard deviations and time constants; one set for all bodies and motions. See ``motion_noise``."""

    spin_memory_s: float = constant(0.15, "s", "for which an angular acceleration lasts", TRIED)
    rate_memory_s: float = constant(0.2, "s", "for which an angular rate lasts", TRIED)
    blind_rate_memory_s: float = constant(
        0.1, "s", "the same while the field is disturbed: turns unseen die out faster", TRIED
    )
    spin: float = constant(2.0, "rad/s²", "ω̇ of a segment whose specific force stands still", TRIED)
    spin_per_force: float = constant(3.0, "rad/s² per m/s²", "more by which that varies", TRIED)
    largest_spin: float = constant(60.0, "rad/s²", "and no more than that", TRIED)
    accelerometer: float = constant(0.05, "m/s²/√Hz", "scale and alignment included", "data sheets")
    field: float = constant(1.0, "µT", "of a sample", "data sheets")
    disturbance: float = constant(1.0, "µT", "how far the field varies in a room", "rooms")
    disturbance_memory_s: float = constant(1.0, "s", "for which that lasts", "rooms")
    strength: float = constant(4.0, "µT", "how well the rig knows the field", "rooms")
    norm_tolerance: float = constant(1.5, "µT", "by which the norm may be off", "rooms")
    norm_gain: float = constant(4.0, "", "so many times more counts as noise", TRIED)
    norm_memory_s: float = constant(1.0, "s", "and for so long after", TRIED)
    arm: float = constant(0.005, "m", "how well places on the segment are known", "a tape measure")
    huber: float = constant(4.0, "σ", "beyond which an observation counts less", TRIED)


Errors = Annotated[FloatArray, N]
Transition = Annotated[FloatArray, N, N]


class Row(Record):
    """A scalar observation as it was used: for the smoother."""

    H: Errors
    gain: Errors
    innovation: float
    variance: float  # of the innovation


class Segment(Record):
    """The state of one segment, and the rows of an instant."""

    R: Matrix
    values: Errors  # the quantities that the errors belong to; the first three unused
    P: Transition
    before: Vector  # specific force of the instant before, segment axes, m/s²
    mean_force: Vector  # m/s²
    mean_field: Vector  # µT
    force_square: float  # mean square of what the specific force is off its mean
    field_square: float
    still_s: float  # for how long both have been small
    off_norm: float  # µT by which the field's norm is, or was, off
    x: Errors  # found at this instant
    F: Transition  # of the errors, from the instant before to this one
    n_rows: int
    rows: Annotated[Records[Row], Row, MOST_ROWS]
    log_next: int  # slot of its log to be written next
    log_kept: int  # instants in it


class LoggedInstant(Record):
    """An instant of a segment, written down for the smoother."""

    R: Matrix
    rate: Vector  # world, rad/s
    P: Annotated[FloatArray, 6, N]  # covariance after the instant: rows of orientation and rate
    F: Transition  # to the instant
    n_rows: int
    rows: Annotated[Records[Row], Row, MOST_ROWS]


class Shared(Record):
    """What is the same for all segments; constant but for the last."""

    noise: MotionNoise
    gravity: Vector  # m/s²
    magnetic_field: Vector  # µT
    north: Vector  # the horizontal direction of that
    late_s: float  # by how much magnetometers are late


class Known(NamedTuple):
    """What is known of a point of a segment."""

    value: FloatArray  # (3,) its place m, velocity m/s or acceleration m/s², world
    arm: FloatArray  # (3,) from the module to it, segment axes, m
    sigma: FloatArray  # (3,)
    age_s: float


def motion_noise(**changes: float) -> MotionNoise:
    """Return the defaults with some of them changed. Raises ``TypeError`` for a name not in the table."""
    return table_of(MotionNoise, **changes)


def empty_segments(n: int) -> Records[Segment]:
    """Return n segments that have not been seen."""
    segments = records(Segment, n)
    segments["R"] = np.eye(3)
    return segments


@compiled
def begin(segments: Records[Segment], s: int, common: Records[Shared], f: FloatArray, m: FloatArray) -> bool:
    """Start a segment from its first sample, f and m (3,); return whether that defines an orientation.

    The field is taken to be as strong as measured.
    """
    segment, noise, h, x = segments[s], common[0].noise, common[0].magnetic_field, segments[s].values
    R = rotation_matrix.from_two_vectors(f, m, -common[0].gravity, h)
    if not math.isfinite(R.sum()):
        return False
    segment.R[:] = R
    x[:] = 0.0
    x[STRENGTH] = math.hypot(h[0], h[1]) / norm(h) * norm(m)
    x[STRENGTH + 1] = h[2] / norm(h) * norm(m)
    sigmas = (0.3, 0.5, noise.spin, 1.0, 1.0, noise.arm)
    segment.P[:] = 0.0
    for i in range(18):
        segment.P[i, i] = sigmas[i // 3] ** 2
    for i in range(2):
        segment.P[STRENGTH + i, STRENGTH + i] = noise.strength**2
    for i in range(3):
        segment.P[DISTURBANCE + i, DISTURBANCE + i] = noise.disturbance**2
    segment.before[:] = f
    segment.mean_force[:], segment.mean_field[:] = f, m
    segment.force_square, segment.field_square, segment.still_s = 1.0, 1.0, 0.0
    segment.off_norm = 0.0
    segment.log_kept = 0
    return True


@compiled
def see(
    segments: Records[Segment], s: int, common: Records[Shared], f: FloatArray, m: FloatArray, dt: float
) -> None:
    """Predict over dt (s) to the instant of f and m (3,), segment axes, and add the rows that these give.

    m may be NaN.
    """
    segment, shared = segments[s], common[0]
    _predict(segment, shared, f, dt)
    _watch(segment, shared.noise, f, m, dt)
    is_at_rest = _add_zero_rate(segment, shared.noise, dt)
    is_disturbed = segment.off_norm > shared.noise.norm_tolerance
    if math.isfinite(m[0] + m[1] + m[2]) and not (is_at_rest and is_disturbed):
        _add_field(segment, shared, m)


@compiled
def _predict(segment: Segment, shared: Shared, f: FloatArray, dt: float) -> None:
    """Predict over dt (s) to the instant of f (3,), segment axes, and clear the rows and the errors found."""
    noise, g = shared.noise, shared.gravity
    x, R = segment.values, segment.R
    w, spin = x[RATE:SPIN].copy(), x[SPIN:VELOCITY].copy()
    turn = rotation_matrix.from_rotation_vector(w * dt + spin * (0.5 * dt * dt))
    after = rotation_matrix.multiply(turn, R)
    force = 0.5 * (rotation_matrix.rotate(R, segment.before) + rotation_matrix.rotate(after, f))
    a = force + g

    is_blind = segment.off_norm > noise.norm_tolerance + 2.0
    keep = math.exp(-dt / (noise.blind_rate_memory_s if is_blind else noise.rate_memory_s))
    keep_spin, keep_field = math.exp(-dt / noise.spin_memory_s), math.exp(-dt / noise.disturbance_memory_s)
    F = _transition(turn, force, keep, keep_spin, keep_field, dt)

    # the state, from the mean specific force over the step
    x[PLACE:ARM] += x[VELOCITY:PLACE] * dt + a * (0.5 * dt * dt)
    x[VELOCITY:PLACE] += a * dt
    x[RATE:SPIN] = (w + spin * dt) * keep
    x[SPIN:VELOCITY] = spin * keep_spin
    x[DISTURBANCE:N] *= keep_field

    segment.R[:] = after
    segment.before[:] = f
    segment.F[:] = F
    segment.x[:] = 0.0
    segment.n_rows = 0

    # its covariance: a segment turns the livelier, the more its specific force varies
    liveliness = noise.spin + noise.spin_per_force * math.sqrt(segment.force_square)
    spin_sigma = min(noise.largest_spin, liveliness)
    segment.P[:] = product_transposed(product(F, segment.P), F)
    for i in range(3):
        segment.P[SPIN + i, SPIN + i] += spin_sigma**2 * (1.0 - keep_spin * keep_spin)
        segment.P[VELOCITY + i, VELOCITY + i] += noise.accelerometer**2 * dt
        segment.P[DISTURBANCE + i, DISTURBANCE + i] += noise.disturbance**2 * (1.0 - keep_field * keep_field)


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
def _watch(segment: Segment, noise: MotionNoise, f: FloatArray, m: FloatArray, dt: float) -> None:
    """Update how much force and field vary, and how far the field's norm is off; m may be NaN."""
    gain = 1.0 - math.exp(-dt / WATCH_S)
    segment.force_square = _watched(segment.mean_force, segment.force_square, f, gain)
    segment.field_square = _watched(segment.mean_field, segment.field_square, m, gain)
    if math.isfinite(m[0]):
        off = abs(norm(m) - math.hypot(segment.values[STRENGTH], segment.values[STRENGTH + 1]))
        segment.off_norm = max(off, segment.off_norm * math.exp(-dt / noise.norm_memory_s))


@compiled
def _watched(mean: FloatArray, square: float, value: FloatArray, gain: float) -> float:
    """Return the mean square of what a value (3,) is off its mean, with one more; mean (3,) in place."""
    change = 0.0
    if not math.isfinite(value[0]):
        return square
    for i in range(3):
        off = value[i] - mean[i]
        change += off * off
        mean[i] += gain * off
    return square + gain * (change - square)


@compiled
def add_row(segment: Segment, H: FloatArray, residual: float, variance: float) -> None:
    """Add one scalar observation ``residual = H e + noise``, H (N,); ``x`` gathers the errors found.

    Beyond ``MOST_ROWS`` an instant's observations are left out.
    """
    k = segment.n_rows
    if k >= MOST_ROWS:
        return
    P, x, Ph, expected = segment.P, segment.x, np.zeros(N), 0.0
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
    row = segment.rows[k]
    row.gain[:], row.H[:], row.innovation, row.variance = gain, H, off, total
    segment.n_rows = k + 1


@compiled
def add_vector(
    segment: Segment, H: FloatArray, residual: FloatArray, sigma: FloatArray, huber: float
) -> None:
    """Add three rows, H (3, N), of standard deviations sigma (3,); outliers get more variance."""
    P, x, distance = segment.P, segment.x, 0.0
    for i in range(3):
        off, variance = residual[i], sigma[i] ** 2
        for j in range(N):
            off -= H[i, j] * x[j]
            if H[i, j] != 0.0:
                for k in range(N):
                    variance += H[i, j] * P[j, k] * H[i, k]
        distance += off * off / variance
    inflation = max(1.0, math.sqrt(distance) / huber)
    for i in range(3):
        add_row(segment, H[i], residual[i], sigma[i] ** 2 * inflation)


@compiled
def _add_zero_rate(segment: Segment, noise: MotionNoise, dt: float) -> bool:
    """Add rows of no rate and no angular acceleration while a segment is at rest; return whether it is.

    It is at rest when force and field have hardly varied for a while; a field that is disturbed may vary.
    """
    is_still = segment.force_square < STILL_FORCE**2
    is_still &= segment.field_square < STILL_FIELD**2 or segment.off_norm > noise.norm_tolerance
    segment.still_s = segment.still_s + dt if is_still else 0.0
    if segment.still_s < STILL_S:
        return False
    for i in range(6):
        H = np.zeros(N)
        H[RATE + i] = 1.0
        add_row(segment, H, -segment.values[RATE + i], (0.02 if i < 3 else 0.2) ** 2)
    return True


@compiled
def _add_field(segment: Segment, shared: Shared, m: FloatArray) -> None:
    """Add the rows of the field m (3,) µT, segment axes, as it was ``late_s`` ago."""
    noise, north, delay = shared.noise, shared.north, shared.late_s
    v, w = segment.values, segment.values[RATE:SPIN]
    back = rotation_matrix.from_rotation_vector(w * -delay + v[SPIN:VELOCITY] * (0.5 * delay * delay))
    seen = rotation_matrix.rotate(back, rotation_matrix.rotate(segment.R, m))
    known = north * v[STRENGTH] + v[DISTURBANCE:N]
    known[2] += v[STRENGTH + 1]
    H, K = np.zeros((3, N)), skew(seen)
    for i in range(3):
        for j in range(3):
            H[i, j], H[i, RATE + j] = K[i, j], -delay * K[i, j]
        H[i, STRENGTH] = north[i]
        H[i, DISTURBANCE + i] = 1.0
    H[2, STRENGTH + 1] = 1.0
    excess = max(0.0, segment.off_norm - noise.norm_tolerance)
    sigma = math.sqrt(noise.field**2 + (noise.norm_gain * excess) ** 2)
    add_vector(segment, H, seen - known, np.full(3, sigma), noise.huber)


@compiled
def add_position(segments: Records[Segment], s: int, common: Records[Shared], known: Known) -> None:
    """Add the rows of the position of a point of the segment, ``age_s`` ago."""
    segment, age_s = segments[s], known.age_s
    v, R = segment.values, segment.R
    r = rotation_matrix.rotate(R, known.arm + v[ARM:STRENGTH])
    past = v[PLACE:ARM] + r - age_s * (v[VELOCITY:PLACE] + cross(v[RATE:SPIN], r))
    H, K = np.zeros((3, N)), skew(r)
    for i in range(3):
        H[i, PLACE + i], H[i, VELOCITY + i] = 1.0, -age_s
        for j in range(3):
            H[i, j], H[i, ARM + j] = -K[i, j], R[i, j]
    add_vector(segment, H, known.value - past, known.sigma, common[0].noise.huber)


@compiled
def add_velocity(segments: Records[Segment], s: int, common: Records[Shared], known: Known) -> None:
    """Add the rows of the velocity of a point of the segment."""
    segment = segments[s]
    v = segment.values
    r = rotation_matrix.rotate(segment.R, known.arm)
    H, K = np.zeros((3, N)), skew(r)
    W = product(skew(v[RATE:SPIN]), K)
    for i in range(3):
        H[i, VELOCITY + i] = 1.0
        for j in range(3):
            H[i, RATE + j], H[i, j] = -K[i, j], -W[i, j]
    residual = known.value - v[VELOCITY:PLACE] - cross(v[RATE:SPIN], r)
    add_vector(segment, H, residual, known.sigma, common[0].noise.huber)


@compiled
def add_acceleration(segments: Records[Segment], s: int, common: Records[Shared], known: Known) -> None:
    """Add the rows of the acceleration of a point of the segment, gravity taken out.

    They observe the orientation; velocity and position of the module are not observed by them and are set to
    zero.
    """
    segment = segments[s]
    v = segment.values
    r = rotation_matrix.rotate(segment.R, known.arm)
    force = rotation_matrix.rotate(segment.R, segment.before)
    w = v[RATE:SPIN]
    residual = known.value - common[0].gravity - force - cross(v[SPIN:VELOCITY], r) - cross(w, cross(w, r))
    H, K, M = np.zeros((3, N)), skew(force), skew(r)
    for i in range(3):
        for j in range(3):
            H[i, j], H[i, SPIN + j] = -K[i, j], -M[i, j]
    add_vector(segment, H, residual, known.sigma, common[0].noise.huber)
    segment.values[VELOCITY:ARM] = 0.0


@compiled
def catch(segments: Records[Segment], s: int, place: FloatArray, arm: FloatArray) -> None:
    """Put a segment that had no hold where it now is known to be: ``place`` (3,) of the point at ``arm``."""
    segment = segments[s]
    segment.values[PLACE:ARM] = place - rotation_matrix.rotate(segment.R, arm)
    segment.P[VELOCITY:ARM, :] = 0.0
    segment.P[:, VELOCITY:ARM] = 0.0
    for i in range(3):
        segment.P[VELOCITY + i, VELOCITY + i], segment.P[PLACE + i, PLACE + i] = 4.0, 0.01


@compiled
def correct(segments: Records[Segment], s: int) -> None:
    """Correct the state by the errors found, ``x``, and make P symmetric."""
    segment = segments[s]
    P, x = segment.P, segment.x
    segment.R[:] = rotation_matrix.multiply(rotation_matrix.from_rotation_vector(x[:3]), segment.R)
    segment.values[3:] += x[3:]
    for i in range(N):
        for j in range(i):
            mean = 0.5 * (P[i, j] + P[j, i])
            P[i, j], P[j, i] = mean, mean


# Points of a segment


@compiled
def point(segments: Records[Segment], s: int, arm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the position (3,) of a point, world, m, and its covariance (3, 3).

    arm: (3,) from the module, segment axes, m.
    """
    state = segments[s]
    r = rotation_matrix.rotate(state.R, arm)
    J, K = np.zeros((3, 6)), skew(r)
    C = np.zeros((6, 6))
    for i in range(3):
        J[i, 3 + i] = 1.0
        for j in range(3):
            J[i, j] = -K[i, j]
            C[i, j], C[i, 3 + j] = state.P[i, j], state.P[i, PLACE + j]
            C[3 + i, j], C[3 + i, 3 + j] = state.P[PLACE + i, j], state.P[PLACE + i, PLACE + j]
    covariance = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for a in range(6):
                covariance[i, j] += J[i, a] * _dot_row(C, a, J, j)
    return state.values[PLACE:ARM] + r, covariance


@compiled
def at_joint(
    segments: Records[Segment], s: int, common: Records[Shared], U: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return orientation (4,), angular rate (3,), the joint's acceleration (3,) and sigma.

    The rate is in segment axes, rad/s, the acceleration in the world, m/s², sigma of the orientation, rad.
    U (3,): joint to module, segment axes, m.
    """
    g = common[0].gravity
    state = segments[s]
    w, arm = state.values[RATE:SPIN], rotation_matrix.rotate(state.R, -U)
    at_module = rotation_matrix.rotate(state.R, state.before) + g
    around = cross(state.values[SPIN:VELOCITY], arm) + cross(w, cross(w, arm))
    sigma = math.sqrt(state.P[0, 0] + state.P[1, 1] + state.P[2, 2])
    rate = rotation_matrix.rotate_inverse(state.R, w)
    return quaternion.from_matrix(state.R), rate, at_module + around, sigma


@compiled
def _dot_row(C: FloatArray, a: int, J: FloatArray, j: int) -> float:
    """Return row a of C (6, 6) times row j of J (3, 6)."""
    total = 0.0
    for b in range(6):
        total += C[a, b] * J[j, b]
    return total


# Fixed-lag smoothing


@compiled
def note(segments: Records[Segment], s: int, log: Records[LoggedInstant]) -> None:
    """Append the instant to the segment's log, a ring."""
    segment, now = segments[s], log[segments[s].log_next]
    now.F[:], now.P[:], now.R[:] = segment.F, segment.P[:6], segment.R
    now.rate[:] = segment.values[RATE:SPIN]
    now.n_rows = segment.n_rows
    for row in range(segment.n_rows):
        now.rows[row] = segment.rows[row]
    segment.log_next = (segment.log_next + 1) % len(log)
    segment.log_kept = min(segment.log_kept + 1, len(log))


@compiled
def smoothed(
    segments: Records[Segment], s: int, log: Records[LoggedInstant]
) -> tuple[FloatArray, FloatArray]:
    """Return orientation (3, 3) and rate (3,), world, of the oldest instant, corrected by all since."""
    length, segment = len(log), segments[s]
    adjoint = np.zeros(N)
    oldest = log[(segment.log_next - segment.log_kept) % length]
    for back in range(segment.log_kept - 1):
        now = log[(segment.log_next - 1 - back) % length]
        for k in range(now.n_rows - 1, -1, -1):
            row, along = now.rows[k], 0.0
            for i in range(N):
                along += row.gain[i] * adjoint[i]
            scale = along + row.innovation / row.variance
            for i in range(N):
                adjoint[i] -= row.H[i] * scale
        earlier = np.zeros(N)
        for i in range(N):
            if adjoint[i] != 0.0:
                for j in range(N):
                    earlier[j] += now.F[i, j] * adjoint[i]
        adjoint = earlier
    correction = np.zeros(6)
    for i in range(6):
        for j in range(N):
            correction[i] -= oldest.P[i, j] * adjoint[j]
    R = rotation_matrix.multiply(rotation_matrix.from_rotation_vector(correction[:3]), oldest.R)
    return R, oldest.rate + correction[3:]


# Products of matrices


@compiled
def product(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return A B; shapes (n, n), (n, n). Fast for an A that is mostly zeros."""
    n = A.shape[0]
    C = np.zeros((n, n))
    for i in range(n):
        for k in range(n):
            a = A[i, k]
            if a != 0.0:
                for j in range(n):
                    C[i, j] += a * B[k, j]
    return C


@compiled
def product_transposed(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return A Bᵀ; shapes (n, n), (n, n). Fast for a B that is mostly zeros."""
    n = A.shape[0]
    C = np.zeros((n, n))
    for j in range(n):
        for k in range(n):
            b = B[j, k]
            if b != 0.0:
                for i in range(n):
                    C[i, j] += A[i, k] * b
    return C
