"""Frames of a suit through a chain filter in one call: modules to segments, step, outputs. Compiled.

A live frame and a whole recording go through the same function, so they agree bit for bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.body.kinematics import joint_positions
from gateway.body.skeleton import LocalDevice, WornSuit
from gateway.frames import FloatArray, IntArray, Quantity, Status, StatusArray
from gateway.geometry import quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite
from gateway.reconstruction.inertial.chain_prediction import exceeds
from gateway.reconstruction.inertial.chain_state import ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.chain_step import mark_unaided, orientation_sigma, step
from gateway.reconstruction.inertial.local_rows import take_reading
from gateway.reconstruction.inertial.observations import by_segment, sensor_to_segment_matrices
from gateway.reconstruction.inertial.sun_rows import sun_by_segment

SHORTEST_STEP_S = 1e-5
MISSING, PREDICTED, UNAIDED = Status.MISSING.value, Status.PREDICTED.value, Status.UNAIDED.value
AIR_VELOCITY = Quantity.AIR_VELOCITY.value


class Wearing(NamedTuple):
    """How the suit is worn, as far as the filter itself need not know; constant."""

    module_of_segment: IntArray  # (n_segments,) −1: none
    R_bs: FloatArray  # (n_segments, 3, 3) sensor to segment
    parents: IntArray  # (n_segments,) of the skeleton
    offsets: FloatArray  # (n_segments, 3) of the skeleton, m
    root_device: IntArray  # (1,) segment whose device measures where it is; −1: nothing does
    root_arm: FloatArray  # (3,) that device on it, segment axes, m
    nominal_interval_ns: IntArray  # (1,)


class Constants(NamedTuple):
    """All that does not change from frame to frame but the state's arrays, which change in place."""

    wearing: Wearing
    body: ChainBody
    noise: Noise
    fixed: IntArray  # (d,) see ``chain_state.fixed_points``
    is_joint: bool
    state: FilterState


class Inputs(NamedTuple):
    """T instants of m modules in sensor axes, as in ``ImuFrame``; k readings of local devices in all."""

    time_ns: IntArray  # (T,)
    specific_force: FloatArray  # (T, m, 3)
    angular_rate: FloatArray  # (T, m, 3)
    magnetic_field: FloatArray  # (T, m, 3)
    status: StatusArray  # (T, m)
    root_position: FloatArray  # (T, 3) measured, m; of no meaning without a device for it
    readings_end: IntArray  # (T,) how many of the readings have come with this instant
    readings: FloatArray  # (k, 8) device of the filter, s since the first frame, value, standard deviation
    sun: FloatArray  # (T, m + 1, 4) direction and standard deviation, last row: in the world; (T, 0, 4): none


Outputs = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, StatusArray]
"""``q_wb`` (T, n, 4), ``angular_rate``, ``joint_acceleration``, ``p_w`` (T, n, 3), ``sigma``, ``status``
(T, n), as in ``SkeletonFrame``."""


def wearing_of(suit: WornSuit, root_device: LocalDevice | None, nominal_interval_s: float) -> Wearing:
    """root_device: what measures where a segment is, if anything does."""
    return Wearing(
        suit.module_of_segment.astype(np.int64),
        sensor_to_segment_matrices(suit),
        suit.skeleton.parents.astype(np.int64),
        np.array(suit.skeleton.offsets, np.float64),
        np.array([-1 if root_device is None else root_device.segment], np.int64),
        np.zeros(3) if root_device is None else np.array(root_device.position, np.float64),
        np.array([round(nominal_interval_s * 1e9)], np.int64),
    )


@compiled
def advance(
    held: Constants,
    time_ns: IntArray,
    specific_force: FloatArray,
    angular_rate: FloatArray,
    magnetic_field: FloatArray,
    status: StatusArray,
    root_position: FloatArray,
    readings_end: IntArray,
    readings: FloatArray,
    sun: FloatArray,
    resting: FloatArray,
    covariance: FloatArray,
) -> Outputs:
    """All instants in turn. held: see ``held_arguments``; then the fields of ``Inputs``, and (T, n) for how
    long each segment has stood still, s. covariance: (T, n, 3, 3) is filled with that of the orientation
    errors, world axes, rad²; empty: not wanted."""
    wearing, state, noise = held.wearing, held.state, held.noise
    n_frames, n = len(time_ns), len(wearing.parents)
    q_wb, rate = np.full((n_frames, n, 4), np.nan), np.full((n_frames, n, 3), np.nan)
    acceleration, p_w = np.full((n_frames, n, 3), np.nan), np.empty((n_frames, n, 3))
    sigma, status_out = np.empty((n_frames, n)), np.empty((n_frames, n), np.uint8)
    taken, none_valid = 0, np.zeros(n)
    for t in range(n_frames):
        observed = by_segment(
            wearing.module_of_segment, wearing.R_bs, specific_force[t], angular_rate[t], magnetic_field[t],
            status[t],
        )  # fmt: skip
        is_valid, dt = none_valid, _tick(state.time_ns, time_ns[t], wearing.nominal_interval_ns[0])
        if dt > SHORTEST_STEP_S:
            before_s = (time_ns[t] - state.time_ns[1]) * 1e-9 - dt
            _take(held.body, state, noise, before_s, readings[taken : readings_end[t]])
            acceleration[t], is_valid = step(
                held.body, state, noise, held.fixed, held.is_joint, dt,
                (time_ns[t] - state.time_ns[1]) * 1e-9, observed, resting[t],
                sun_by_segment(wearing.module_of_segment, wearing.R_bs, sun[t]),
            )  # fmt: skip
        taken = readings_end[t]
        _outputs(
            wearing, state, is_valid, observed.status, noise.largest_rate, q_wb[t], rate[t], status_out[t]
        )
        mark_unaided(
            held.body, state, held.fixed, (time_ns[t] - state.time_ns[1]) * 1e-9, status_out[t]
        )
        sigma[t] = orientation_sigma(state)
        if len(covariance) > 0:
            covariance[t] = state.P[:, :3, :3]
        p_w[t] = _positions(wearing, q_wb[t], root_position[t])
    return q_wb, rate, acceleration, p_w, sigma, status_out


@compiled
def _tick(clock: IntArray, time_ns: int, nominal_interval_ns: int) -> float:
    """Seconds since the frame before; one that is not later leaves the clock as it is."""
    if clock[1] < 0:
        clock[0], clock[1] = time_ns - nominal_interval_ns, time_ns
    dt = 1e-9 * float(time_ns - clock[0])
    if dt > SHORTEST_STEP_S:
        clock[0] = time_ns
    return dt


@compiled
def _positions(wearing: Wearing, q_wb: FloatArray, root_position: FloatArray) -> FloatArray:
    """(n, 3) of the proximal joints: from the device that measures a place, else from the origin."""
    carrier = wearing.root_device[0]
    p_w = joint_positions(wearing.parents, wearing.offsets, q_wb, np.zeros(3))
    if carrier >= 0:
        p_w += root_position - p_w[carrier] - quaternion.rotate(q_wb[carrier], wearing.root_arm)
    return p_w


@compiled
def _take(
    body: ChainBody, state: FilterState, noise: Noise, before_s: float, readings: FloatArray
) -> None:
    """before_s: of the frame that the orientations are of."""
    for reading in readings:
        value, sigma, s = reading[2:5].copy(), 0.0, body.device_segment[int(reading[0])]
        is_own = body.device_kind[int(reading[0])] == AIR_VELOCITY
        if is_own:
            w, since = state.rate[s] - state.bias[s], reading[1] - before_s
            rotation_matrix.turn(rotation_matrix.from_rotation_vector(w * since), value)
            rotation_matrix.turn(state.R[s], value)
        if is_finite(value) and not (is_own and state.is_started[s] != 1):
            for i in range(5, 8):
                if not math.isnan(reading[i]):
                    sigma = max(sigma, min(reading[i], np.finfo(np.float64).max))
            take_reading(state, noise, int(reading[0]), reading[1], value, sigma)


@compiled
def _outputs(
    wearing: Wearing,
    state: FilterState,
    is_valid: FloatArray,
    measured_status: StatusArray,
    largest_rate: float,
    q_wb: FloatArray,
    rate: FloatArray,
    status: StatusArray,
) -> None:
    """Segments without module go with their parent; the others as the filter has them. A saturated gyrometer
    is none; with its accelerometer saturated, or off, a segment turns by its gyrometer alone."""
    for s in range(len(wearing.parents)):
        p = wearing.parents[s]
        status[s] = measured_status[s]
        if wearing.module_of_segment[s] < 0:
            status[s] = MISSING
            if p >= 0 and status[p] != MISSING:
                q_wb[s], rate[s], status[s] = q_wb[p], rate[p], PREDICTED
        elif state.is_started[s] == 0:
            status[s] = MISSING
        else:
            q_wb[s] = quaternion.from_matrix(state.R[s])
            for i in range(3):
                rate[s, i] = state.rate[s, i] - state.bias[s, i]
            if is_valid[s] == 0.0 or exceeds(state.rate[s], largest_rate):
                status[s] = PREDICTED
            elif is_valid[s] == 1.0:
                status[s] = UNAIDED
