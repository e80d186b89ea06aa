"""``gyro_free``: a body whose modules have accelerometers and a field sensor only, and its local devices.

Segments are solved outward from the root, each by ``rate_free_filter``. The root's filter is held by its
local devices, every other by the joint it shares with the one before, whose place is handed on with its
uncertainty. Whatever has no such hold (no device, or one that fell silent) is held loosely to where it is:
its acceleration is then taken to be small on the whole, as plain inclinometers do.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import LocalDevice, WornSuit
from gateway.frames import FloatArray, ImuFrame, LocalReading, Quantity, SkeletonFrame, Status, StatusArray
from gateway.geometry import quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Record, Records, Vector, array_of, record, records
from gateway.geometry.vectors import dot, norm
from gateway.reconstruction.inertial import rate_free_filter as one
from gateway.reconstruction.inertial.observations import SegmentObservations, SegmentObserver
from gateway.reconstruction.inertial.rate_free_filter import Known, MotionNoise, motion_noise
from gateway.reconstruction.inertial.travel import travel_from

LEASH_M, LEASH_M_S = 0.3, 0.5
"""How far and how fast a segment without any hold may be, standard deviations …"""
LEASH_S = 0.1
"""… of an observation every so often."""
FIXED_POINT_SIGMA_M = 0.001
LEAST_SIGMA = 5e-4
"""m, m/s or m/s²: no local device is better than that."""
JOINT_SIGMA_M = 0.004
JOINT_INFLATION = 20.0
"""The place of a joint is wrong for many instants alike; it counts so much less."""


@dataclass(frozen=True, slots=True)
class RateFreeSettings:
    """Parameters; the defaults serve all bodies and motions."""

    noise: MotionNoise = field(default_factory=motion_noise)
    longest_hold_s: float = 0.3
    """A local device silent for longer no longer holds its segment."""
    longest_gap_s: float = 0.5
    """After a longer gap a segment begins anew."""


class RateFreeReconstructor:
    """Causal, or with a constant delay. Gyroscope readings are not looked at.

    A segment is defined from its module's first sample with specific force and field on. status: the
    module's; PREDICTED while the module is silent, then MISSING. sigma: of the causal estimate, rad.
    angular_rate is estimated; joint_acceleration holds from the first frame on. With a delay ``time_ns`` is
    that of the instant given, one delay before the newest, and the first frames are WARMING_UP.
    A segment without a module is MISSING, and what is beyond it has no hold.
    """

    def __init__(
        self,
        suit: WornSuit,
        nominal_interval_s: float,
        delay_s: float = 0.0,
        settings: RateFreeSettings | None = None,
    ) -> None:
        """Create the reconstructor of a suit.

        nominal_interval_s: between frames. delay_s: frames are returned that much later, corrected by all
        that was seen meanwhile (0: causal).
        """
        self._settings = settings or RateFreeSettings()
        self._interval_s = nominal_interval_s
        self._suit, self._n = suit, suit.skeleton.n_segments
        device = suit.local_devices[0] if suit.local_devices else None
        self._root = device.segment if device else int(np.flatnonzero(suit.skeleton.parents < 0)[0])
        self._travel = travel_from(suit.skeleton, self._root, device.position if device else np.zeros(3))
        self._U = self._travel.arms(suit.lever_arms)
        self._observer = SegmentObserver(suit)
        horizontal = np.array([*suit.magnetic_field[:2], 0.0])
        self._north = horizontal / max(float(np.linalg.norm(horizontal)), 1e-9)
        self._length = round(delay_s / nominal_interval_s) + 1
        self._compile(len(suit.module_ids))
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        n = self._n
        self._segments, self._shared = one.empty_segments(n), records(one.Shared, 1)
        shared = self._shared[0]
        shared.gravity[:], shared.magnetic_field[:] = self._suit.gravity, self._suit.magnetic_field
        shared.north[:], shared.noise = self._north, self._settings.noise
        n_logs = n if self._length > 1 else 0
        self._logs = [records(one.LoggedInstant, self._length) for _ in range(n_logs)]
        self._lag = lag_finder(self._interval_s, self._suit.gravity)
        self._last_ns = np.full(n, np.iinfo(np.int64).min // 2)
        self._held_ns = np.full(n, np.iinfo(np.int64).min // 2)
        self._waiting: deque[SkeletonFrame] = deque()

    def update(self, observation: ImuFrame, stood_s: FloatArray | None = None) -> SkeletonFrame:
        """Return the pose of one instant.

        Raises nothing: what is not defined is NaN, and ``status`` says why. stood_s: not used; rest is found
        here by force and field together.
        """
        observed = self._observer.observe(observation)
        status = np.full(self._n, Status.MISSING, np.uint8)
        for s in self._travel.order:
            status[s] = self._advance(int(s), observed, observation)
        frame = self._frame(observation, status)
        return frame if self._length == 1 else self._delayed(frame)

    def _advance(self, s: int, observed: SegmentObservations, frame: ImuFrame) -> int:
        """Advance the filter of one segment to the frame; return its status."""
        f, m = observed.specific_force[s], observed.magnetic_field[s]
        since_s = (frame.time_ns - self._last_ns[s]) * 1e-9
        if observed.status[s] > Status.INTERPOLATED:
            return Status.MISSING if since_s > self._settings.longest_gap_s else Status.PREDICTED
        if since_s > self._settings.longest_gap_s:
            return self._begin(s, f, m, frame.time_ns, int(observed.status[s]))
        if since_s <= 0.0:
            return int(observed.status[s])
        segments = self._segments
        if s == self._root:
            see_module(self._lag, frame.time_ns * 1e-9, f, m)
        one.see(segments, s, self._shared, f, m, since_s)
        self._hold(s, frame, since_s)
        one.correct(segments, s)
        self._last_ns[s] = frame.time_ns
        if self._logs:
            one.note(segments, s, self._logs[s])
        return int(observed.status[s])

    def _begin(self, s: int, f: FloatArray, m: FloatArray, time_ns: int, status: int) -> int:
        if not one.begin(self._segments, s, self._shared, f, m):
            return Status.MISSING
        self._last_ns[s] = time_ns
        return status

    def _hold(self, s: int, frame: ImuFrame, dt: float) -> None:
        """Add the rows of what is known of a segment's position and motion.

        They come from its joint and its devices; without either it is held loosely.
        """
        before = int(self._travel.entered_from[s])
        segments, shared = self._segments, self._shared
        if before >= 0 and self._last_ns[before] == frame.time_ns:
            out = self._travel.link[s] - self._U[before]
            place, covariance = one.point(segments, before, out)
            sigma = np.sqrt(JOINT_INFLATION * np.diag(covariance) + JOINT_SIGMA_M**2)
            self._catch(s, place, -self._U[s], frame.time_ns)
            one.add_position(segments, s, shared, Known(place, -self._U[s], sigma, 0.0))
        for device in self._suit.local_devices:
            if device.segment == s:
                self._take_device(s, device, frame)
        if (frame.time_ns - self._held_ns[s]) * 1e-9 > self._settings.longest_hold_s:
            scale = np.sqrt(max(1.0, LEASH_S / dt))
            none, stay = np.zeros(3), np.full(3, LEASH_M * scale)
            one.add_position(segments, s, shared, Known(none, none, stay, 0.0))
            one.add_velocity(segments, s, shared, Known(none, none, np.full(3, LEASH_M_S * scale), 0.0))

    def _take_device(self, s: int, device: LocalDevice, frame: ImuFrame) -> None:
        arm = device.position - self._suit.lever_arms[s]
        if device.quantity is Quantity.FIXED_POINT:
            self._catch(s, np.zeros(3), arm, frame.time_ns)
            sigma = np.full(3, FIXED_POINT_SIGMA_M)
            one.add_position(self._segments, s, self._shared, Known(np.zeros(3), arm, sigma, 0.0))
            return
        for reading in frame.local:
            if reading.device == device.device and reading.quantity == device.quantity:
                self._take_reading(s, reading, arm, frame.time_ns)

    def _take_reading(self, s: int, reading: LocalReading, arm: FloatArray, time_ns: int) -> None:
        segments, shared = self._segments, self._shared
        value = np.array(reading.value, np.float64)
        if not np.isfinite(value).all():
            return
        sigma = np.fmax(np.array(reading.sigma, np.float64), LEAST_SIGMA)
        if reading.quantity is Quantity.POSITION:
            age_s = min(max((time_ns - reading.time_ns) * 1e-9, 0.0), self._settings.longest_hold_s)
            self._catch(s, value, arm, time_ns)
            if s == self._root:
                self._learn_lag(reading.time_ns, Known(value, arm, sigma, 0.0))
            one.add_position(segments, s, shared, Known(value, arm, sigma, age_s))
        elif reading.quantity is Quantity.VELOCITY:
            one.add_velocity(segments, s, shared, Known(value, arm, sigma, 0.0))
        else:
            one.add_acceleration(segments, s, shared, Known(value, arm, sigma, 0.0))
        self._held_ns[s] = time_ns

    def _learn_lag(self, time_ns: int, known: Known) -> None:
        """Learn how late the root's magnetometer is from the position of its module.

        All magnetometers are taken to be alike.
        """
        state = self._segments[self._root]
        strength, up = state.values[one.STRENGTH : one.DISTURBANCE]
        see_place(
            self._lag,
            time_ns * 1e-9,
            known.value - rotation_matrix.rotate(state.R, known.arm),
            state.values[one.VELOCITY : one.PLACE].copy(),
            float(known.sigma.mean()),
            self._north * strength + np.array([0.0, 0.0, up]),
        )
        self._shared["late_s"] = lag_s(self._lag)

    def _catch(self, s: int, place: FloatArray, arm: FloatArray, time_ns: int) -> None:
        """Put a segment that had no hold where it is now known to be.

        place: (3,) m, of the point at ``arm`` (3,) from the module.
        """
        if (time_ns - self._held_ns[s]) * 1e-9 > self._settings.longest_hold_s:
            one.catch(self._segments, s, place, arm)
        self._held_ns[s] = time_ns

    def _frame(self, observation: ImuFrame, status: StatusArray) -> SkeletonFrame:
        n = self._n
        q_wb, rate, acceleration = np.full((n, 4), np.nan), np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        sigma = np.full(n, np.nan)
        for s in np.flatnonzero(status <= Status.PREDICTED).tolist():
            q_wb[s], rate[s], acceleration[s], sigma[s] = one.at_joint(
                self._segments, s, self._shared, self._suit.lever_arms[s]
            )
        parents, offsets = self._suit.skeleton.parents, self._suit.skeleton.offsets
        return SkeletonFrame(
            sequence=observation.sequence,
            time_ns=observation.time_ns,
            q_wb=q_wb,
            angular_rate=rate,
            joint_acceleration=acceleration,
            p_w=joint_positions(parents.astype(np.int64), offsets, q_wb, self._root_place(q_wb)),
            sigma=sigma,
            status=status,
            root=self._root,
        )

    def _root_place(self, q_wb: FloatArray) -> FloatArray:
        """Return the position (3,), m, of the skeleton root's joint; the origin while it is not known."""
        root = int(np.flatnonzero(self._suit.skeleton.parents < 0)[0])
        if np.isnan(q_wb[root, 0]):
            return np.zeros(3)
        state = self._segments[root]
        place: FloatArray = state.values[one.PLACE : one.ARM] - state.R @ self._suit.lever_arms[root]
        return place

    def _delayed(self, newest: SkeletonFrame) -> SkeletonFrame:
        """Return the frame of one delay ago, corrected by all that was seen since.

        Its sequence number is that of the newest.
        """
        self._waiting.append(newest)
        if len(self._waiting) < self._length:
            blank = np.full_like(newest.q_wb, np.nan)
            early_ns = newest.time_ns - round((self._length - 1) * self._interval_s * 1e9)
            missing = np.full(self._n, Status.WARMING_UP, np.uint8)
            return replace(newest, time_ns=early_ns, q_wb=blank, status=missing)
        frame = self._waiting.popleft()
        q_wb, rate = frame.q_wb.copy(), frame.angular_rate.copy()
        for s, log in enumerate(self._logs):
            if self._segments[s].log_kept == self._length and np.isfinite(q_wb[s, 0]):
                R, w = one.smoothed(self._segments, s, log)
                q_wb[s], rate[s] = quaternion.from_matrix(R), R.T @ w
        return replace(frame, sequence=newest.sequence, q_wb=q_wb, angular_rate=rate)

    def _compile(self, n_modules: int) -> None:
        """Feed a few frames, so that every kernel is compiled before the first real one comes."""
        self.reset()
        up, field_, none = np.zeros((n_modules, 3)), np.zeros((n_modules, 3)), np.zeros((n_modules, 3))
        up[:, 2], field_[:, 1] = 9.8, 50.0
        zeros = np.zeros(n_modules, np.int64)
        local = tuple(
            LocalReading(d.device, 0, d.quantity, np.zeros(3), np.ones(3))
            for d in self._suit.local_devices
            if d.device is not None
        )
        for k in range(self._length + 2):
            time_ns = round((k + 1) * self._interval_s * 1e9)
            self.update(
                ImuFrame(
                    sequence=k,
                    time_ns=time_ns,
                    specific_force=up,
                    angular_rate=none,
                    magnetic_field=field_,
                    status=zeros.astype(np.uint8),
                    gap_ns=zeros,
                    local=local,
                )
            )


# By how much a module's magnetometer is later than its accelerometer, found without any orientation
#
# The product of specific force and field is the same in all axes: ``f · m = (a − g) · h``, with the module's
# acceleration ``a`` from its measured places and ``h`` the known field. A field that is δ late is
# ``m(t − δ) = m − δ ṁ``, so that ``f · m − (a − g) · h = −δ f · ṁ``: a line through the origin, whose slope
# is δ. Smooth values and derivatives come from a quadratic through the last instants, all of the same middle:
# the window delays nothing against anything. An orientation would not do: a causal one is late itself.


WINDOW_S, FEWEST = 0.06, 5
"""s that a quadratic spans, and the fewest instants of it."""
PRIOR_S, LONGEST_S = 0.02, 0.05
"""What a lag is expected to be (standard deviation about 0), and the most that is believed."""
MEMORY_S = 120.0
LATEST = 4
"""Instants by which a place may come later than what the module measured then."""
FIELD_NOISE, FIELD_RANGE = 0.5, 2.0
"""µT: of a sample; by how much the field of a room varies."""
TURNING = 3.0
"""Standard deviations by which ``f · ṁ`` must stand out of its noise: noise in it would pull δ to 0."""


class Weights(Record):
    """Of an instant of the window in a quadratic's fit."""

    value: float  # at the middle
    slope: float
    curvature: float


class Seen(Record):
    """An instant of a module."""

    time_s: float
    force: Vector  # segment axes, m/s²
    magnetic: Vector  # segment axes, µT
    place: Vector  # world, m; NaN until it is known


class LagSums(Record):
    """The sums of the straight line."""

    interval_s: float  # of frames; constant
    at_rest: Vector  # −g; constant
    xx: float  # of the straight line, weighted
    xy: float


class LagFinder(NamedTuple):
    """The state; changed in place."""

    fit: Records[Weights]  # of the window's instants; constant
    instants: Records[Seen]  # those kept, the newest last
    sums: Records[LagSums]  # one


def lag_finder(interval_s: float, gravity: FloatArray) -> LagFinder:
    """Return the state and tables of a lag finder for frames ``interval_s`` apart. gravity: (3,) m/s²."""
    half = max(FEWEST // 2, round(0.5 * WINDOW_S / interval_s))
    steps = np.arange(-half, half + 1, dtype=np.float64)
    fitted = np.linalg.pinv(np.stack([steps**0, steps, 0.5 * steps**2], axis=1))
    fit, instants, sums = records(Weights, len(steps)), records(Seen, len(steps) + LATEST), record(LagSums)
    for name, weights in zip(("value", "slope", "curvature"), fitted, strict=True):
        fit[name] = weights
    for name in ("force", "magnetic", "place"):
        instants[name] = np.nan
    sums.interval_s, sums.at_rest[:] = interval_s, -gravity
    return LagFinder(fit, instants, array_of(sums))


@compiled
def see_module(finder: LagFinder, time_s: float, f: FloatArray, m: FloatArray) -> None:
    """Keep specific force (m/s²) and field (µT) of an instant, (3,) in segment axes."""
    instants, n = finder.instants, len(finder.instants)
    for k in range(n - 1):
        instants[k] = instants[k + 1]
    newest = instants[n - 1]
    newest.time_s = time_s
    for i in range(3):
        newest.force[i], newest.magnetic[i], newest.place[i] = f[i], m[i], np.nan


@compiled
def see_place(
    finder: LagFinder, time_s: float, place: FloatArray, velocity: FloatArray, sigma: float, h: FloatArray
) -> None:
    """Take the position of the module at ``time_s``, not later than its newest instant, and update the sums.

    place, velocity (3,) of the module, world; sigma: noise of the position, m; h (3,) µT. Without an instant
    kept within half an interval of that time nothing changes.
    """
    n, length = len(finder.fit), len(finder.instants)
    for k in range(length - 1, n - 2, -1):
        seen = finder.instants[k]
        off_s = seen.time_s - time_s
        if abs(off_s) <= 0.5 * finder.sums[0].interval_s:
            for i in range(3):
                seen.place[i] = place[i] + velocity[i] * off_s
            _take_window(finder, k - n + 1, sigma, h)
            return


@compiled
def _take_window(finder: LagFinder, first: int, place_sigma: float, h: FloatArray) -> None:
    """Add a window of instants from ``first`` on to the line's sums.

    Nothing is added unless it is complete and without a gap.
    """
    fit, sums, n, instants = finder.fit, finder.sums[0], len(finder.fit), finder.instants
    dt = (instants[first + n - 1].time_s - instants[first].time_s) / (n - 1)
    f, m, m_slope, u = np.zeros(3), np.zeros(3), np.zeros(3), sums.at_rest.copy()
    slope_gain = curvature_gain = 0.0
    for k in range(n):
        seen, weights = instants[first + k], fit[k]
        slope_gain += weights.slope**2
        curvature_gain += weights.curvature**2
        for i in range(3):
            f[i] += weights.value * seen.force[i]
            m[i] += weights.value * seen.magnetic[i]
            m_slope[i] += weights.slope * seen.magnetic[i] / dt
            u[i] += weights.curvature * seen.place[i] / (dt * dt)

    # the line f · m − (a − g) · h = −δ f · ṁ
    x, y = -dot(f, m_slope), dot(f, m) - dot(u, h)
    if not math.isfinite(x + y) or abs(dt - sums.interval_s) > 0.2 * sums.interval_s:
        return

    is_turning = abs(x) > TURNING * norm(f) * FIELD_NOISE * math.sqrt(slope_gain) / dt
    is_disturbed = abs(norm(m) - norm(h)) > FIELD_RANGE
    keep = math.exp(-dt / MEMORY_S)
    sums.xx *= keep
    sums.xy *= keep
    if is_turning and not is_disturbed:
        sigma = FIELD_RANGE * norm(f) + norm(h) * place_sigma * math.sqrt(curvature_gain) / (dt * dt)
        y = min(max(y, -LONGEST_S * abs(x) - sigma), LONGEST_S * abs(x) + sigma)
        weight = 1.0 / (sigma * sigma * n)  # windows overlap
        sums.xx += weight * x * x
        sums.xy += weight * x * y


@compiled
def lag_s(finder: LagFinder) -> float:
    """Return the lag found so far, s, between 0 and ``LONGEST_S``."""
    found: float = finder.sums[0].xy / (finder.sums[0].xx + 1.0 / PRIOR_S**2)
    return min(max(found, 0.0), LONGEST_S)
