"""One module's filter: VQF, and what VQF has no answer to, gaps. Compiled but for VQF's part.

VQF (Laidig & Seel, Information Fusion 91, 2023) takes every sample for the next one. After a gap it either
goes on from where it was, tens of degrees off and for tens of seconds, or begins anew from one specific force
that is no plumb line. Here a short gap is bridged by samples interpolated between its ends; after a longer
one the module settles for three seconds (``settle``), while VQF goes on integrating and keeps what it knows
of the gyroscope's bias and the field; then VQF is put where the module was found.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from devices.deferred import VQF
from gateway.frames import FloatArray, IntArray
from gateway.geometry import quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, is_finite, norm, vector
from gateway.reconstruction.inertial.tree.clipping import is_at_end, missed_angle

LONGEST_BRIDGE_S = 0.1
"""As long as the assembler bridges by default. What the module did is known then; nothing has to settle."""
BIAS_PAUSE_S = 10.0
"""After settling VQF's inclination still moves to what its low-pass finds, for three of its time constants:
it would take this for a bias of the gyroscopes, and after many gaps believe in one."""
LONGEST_GAP_S = 0.2
"""After a longer one the last orientation is a mere guess, and saturated gyroscopes do not give even that."""
_LONGEST_GAP_NS = round(LONGEST_GAP_S * 1e9)
_AVERAGES = (
    "accLpState",
    "motionBiasEstRLpState",
    "motionBiasEstBiasLpState",
    "restGyrLpState",
    "restAccLpState",
    "magNormDipLpState",
)


_NONE = np.full(3, np.nan)


class Sample(NamedTuple):
    """One sample of a module, sensor axes; None where a sensor has no value."""

    specific_force: FloatArray | None  # (3,) m/s²
    angular_rate: FloatArray  # (3,) rad/s
    magnetic_field: FloatArray | None  # (3,) any unit

    def between(self, other: Sample, share: float) -> Sample:
        """Return the sample that far (``share``, 0 to 1) on the way to another one, interpolated linearly."""
        pairs = zip(self, other, strict=True)
        f, w, x = (None if a is None or b is None else (1.0 - share) * a + share * b for a, b in pairs)
        assert w is not None  # of both
        return Sample(f, w, x)


class Clip:
    """A time at the end of the gyroscope's range, sensor axes: what ``joint`` knows of it (``tree.clipping``)
    too."""

    def __init__(self, rate: FloatArray, slope: FloatArray) -> None:
        """Begin with the rate (3,), rad/s, of the last sample within the range, and its slope, rad/s²."""
        self._rate, self._slope, self._last = rate, slope, rate
        self._shown, self._ends, self._lasted_s = np.zeros(3), np.zeros(3), 0.0

    def add(self, rate: FloatArray, dt: float, *, is_clipped: bool = False) -> None:
        """Add a rate (3,) at the end of the range, or the first one after it; dt: s."""
        self._shown += 0.5 * dt * (self._last + rate)
        self._last = rate
        self._lasted_s += dt
        if is_clipped:
            self._ends = np.maximum(self._ends, is_at_end(rate))

    def missed(self, slope: FloatArray) -> FloatArray:
        """Return what the gyroscope has missed, (3,) rad; slope: (3,) after the first rate, rad/s²."""
        known = zip(self._rate, self._slope, self._last, slope, self._shown, strict=True)
        missed: FloatArray = self._ends * [missed_angle(*axis, self._lasted_s) for axis in known]
        return missed


class ModuleFilter:
    """VQF with default parameters, and what it needs around gaps. Its world is level, y towards magnetic
    north; without a field the heading is arbitrary, and kept over gaps."""

    def __init__(self, interval_s: float, gravity: float, motion: MotionStatistics, segment: int) -> None:
        """Create a filter of one module that has seen no sample yet.

        interval_s: time between samples, s. gravity: m/s². motion: statistics of all modules, of which row
        ``segment`` is this module's; the caller of ``take`` updates them.
        """
        self._interval_s = float(interval_s)
        self._gravity = gravity
        self._motion, self._segment = motion, segment
        self._vqf = VQF(interval_s)
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        self.has_field = False
        """Whether the module has ever given one."""
        self._received_ns = self._sound_ns = 0
        self._was_blind = False
        self._last: Sample | None = None
        """The last sound one, of ``_sound_ns``."""
        self._is_known = False
        self._vqf.setMotionBiasEstEnabled(True)
        self._vqf.resetState()
        self._before: BeforeSilence | None = None
        """What was known before the gap; None unless the module settles."""
        self._pause_s = 0.0
        """After settling, time until the bias is estimated in motion again, s."""
        self._since = nothing_since()
        self._q_wi, self._sigma = np.array([1.0, 0.0, 0.0, 0.0]), 0.0
        self._kept: _Kept | None = None
        self._before_last: Sample | None = None
        """The sound one right before that; None: there is none."""
        self._clip: Clip | None = None
        """The gyroscope has been at the end of its range, and what it missed is not yet made up for."""

    @property
    def is_known(self) -> bool:
        """Whether there has been any sample."""
        return self._is_known

    @property
    def orientation(self) -> FloatArray:
        """Sensor to the filter's world, (4,)."""
        if self._before is not None:
            return quaternion.multiply(self._q_wi, self._vqf.getQuat3D())
        return np.asarray(self._vqf.getQuat9D() if self.has_field else self._vqf.getQuat6D())

    def is_silent(self, time_ns: int) -> bool:
        """Return whether the last values are older than ``LONGEST_GAP_S``, too old to go on from."""
        return time_ns - self._received_ns > _LONGEST_GAP_NS

    def take(self, sample: Sample, time_ns: int) -> None:
        """Take a sound sample. A gap before it is bridged, or the module begins to settle."""
        is_next = time_ns - self._sound_ns <= 1.5e9 * self._interval_s
        if self._last is not None and not is_next:
            self._catch_up(self._last, sample, (time_ns - self._sound_ns) * 1e-9)
        self._kept = None
        used = sample if self._clip is None else self._made_up(self._clip, sample, is_next, time_ns)
        self._was_blind = False
        self._received_ns = self._sound_ns = time_ns
        self._before_last, self._last = self._last if is_next else None, sample
        self._advance(used)

    def _note_clip(self, rate: FloatArray) -> None:
        """Add a rate (3,) at the end of the range, whose beginning shows after two sound samples only."""
        if not self._was_blind:
            self._clip = None
            if self._last is not None and self._before_last is not None:
                slope = (self._last.angular_rate - self._before_last.angular_rate) / self._interval_s
                self._clip = Clip(self._last.angular_rate, slope)
        if self._clip is not None:
            self._clip.add(rate, self._interval_s, is_clipped=True)

    def _made_up(self, clip: Clip, sample: Sample, is_next: bool, time_ns: int) -> Sample:
        """Return a sound sample after a clip, the second one with what the gyroscope has missed in its rate.

        is_next: it comes right after a sound one.
        """
        if self._was_blind:
            clip.add(sample.angular_rate, self._interval_s)
            if time_ns - self._sound_ns > _LONGEST_GAP_NS:
                self._clip = None
            return sample
        self._clip = None
        if not is_next or self._last is None:
            return sample
        slope = (sample.angular_rate - self._last.angular_rate) / self._interval_s
        return sample._replace(angular_rate=sample.angular_rate + clip.missed(slope) / self._interval_s)

    def take_doubtful(self, sample: Sample, time_ns: int, is_blind: bool) -> None:
        """Take the last sample repeated, or one of a saturated gyroscope (``is_blind``).

        Its effect lasts until a sound sample comes, which takes it back. A repeated sample is used for no
        longer than a gap that is bridged.
        """
        if self._kept is None:
            since = Since(*(sums.copy() for sums in self._since))
            self._kept = _Kept(self._vqf.state, self._before, self._pause_s, since, self._q_wi, self._sigma)
        if is_blind:
            self._note_clip(sample.angular_rate)
        self._was_blind |= is_blind
        if not is_blind:
            self._received_ns = time_ns
        if is_blind or self._last is None or time_ns - self._sound_ns <= LONGEST_BRIDGE_S * 1e9:
            self._advance(sample)

    def _advance(self, sample: Sample) -> None:
        """Feed VQF one sample, one interval after the one before; go on settling while the module does."""
        f, w, x = sample
        self._is_known = True
        self._vqf.updateGyr(w)
        if f is not None:
            self._vqf.updateAcc(f)
        if x is not None:
            self._vqf.updateMag(x)
            if not self.has_field:
                self.has_field = True
                self._motion.seconds[self._segment] = 0.0  # the mean orientation was in another world
        if self._before is None:
            if self._pause_s > 0.0:
                self._pass_pause()
            return
        q_is = self._vqf.getQuat3D()
        f, x = _NONE if f is None else f, _NONE if x is None else x
        self._q_wi, self._sigma = settle(self._before, self._since, q_is, f, x, self._interval_s)
        if self._since.seconds[0] >= SETTLED_S:
            self._hand_over()

    def _pass_pause(self) -> None:
        """Count one sample off the pause of the bias estimation, and end the pause when it is over."""
        self._pause_s -= self._interval_s
        if self._pause_s <= 0.0:
            self._vqf.setMotionBiasEstEnabled(True)

    def _catch_up(self, last: Sample, sample: Sample, since_s: float) -> None:
        """Bridge the gap between two sound samples, or begin to settle after it.

        What doubtful samples in it have done is taken back.
        """
        if self._was_blind and since_s <= LONGEST_GAP_S:
            return  # the end of the range is the best guess, until the next sample shows more
        if self._kept is not None:
            self._vqf.setMotionBiasEstEnabled(self._kept.before is None and self._kept.pause_s <= 0.0)
            self._vqf.state, self._before, self._pause_s, self._since, self._q_wi, self._sigma = self._kept
        n_missed = round(since_s / self._interval_s) - 1
        if since_s <= LONGEST_BRIDGE_S:
            for k in range(1, n_missed + 1):
                self._advance(last.between(sample, k / (n_missed + 1)))
            return
        gap_s = n_missed * self._interval_s
        bias = self._vqf.getBiasEstimate()[0]
        rate = 0.5 * (last.angular_rate + sample.angular_rate) - bias
        self._resume(after_gap(self._motion, self._segment, gap_s, rate), gap_s)

    def _resume(self, expected: tuple[FloatArray, float], gap_s: float) -> None:
        """Begin to settle from the next sample on.

        expected: orientation after the gap (4,), and its standard deviation about an axis in rad, for one
        that was known before the gap. gap_s: the gap's length, s.
        """
        q_expected, sigma = expected
        if self._before is not None:
            sigma = math.hypot(sigma, self._sigma)
        state = self._vqf.state
        field_norm, dip = state["magRefNorm"], state["magRefDip"]
        self._forget_averages(state, gap_s)
        q_wi = quaternion.multiply(q_expected, quaternion.conjugate(self._vqf.getQuat3D()))
        q_wi, swing = quaternion.normalise(q_wi), math.sqrt(self._motion.force_square[self._segment])
        self._before = BeforeSilence(q_wi, float(sigma), swing, field_norm, dip, self._gravity)
        self._since = nothing_since()

    def _forget_averages(self, state: dict[str, object], gap_s: float) -> None:
        """Drop VQF's averages of the time before the gap.

        The bias stays, less certain, as far as it was learnt.
        """
        for name in _AVERAGES:
            state[name] = [float("nan")] * len(state[name])  # type: ignore[arg-type]
        largest, step = self._vqf.coeffs["biasP0"], self._vqf.coeffs["biasV"] * gap_s / self._interval_s
        covariance = np.array(state["biasP"])
        covariance[::4] = np.minimum(covariance[::4] + step, largest)
        bias = np.array(state["bias"]) * (1.0 - (covariance[::4] / largest) ** 2)
        state |= {"bias": bias.tolist(), "biasP": covariance.tolist(), "restT": 0.0, "restDetected": False}
        self._vqf.state = state
        self._vqf.setMotionBiasEstEnabled(False)  # VQF's own inclination is not to be believed meanwhile

    def _hand_over(self) -> None:
        """Set VQF to the orientation that settling has found.

        VQF is level then, its low-pass as if it had been so for long.
        """
        vqf, state = self._vqf, self._vqf.state
        level = quaternion.rotate(quaternion.conjugate(self._q_wi), np.array([0.0, 0.0, self._gravity]))
        b, a = vqf.coeffs["accLpB"], vqf.coeffs["accLpA"]
        state["accLpState"] = [part * share for part in level for share in (1.0 - b[0], b[2] - a[1])]
        state["lastAccLp"] = level.tolist()
        state["accQuat"], state["delta"] = self._q_wi.tolist(), 0.0
        if self.has_field:  # as VQF begins: the next sample is one of so many
            state["kMagInit"] = self._interval_s / SETTLED_S
        vqf.state = state
        self._before = None
        self._pause_s = BIAS_PAUSE_S


class _Kept(NamedTuple):
    """The state before doubtful samples, to go back to."""

    state: dict[str, object]
    before: BeforeSilence | None
    pause_s: float
    since: Since
    q_wi: FloatArray
    sigma: float


# How a module has been moving, and hence what a gap in its samples may have done to it
#
# Within a tenth of a second or so a segment turns by about the mean of the rates before and after. Beyond
# that it is unknown which way it turned; but limbs come back to where they usually are, so that the mean
# orientation of the last seconds is a better guess than the last one as soon as the module may have left it.


RATE_MEMORY_S, MEAN_MEMORY_S = 3.0, 8.0
LONGEST_TURN_S = 0.4
"""Up to here the mean rate of both ends shows how far a limb has turned; measured on people and on a rig."""
CURVATURE = 2.0
"""1/s: error of that turn over rate times the gap's square."""
WANDERING = 0.78
"""√s: error of the last orientation over rate times the root of the gap."""
DRIFT = 0.15
"""rad/s at which the mean orientation itself becomes old."""
SLOWEST = 0.5
"""rad/s: so fast any module may turn during a gap, however still it was."""
FLOOR, START_ERROR = 0.02, 0.5
"""rad: of any orientation before a gap, and of one at the start, less with every second since."""


class MotionStatistics(NamedTuple):
    """By segment, changed in place; of the sound samples."""

    orientation: FloatArray  # (n, 4) the last, sensor to the filter's world
    mean: FloatArray  # (n, 4) of the last seconds; the shorter it is, the more they spread
    specific_force: FloatArray  # (n, 3) last values, sensor axes
    angular_rate: FloatArray  # (n, 3)
    magnetic_field: FloatArray  # (n, 3) NaN where there was none
    rate_square: FloatArray  # (n,) (rad/s)², mean square of the rate about an axis
    force_square: FloatArray  # (n,) (m/s²)², mean square of what the specific force's norm is off gravity
    seconds: FloatArray  # (n,) of samples, up to now


def no_motion_statistics(n: int) -> MotionStatistics:
    """Return the statistics of n segments before their first samples."""
    q, v = np.zeros((n, 4)), np.zeros((n, 3))
    return MotionStatistics(q, q.copy(), v, v.copy(), v.copy(), np.zeros(n), np.zeros(n), np.zeros(n))


def clear(motion: MotionStatistics) -> None:
    """Reset the statistics, in place."""
    for values in motion:
        values[...] = 0.0


@compiled
def note(
    motion: MotionStatistics,
    segments: IntArray,
    rows: IntArray,
    is_sound: NDArray[np.bool_],
    q: FloatArray,
    f: FloatArray,
    w: FloatArray,
    x: FloatArray,
    gravity: float,
    dt: float,
) -> None:
    """Update the statistics by one instant.

    segments, rows: (k,) segments with modules, and these; is_sound: (n,), q: (n, 4) by segment; f, w, x: (m,
    3) by row; dt: s between samples.
    """
    for s, row in zip(segments, rows):  # noqa: B905 - strict is not known to the compiler
        if not is_sound[s]:
            continue
        motion.orientation[s] = q[s]
        motion.specific_force[s], motion.angular_rate[s], motion.magnetic_field[s] = f[row], w[row], x[row]
        motion.seconds[s] += dt
        share = dt / min(motion.seconds[s], RATE_MEMORY_S)
        square = (w[row, 0] ** 2 + w[row, 1] ** 2 + w[row, 2] ** 2) / 3.0
        motion.rate_square[s] += share * (square - motion.rate_square[s])
        motion.force_square[s] += share * ((norm(f[row]) - gravity) ** 2 - motion.force_square[s])
        share = dt / min(motion.seconds[s], MEAN_MEMORY_S)
        sign = -1.0 if np.sum(q[s] * motion.mean[s]) < 0.0 else 1.0
        motion.mean[s] += share * (sign * q[s] - motion.mean[s])


@compiled
def after_gap(motion: MotionStatistics, s: int, gap_s: float, rate: FloatArray) -> tuple[FloatArray, float]:
    """Return the orientation (4,) of segment s expected after a gap, and its sigma about an axis, rad.

    rate: (3,) mean of those before and after the gap, rad/s, without bias.
    """
    known = FLOOR + START_ERROR / (1.0 + motion.seconds[s])
    fastest = math.sqrt(max(motion.rate_square[s], SLOWEST**2, np.sum(rate**2) / 3.0))
    if gap_s <= LONGEST_TURN_S:
        turned = quaternion.from_rotation_vector(rate * gap_s)
        return quaternion.multiply(motion.orientation[s], turned), CURVATURE * gap_s**2 * fastest + known
    wandered = WANDERING * math.sqrt(gap_s) * fastest
    length = math.sqrt(np.sum(motion.mean[s] ** 2))
    spread = math.sqrt(max(0.0, 4.0 * (1.0 - length**2)) + (DRIFT * gap_s) ** 2)
    if spread < wandered and length > 0.0:
        return motion.mean[s] / length, min(spread, math.pi) + known
    return motion.orientation[s].copy(), min(wandered, math.pi) + known


# Where a module is that is back after a gap: from all its samples since, and what was known before
#
# Its gyroscope carries every sample since into one frame, that of the return; how this frame i stands in the
# world does not change any more. Three things show it: the mean specific force there, which is gravity but
# for the velocity gained meanwhile; the mean magnetic field, or its heading alone where its dip is not
# known; and the orientation before the gap. Each counts by how uncertain it is, and the orientation that all
# of them together make likeliest is the eigenvector of a symmetric 4 × 4 matrix (Davenport's q-method:
# Markley & Mortari, J. Astronaut. Sci. 48, 2000; a prior rotation adds its own outer product).
#
# Unlike a filter that begins anew and corrects heading and inclination one after the other, no sample is ever
# judged by what the inclination seemed to be when it came.


SETTLED_S = 3.0
"""So long is what VQF averages the specific force over."""
FIRST_ERROR = 0.75
"""Error of one specific force as a plumb line over the acceleration's root mean square, over gravity."""
PLAIN_S, TAPERED_S = 0.35, 0.6
"""The plain mean's error falls with 1 / (1 + t/PLAIN_S), the tapered one's with 1 / (1 + (t/TAPERED_S)²)."""
TAPER_FROM_S, TAPER_AT_S = 1.0, 1.5
"""From the one mean to the other: by then the taper spans the slowest swings of a walk."""
LEAST_SWING = 0.3
"""m/s²."""
LEAST_TILT = 0.02
"""rad."""
FIELD_ERROR = 0.08
"""rad, of the magnetic field's direction from place to place within a room."""
OTHER_FIELD = 0.1
"""Share by which the field's norm differs where it is another field (as in VQF)."""
_SQUARINGS = 20


class BeforeSilence(NamedTuple):
    """What is known of a module when it comes back."""

    q_wi: FloatArray  # (4,) as expected
    sigma: float
    """rad about an axis, of that."""
    swing: float
    """m/s²: root mean square of what the specific force's norm was off gravity."""
    field_norm: float
    """µT; 0: not known."""
    dip: float
    """rad, inclination of the field."""
    gravity: float
    """m/s²."""


class Since(NamedTuple):
    """Sums over the samples since, frame i; changed in place."""

    force: FloatArray  # (3, 3) Σ f, Σ t f, Σ t² f
    field: FloatArray  # (3,) Σ m
    squares: FloatArray  # (2,) Σ |f|², Σ |m|
    seconds: FloatArray  # (2,) of specific forces, of fields


def nothing_since() -> Since:
    """Return the sums at the return of a module, before any sample."""
    return Since(np.zeros((3, 3)), np.zeros(3), np.zeros(2), np.zeros(2))


@compiled
def settle(
    before: BeforeSilence, since: Since, q_is: FloatArray, f: FloatArray, x: FloatArray, dt: float
) -> tuple[FloatArray, float]:
    """Add one sample; return q_wi (4,) and its standard deviation about the axis known worst, rad.

    q_is: (4,) by the gyroscopes. f, x: (3,) specific force and field, NaN where there is none. dt: s between
    samples.
    """
    if is_finite(f):
        t = since.seconds[0] + 0.5 * dt
        f_i = quaternion.rotate(q_is, f)
        since.force[0] += f_i
        since.force[1] += t * f_i
        since.force[2] += t * t * f_i
        since.squares[0] += dot(f, f)
        since.seconds[0] += dt
    if is_finite(x):
        since.field[:] += quaternion.rotate(q_is, x)
        since.squares[1] += norm(x)
        since.seconds[1] += dt
    return _likeliest(before, since, dt)


@compiled
def _likeliest(before: BeforeSilence, since: Since, dt: float) -> tuple[FloatArray, float]:
    matrix = np.zeros((4, 4))
    weight = 1.0 / before.sigma**2
    for i in range(4):
        for j in range(4):
            matrix[i, j] = 2.0 * weight * before.q_wi[i] * before.q_wi[j]
    total, up = 2.0 * weight, vector(0.0, 0.0, 0.0)
    tilt_weight, field_weight = 0.0, 0.0
    if since.seconds[0] > 0.0:
        up, sigma = _up(before, since, dt)
        tilt_weight = 1.0 / sigma**2
        _add_pair(matrix, tilt_weight, up, vector(0.0, 0.0, 1.0))
    strength = since.squares[1] * dt / since.seconds[1] if since.seconds[1] > 0.0 else 0.0
    knows_dip = abs(strength - before.field_norm) < OTHER_FIELD * before.field_norm
    if norm(since.field) > 0.0 and (knows_dip or tilt_weight > 0.0):
        field = since.field / norm(since.field)
        sine = -dot(up, field)
        # a field whose dip is not known shows the heading only
        dip = before.dip if knows_dip else math.asin(max(-1.0, min(1.0, sine)))
        field_weight = 1.0 / FIELD_ERROR**2
        _add_pair(matrix, field_weight, field, vector(0.0, math.cos(dip), -math.sin(dip)))
        apart = max(0.0, 1.0 - sine**2)
        weight += apart * min(tilt_weight, field_weight)
    total += tilt_weight + field_weight
    return _dominant(matrix, total), 1.0 / math.sqrt(weight)


@compiled
def _up(before: BeforeSilence, since: Since, dt: float) -> tuple[FloatArray, float]:
    """Return the mean specific force in frame i, unit (3,), and how far it is from the vertical, rad.

    Velocities are bounded, so a plain mean errs by (v₁ − v₀) / t; one that fades in and out (6 s (1 − s), s
    from 0 to 1) leaves less of what swings, once it spans a swing.
    """
    t = since.seconds[0]
    n = t / dt
    mean = since.force[0] / n
    scatter = max(0.0, since.squares[0] / n - dot(mean, mean))
    acceleration = math.sqrt(max(scatter, 3.0 * max(before.swing, LEAST_SWING) ** 2))
    error = 1.0 / (1.0 + t / PLAIN_S)
    share = min(1.0, max(0.0, (t - TAPER_FROM_S) / (TAPER_AT_S - TAPER_FROM_S)))
    if share > 0.0:
        tapered = 6.0 * (since.force[1] / t - since.force[2] / t**2) / n
        mean = (1.0 - share) * mean + share * tapered
        error = (1.0 - share) * error + share / (1.0 + (t / TAPERED_S) ** 2)
    sigma = math.sqrt((FIRST_ERROR * acceleration / before.gravity * error) ** 2 + LEAST_TILT**2)
    length = norm(mean)
    return mean / length if length > 0.0 else mean, sigma


@compiled
def _add_pair(matrix: FloatArray, weight: float, b: FloatArray, r: FloatArray) -> None:
    """Add a pair of unit vectors, (3,), to K: qᵀ K q is the weighted cosine between r and b turned by q."""
    trace = weight * dot(b, r)
    matrix[0, 0] += trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        across = weight * (b[j] * r[k] - b[k] * r[j])
        matrix[0, 1 + i] += across
        matrix[1 + i, 0] += across
        matrix[1 + i, 1 + i] += 2.0 * weight * b[i] * r[i] - trace
        both = weight * (b[i] * r[j] + b[j] * r[i])
        matrix[1 + i, 1 + j] += both
        matrix[1 + j, 1 + i] += both


@compiled
def _dominant(matrix: FloatArray, bound: float) -> FloatArray:
    """Return the unit eigenvector of the largest eigenvalue of a symmetric (4, 4) matrix.

    No eigenvalue may be below −bound. The matrix, made positive, is squared again and again: its largest
    eigenvalue outgrows the others.
    """
    power = matrix + bound * np.eye(4)
    squared = np.empty((4, 4))
    for _ in range(_SQUARINGS):
        scale = power[0, 0] + power[1, 1] + power[2, 2] + power[3, 3]
        for i in range(4):
            for j in range(4):
                entry = 0.0
                for k in range(4):
                    entry += power[i, k] * power[k, j]
                squared[i, j] = entry / scale**2
        power[:] = squared
    best = 0
    for i in range(1, 4):
        if power[i, i] > power[best, best]:
            best = i
    return quaternion.normalise(power[best].copy())
