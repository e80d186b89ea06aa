"""``gyro_free``: a body whose modules have accelerometers and a field sensor only, and its local devices.

Segments are solved outward from the root, each by ``rate_free_filter``. The root's filter is held by its
local devices, every other by the joint it shares with the one before, whose place is handed on with its
uncertainty. Whatever has no such hold (no device, or one that fell silent) is held loosely to where it is:
its acceleration is then taken to be small on the whole, as plain inclinometers do.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import LocalDevice, WornSuit
from gateway.frames import FloatArray, ImuFrame, LocalReading, Quantity, SkeletonFrame, Status, StatusArray
from gateway.geometry import quaternion, rotation_matrix
from gateway.reconstruction.inertial import field_lag
from gateway.reconstruction.inertial import rate_free_filter as one
from gateway.reconstruction.inertial import rate_free_points as points
from gateway.reconstruction.inertial.held_arguments import hold
from gateway.reconstruction.inertial.observations import SegmentObservations, SegmentObserver
from gateway.reconstruction.inertial.rate_free_filter import MotionNoise, Rows, SegmentState
from gateway.reconstruction.inertial.rate_free_smoother import empty_log, note, smoothed
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

    noise: MotionNoise = field(default_factory=MotionNoise)
    longest_hold_s: float = 0.3
    """A local device silent for longer no longer holds its segment."""
    longest_gap_s: float = 0.5
    """After a longer gap a segment begins anew."""


class RateFreeReconstructor:
    """Causal, or with a constant delay. Gyrometer readings are not looked at.

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
        """delay_s: frames are given that much later, corrected by all that was seen meanwhile (0: causal)."""
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
        self._noise = hold(self._settings.noise)
        self._states = [one.empty_state() for _ in range(n)]
        self._held = [hold(state) for state in self._states]
        self._rows = [hold(one.empty_rows()) for _ in range(n)]
        self._logs = [empty_log(self._length) for _ in range(n)] if self._length > 1 else []
        self._held_logs = [hold(log) for log in self._logs]
        self._lag = field_lag.lag_finder(self._interval_s)
        self._last_ns = np.full(n, np.iinfo(np.int64).min // 2)
        self._held_ns = np.full(n, np.iinfo(np.int64).min // 2)
        self._waiting: deque[SkeletonFrame] = deque()

    def update(self, observation: ImuFrame, resting: FloatArray | None = None) -> SkeletonFrame:
        """One instant. Raises nothing: what is not defined is NaN and says so in ``status``.

        resting: not looked at; whether a module turns at rest is told here by force and field together.
        """
        observed = self._observer.observe(observation)
        status = np.full(self._n, Status.MISSING, np.uint8)
        for s in self._travel.order:
            status[s] = self._advance(int(s), observed, observation)
        frame = self._frame(observation, status)
        return frame if self._length == 1 else self._delayed(frame)

    def _advance(self, s: int, observed: SegmentObservations, frame: ImuFrame) -> int:
        """One segment; its status."""
        f, m = observed.specific_force[s], observed.magnetic_field[s]
        since_s = (frame.time_ns - self._last_ns[s]) * 1e-9
        if observed.status[s] > Status.INTERPOLATED:
            return Status.MISSING if since_s > self._settings.longest_gap_s else Status.PREDICTED
        if since_s > self._settings.longest_gap_s:
            return self._begin(s, f, m, frame.time_ns, int(observed.status[s]))
        if since_s <= 0.0:
            return int(observed.status[s])
        state, rows, noise = self._held[s], self._rows[s], self._noise
        if s == self._root:
            field_lag.see_module(self._lag, frame.time_ns * 1e-9, f, m)
        F = one.predict(state, noise, f, self._suit.gravity, since_s)
        one.watch(state, noise, f, m, since_s)
        x = np.zeros(one.N)
        is_at_rest = one.add_rest(state, rows, noise, x, since_s)
        is_disturbed = self._states[s].off_norm[0] > self._settings.noise.norm_tolerance
        if np.isfinite(m).all() and not (is_at_rest and is_disturbed):
            one.add_field(state, rows, noise, x, m, self._north, field_lag.lag_s(self._lag))
        self._hold(s, state, rows, x, frame, since_s)
        one.correct(state, x)
        self._last_ns[s] = frame.time_ns
        if self._logs:
            note(self._held_logs[s], state, F, rows)
        return int(observed.status[s])

    def _begin(self, s: int, f: FloatArray, m: FloatArray, time_ns: int, status: int) -> int:
        h = self._suit.magnetic_field
        R = rotation_matrix.from_two_vectors(f, m, -self._suit.gravity, h)
        if not np.isfinite(R).all():
            return Status.MISSING
        one.begin(self._held[s], self._noise, R, f, m, h)
        self._last_ns[s] = time_ns
        if self._logs:
            self._logs[s].head[1] = 0
        return status

    def _hold(
        self, s: int, state: SegmentState, rows: Rows, x: FloatArray, frame: ImuFrame, dt: float
    ) -> None:
        """What is known of the place and motion of the segment's points."""
        before = int(self._travel.entered_from[s])
        huber = self._settings.noise.huber
        if before >= 0 and self._last_ns[before] == frame.time_ns:
            out = self._travel.link[s] - self._U[before]
            place, covariance = points.point(self._held[before], out)
            sigma = np.sqrt(JOINT_INFLATION * np.diag(covariance) + JOINT_SIGMA_M**2)
            self._catch(s, place, -self._U[s], frame.time_ns)
            one.add_position(state, rows, x, place, -self._U[s], sigma, 0.0, huber)
        for device in self._suit.local_devices:
            if device.segment == s:
                self._take_device(s, device, state, rows, x, frame)
        if (frame.time_ns - self._held_ns[s]) * 1e-9 > self._settings.longest_hold_s:
            scale = np.sqrt(max(1.0, LEASH_S / dt))
            none, stay = np.zeros(3), np.full(3, LEASH_M * scale)
            one.add_position(state, rows, x, none, none, stay, 0.0, huber)
            one.add_velocity(state, rows, x, none, none, np.full(3, LEASH_M_S * scale), huber)

    def _take_device(
        self, s: int, device: LocalDevice, state: SegmentState, rows: Rows, x: FloatArray, frame: ImuFrame
    ) -> None:
        arm, huber = device.position - self._suit.lever_arms[s], self._settings.noise.huber
        if device.quantity is Quantity.FIXED_POINT:
            self._catch(s, np.zeros(3), arm, frame.time_ns)
            one.add_position(state, rows, x, np.zeros(3), arm, np.full(3, FIXED_POINT_SIGMA_M), 0.0, huber)
            return
        for reading in frame.local:
            if reading.device == device.device and reading.quantity == device.quantity:
                self._take_reading(s, reading, arm, state, rows, x, frame.time_ns)

    def _take_reading(
        self,
        s: int,
        reading: LocalReading,
        arm: FloatArray,
        state: SegmentState,
        rows: Rows,
        x: FloatArray,
        time_ns: int,
    ) -> None:
        value = np.array(reading.value, np.float64)
        if not np.isfinite(value).all():
            return
        sigma = np.fmax(np.array(reading.sigma, np.float64), LEAST_SIGMA)
        huber = self._settings.noise.huber
        if reading.quantity is Quantity.POSITION:
            age_s = min(max((time_ns - reading.time_ns) * 1e-9, 0.0), self._settings.longest_hold_s)
            self._catch(s, value, arm, time_ns)
            if s == self._root:
                self._learn_lag(s, reading, value, arm, float(sigma.mean()))
            one.add_position(state, rows, x, value, arm, sigma, age_s, huber)
        elif reading.quantity is Quantity.VELOCITY:
            one.add_velocity(state, rows, x, value, arm, sigma, huber)
        else:
            one.add_acceleration(state, rows, x, value, arm, sigma, self._suit.gravity, huber)
            # an acceleration holds the orientation; place and speed have nothing to hold them
            self._states[s].values[one.VELOCITY : one.ARM] = 0.0
        self._held_ns[s] = time_ns

    def _learn_lag(
        self, s: int, reading: LocalReading, value: FloatArray, arm: FloatArray, sigma: float
    ) -> None:
        """Where the module of s was tells by how much its magnetometer is late; all are taken to be alike."""
        state = self._states[s]
        strength, up = state.values[one.STRENGTH : one.DISTURBANCE]
        field_lag.see_place(
            self._lag,
            reading.time_ns * 1e-9,
            value - rotation_matrix.rotate(state.R, arm),
            state.values[one.VELOCITY : one.PLACE],
            sigma,
            -self._suit.gravity,
            self._north * strength + np.array([0.0, 0.0, up]),
        )

    def _catch(self, s: int, place: FloatArray, arm: FloatArray, time_ns: int) -> None:
        """A segment that had no hold is put where it now is known to be."""
        state = self._states[s]
        if (time_ns - self._held_ns[s]) * 1e-9 > self._settings.longest_hold_s:
            block = slice(one.VELOCITY, one.ARM)
            state.values[one.PLACE : one.ARM] = place - rotation_matrix.rotate(state.R, arm)
            state.P[block, :] = 0.0
            state.P[:, block] = 0.0
            state.P[block, block] = np.diag([4.0] * 3 + [0.01] * 3)
        self._held_ns[s] = time_ns

    def _frame(self, observation: ImuFrame, status: StatusArray) -> SkeletonFrame:
        n = self._n
        q_wb, rate, acceleration = np.full((n, 4), np.nan), np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        sigma = np.full(n, np.nan)
        for s in np.flatnonzero(status <= Status.PREDICTED):
            q_wb[s] = quaternion.from_matrix(self._states[s].R)
            rate[s], acceleration[s], sigma[s] = points.at_joint(
                self._held[s], self._suit.lever_arms[s], self._suit.gravity
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
        """(3,) of the skeleton root's joint; the origin while it is not known."""
        root = int(np.flatnonzero(self._suit.skeleton.parents < 0)[0])
        if np.isnan(q_wb[root, 0]):
            return np.zeros(3)
        state = self._states[root]
        place: FloatArray = state.values[one.PLACE : one.ARM] - state.R @ self._suit.lever_arms[root]
        return place

    def _delayed(self, newest: SkeletonFrame) -> SkeletonFrame:
        """The frame of one delay ago, corrected; sequence counts on."""
        self._waiting.append(newest)
        if len(self._waiting) < self._length:
            blank = np.full_like(newest.q_wb, np.nan)
            early_ns = newest.time_ns - round((self._length - 1) * self._interval_s * 1e9)
            missing = np.full(self._n, Status.WARMING_UP, np.uint8)
            return replace(newest, time_ns=early_ns, q_wb=blank, status=missing)
        frame = self._waiting.popleft()
        q_wb, rate = frame.q_wb.copy(), frame.angular_rate.copy()
        for s, log in enumerate(self._logs):
            if log.head[1] == self._length and np.isfinite(q_wb[s, 0]):
                R, w = smoothed(self._held_logs[s])
                q_wb[s], rate[s] = quaternion.from_matrix(R), R.T @ w
        return replace(frame, sequence=newest.sequence, q_wb=q_wb, angular_rate=rate)

    def _compile(self, n_modules: int) -> None:
        """A few frames, so that every kernel is compiled before the first real one comes."""
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
            self.update(ImuFrame(k, time_ns, up, none, field_, zeros.astype(np.uint8), zeros, local))
