"""Every module for itself: the baseline, and the fallback for a module outside a chain.

The filter is VQF (Laidig & Seel, Information Fusion 91, 2023) with its default parameters: 9-axis once a
module has given a magnetic field, 6-axis (heading arbitrary) until then. Its world is level with y towards
magnetic north; the declination of the suit's field turns it to the geographic ENU. What it does after gaps is
ours: ``module_filter``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import WornSuit
from gateway.frames import Clipped, FloatArray, ImuFrame, IntArray, SkeletonFrame, Status, StatusArray
from gateway.geometry import derivatives, quaternion
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import norm
from gateway.reconstruction.inertial.module_filter import (
    ModuleFilter,
    Sample,
    clear,
    no_motion_statistics,
    note,
)
from gateway.reconstruction.inertial.observations import SegmentObserver, clipped_of, with_sun_as_field
from gateway.reconstruction.inertial.tree.tuning import tuning

HELD, MISSING, PREDICTED, UNAIDED = (
    Status.HELD.value,
    Status.MISSING.value,
    Status.PREDICTED.value,
    Status.UNAIDED.value,
)


RANGES = tuning()
"""Limits of sensors that do not report saturation themselves, the same as for ``joint``."""


class IndependentReconstructor:
    """One VQF a module.

    A module without values for an instant keeps its last orientation: HELD, and PREDICTED after a longer
    gap (``module_filter.LONGEST_GAP_S``). One whose last values are repeated turns on by them for a tenth of
    a second. Once it is back, that is taken back, and the gap bridged or settled (``ModuleFilter``).
    Likewise after its gyroscopes have been saturated for that long; for less, what they missed is made up
    for (``module_filter.Clip``). While its accelerometer is saturated, a segment turns by its gyroscopes
    alone (UNAIDED).
    A segment without module follows its parent rigidly, axes parallel as in the calibration pose
    (PREDICTED). MISSING: nothing yet, or a module without accelerometer or gyroscopes.

    angular_rate: as measured, bias included. joint_acceleration: the module's specific force moved to the
    proximal joint with ``ω̇`` from one backward difference and freed of gravity, from the second frame on
    where ``U ≠ 0``; NaN where the orientation is not MEASURED or INTERPOLATED. p_w: from the joints,
    the root at the origin. sigma: NaN.
    """

    def __init__(self, suit: WornSuit, nominal_interval_s: float) -> None:
        skeleton = suit.skeleton
        self._suit = suit
        gravity = np.array(suit.gravity, np.float64)
        self._worn = _WornSegments(
            parents=skeleton.parents.astype(np.int64),
            q_sb=_inverse_alignment(suit),
            lever_arms=np.array(suit.lever_arms, np.float64),
            gravity=gravity,
        )
        self._offsets = np.array(skeleton.offsets, np.float64)
        self._observer = SegmentObserver(suit)
        self._observed = [int(s) for s in np.flatnonzero(suit.module_of_segment >= 0)]
        self._rows = [int(suit.module_of_segment[s]) for s in self._observed]
        g = float(np.linalg.norm(gravity))
        self._motion = no_motion_statistics(skeleton.n_segments)
        self._filters = [ModuleFilter(nominal_interval_s, g, self._motion, s) for s in self._observed]
        self._interval_s, self._g = float(nominal_interval_s), g
        self._places = np.array(self._observed, np.int64), np.array(self._rows, np.int64)
        self._q_world = _facing(np.asarray(suit.magnetic_field))
        n = len(suit.module_ids)
        self.reset()
        ones = np.ones((n, 3))
        at_rest = ImuFrame(0, 0, ones, ones, ones, np.zeros(n, np.uint8), np.zeros(n, np.int64))
        self.update(at_rest)  # so that the kernels are compiled before the first real frame comes
        self.reset()

    def reset(self) -> None:
        """Forget everything but the parameters."""
        n = self._suit.skeleton.n_segments
        for module in self._filters:
            module.reset()
        clear(self._motion)
        self._q_vqf = np.full((n, 4), np.nan)  # sensor to the filter's world
        self._has_field = np.zeros(n, np.bool_)
        self._rate = np.full((n, 3), np.nan)
        self._time_ns = 0

    def update(self, observation: ImuFrame, stood_s: FloatArray | None = None) -> SkeletonFrame:
        """Return the pose of one instant."""
        sun = observation.sun
        if sun is not None:
            observation = with_sun_as_field(observation, sun)
            self._q_world = _facing(sun.world)
        status = self._step_filters(observation)
        observed = self._observer.observe(observation)

        dt = (observation.time_ns - self._time_ns) * 1e-9
        rate = observed.angular_rate
        rate_derivative = (rate - self._rate) / dt if dt > 0.0 else np.full_like(self._rate, np.nan)
        sensed = _Sensed(status, observed.specific_force, rate, rate_derivative)
        q_wb, acceleration, status = _body_pose(
            self._worn, sensed, self._q_vqf, self._has_field, self._q_world
        )

        self._rate, self._time_ns = rate, observation.time_ns
        for segment, module in zip(self._observed, self._filters, strict=True):
            if status[segment] == HELD and module.is_silent(observation.time_ns):
                status[segment] = PREDICTED

        return SkeletonFrame(
            sequence=observation.sequence,
            time_ns=observation.time_ns,
            q_wb=q_wb,
            angular_rate=rate,
            joint_acceleration=acceleration,
            p_w=joint_positions(self._worn.parents, self._offsets, q_wb, np.zeros(3)),
            sigma=np.full(len(status), np.nan),
            status=status,
            root=int(np.flatnonzero(self._worn.parents < 0)[0]),
        )

    def _step_filters(self, observation: ImuFrame) -> StatusArray:
        """Feed every module's filter; return the status by segment, PREDICTED where there is no module."""
        status = np.full(len(self._worn.parents), PREDICTED, np.uint8)
        f, w, x = (np.array(v, np.float64, order="C") for v in _rows_of(observation))
        is_inertial, has_field = _has_values(f, w), _has_values(x)
        is_inertial &= observation.status <= Status.HELD
        clipped = clipped_of(observation)
        is_unaided = _beyond(f, RANGES.largest_force) | ((clipped & Clipped.SPECIFIC_FORCE) > 0)
        is_blind = _beyond(w, RANGES.largest_rate) | ((clipped & Clipped.ANGULAR_RATE) > 0)

        is_sound = [False] * len(status)
        flags = (v.tolist() for v in (is_inertial, is_blind, is_unaided, has_field, observation.status))
        modules = zip(self._observed, self._rows, self._filters, strict=True)
        flags_of = list(zip(*flags, strict=True))
        for segment, row, module in modules:
            inertial, blind, unaided, field, came_as = flags_of[row]
            if not inertial or (blind and module.is_silent(observation.time_ns)):
                status[segment] = HELD if module.is_known else MISSING
                continue
            sample = Sample(None if unaided else f[row], w[row], x[row] if field else None)
            if blind or came_as == HELD:
                module.take_doubtful(sample, observation.time_ns, blind)
            else:
                module.take(sample, observation.time_ns)
                is_sound[segment] = True
            self._q_vqf[segment] = module.orientation
            self._has_field[segment] = module.has_field
            status[segment] = UNAIDED if unaided else came_as

        places, sound = self._places, np.array(is_sound)
        note(self._motion, *places, sound, self._q_vqf, f, w, x, self._g, self._interval_s)
        return status


def _beyond(values: FloatArray, largest: float) -> NDArray[np.bool_]:
    """Return, (n_modules,), whether a sensor is at the end of its range on any axis."""
    is_beyond: NDArray[np.bool_] = np.logical_or.reduce(np.abs(values) > largest, axis=1)
    return is_beyond


def _rows_of(observation: ImuFrame) -> tuple[FloatArray, FloatArray, FloatArray]:
    return observation.specific_force, observation.angular_rate, observation.magnetic_field


def _has_values(*sensors: FloatArray) -> NDArray[np.bool_]:
    """Return, (n_modules,), whether all the sensors gave finite values."""
    has: NDArray[np.bool_] = np.logical_and.reduce(np.isfinite(np.hstack(sensors)), axis=1)
    return has


def _facing(field: FloatArray) -> FloatArray:
    """Return the rotation (4,) from the filter's world, whose y points where the field (3,) does, to ENU."""
    declination = math.atan2(field[0], field[1])
    return quaternion.from_rotation_vector(np.array([0.0, 0.0, -declination]))


def _inverse_alignment(suit: WornSuit) -> FloatArray:
    """Return q_sb, segment to sensor, (n_segments, 4)."""
    return np.stack([quaternion.conjugate(quaternion.normalise(q)) for q in suit.sensor_to_segment])


class _WornSegments(NamedTuple):
    """The body, and how n segments wear their modules; constant."""

    parents: IntArray  # (n,)
    q_sb: FloatArray  # (n, 4) segment to sensor
    lever_arms: FloatArray  # (n, 3) m, from the proximal joint, segment axes
    gravity: FloatArray  # (3,) m/s², world


class _Sensed(NamedTuple):
    """One instant, by segment and in its axes."""

    status: StatusArray  # (n,)
    specific_force: FloatArray  # (n, 3) m/s²
    rate: FloatArray  # (n, 3) rad/s
    rate_derivative: FloatArray  # (n, 3) rad/s²


@compiled
def _body_pose(
    worn: _WornSegments,
    sensed: _Sensed,
    q_vqf: FloatArray,
    has_field: NDArray[np.bool_],
    q_world: FloatArray,
) -> tuple[FloatArray, FloatArray, StatusArray]:
    """Return orientations (n, 4) and joint accelerations (n, 3), m/s², in the world, and the status (n,).

    q_vqf: (n, 4) sensor to the filter's world; has_field: (n,) whether that has a north; q_world: (4,) that
    world to ENU.
    """
    parents, lever_arms, f, rate = worn.parents, worn.lever_arms, sensed.specific_force, sensed.rate
    n = len(parents)
    q_wb, acceleration, status = np.full((n, 4), np.nan), np.full((n, 3), np.nan), sensed.status.copy()
    for s in range(n):
        if status[s] == PREDICTED:
            if parents[s] < 0 or status[parents[s]] == MISSING:
                status[s] = MISSING
            else:
                q_wb[s] = q_wb[parents[s]]
            continue
        if status[s] == MISSING:
            continue
        q = quaternion.multiply(q_vqf[s], worn.q_sb[s])
        if has_field[s]:
            q = quaternion.multiply(q_world, q)
        q_wb[s] = quaternion.canonical(quaternion.normalise(q))
        if status[s] < HELD:
            at_joint = f[s]
            if norm(lever_arms[s]) > 0.0:
                turning = sensed.rate_derivative[s]
                at_joint = f[s] - derivatives.point_acceleration(turning, rate[s], lever_arms[s])
            acceleration[s] = quaternion.rotate(q_wb[s], at_joint) + worn.gravity
    return q_wb, acceleration, status
