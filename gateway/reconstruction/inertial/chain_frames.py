"""Frames of a suit through a chain filter in one call: modules to segments, step, outputs. Compiled.

A live frame and a whole recording go through the same function, so they agree bit for bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gateway.body.kinematics import joint_positions_into
from gateway.body.skeleton import LocalDevice, WornSuit
from gateway.frames import FloatArray, IntArray, Quantity, Status, StatusArray
from gateway.geometry import quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import is_finite
from gateway.reconstruction.inertial.chain_scratch import Scratch
from gateway.reconstruction.inertial.chain_state import ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.chain_step import mark_unaided, note_sigma, step
from gateway.reconstruction.inertial.local_rows import take_reading
from gateway.reconstruction.inertial.observations import by_segment_into, sensor_to_segment_matrices
from gateway.reconstruction.inertial.sun_rows import sun_by_segment_into

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
    scratch: Scratch


class Inputs(NamedTuple):
    """T instants of m modules in sensor axes, as in ``ImuFrame``; k readings of local devices in all."""

    time_ns: IntArray  # (T,)
    specific_force: FloatArray  # (T, m, 3)
    angular_rate: FloatArray  # (T, m, 3)
    magnetic_field: FloatArray  # (T, m, 3)
    status: StatusArray  # (T, m)
    clipped: StatusArray  # (T, m)
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
    clipped: StatusArray,
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
    wearing, state, scratch = held.wearing, held.state, held.scratch
    n_frames, n, taken, sees_sun = len(time_ns), len(wearing.parents), 0, sun.shape[1] > 0
    q_wb, rate = np.full((n_frames, n, 4), np.nan), np.full((n_frames, n, 3), np.nan)
    acceleration, p_w = np.full((n_frames, n, 3), np.nan), np.empty((n_frames, n, 3))
    sigma, status_out = np.full((n_frames, n), np.nan), np.empty((n_frames, n), np.uint8)
    for t in range(n_frames):
        by_segment_into(
            scratch.observed, wearing.module_of_segment, wearing.R_bs, specific_force[t], angular_rate[t],
            magnetic_field[t], status[t], clipped[t],
        )  # fmt: skip
        dt = _tick(state.time_ns, time_ns[t], wearing.nominal_interval_ns[0])
        time_s = (time_ns[t] - state.time_ns[1]) * 1e-9
        if dt > SHORTEST_STEP_S:
            _take(held.body, state, held.noise, time_s - dt, readings[taken : readings_end[t]])
            if sees_sun:
                sun_by_segment_into(scratch.sun, wearing.module_of_segment, wearing.R_bs, sun[t])
            step(
                held.body, state, held.noise, scratch, held.fixed, held.is_joint, sees_sun, dt, time_s,
                resting[t], acceleration[t],
            )  # fmt: skip
        else:
            for s in range(n):
                scratch.is_valid[s] = 0.0
        taken = readings_end[t]
        _outputs(wearing, state, scratch, q_wb[t], rate[t], status_out[t])
        mark_unaided(held.body, state, scratch, held.fixed, time_s, status_out[t])
        note_sigma(sigma[t], state)
        if len(covariance) > 0:
            for s in range(n):
                rotation_matrix.copy_into(covariance[t, s], state.P[s])
        _place(p_w[t], wearing, q_wb[t], root_position[t])
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
def _place(p_w: FloatArray, wearing: Wearing, q_wb: FloatArray, root_position: FloatArray) -> None:
    """p_w (n, 3) ← proximal joints: from the device that measures a place, else from the origin."""
    carrier, shift = wearing.root_device[0], np.zeros(3)
    joint_positions_into(p_w, wearing.parents, wearing.offsets, q_wb, shift)
    if carrier >= 0:
        quaternion.rotate_into(shift, q_wb[carrier], wearing.root_arm)
        for i in range(3):
            shift[i] = root_position[i] - p_w[carrier, i] - shift[i]
        for s in range(len(p_w)):
            for i in range(3):
                p_w[s, i] += shift[i]


@compiled
def _take(body: ChainBody, state: FilterState, noise: Noise, before_s: float, readings: FloatArray) -> None:
    """before_s: of the frame that the orientations are of."""
    turn, value = np.empty((3, 3)), np.empty(3)
    for k in range(len(readings)):
        reading, sigma, s = readings[k], 0.0, body.device_segment[int(readings[k, 0])]
        for i in range(3):
            value[i] = reading[2 + i]
        is_own = body.device_kind[int(reading[0])] == AIR_VELOCITY
        if is_own:
            w, b, since = state.rate[s], state.bias[s], reading[1] - before_s
            rotation_matrix.exponential_into(
                turn, (w[0] - b[0]) * since, (w[1] - b[1]) * since, (w[2] - b[2]) * since
            )
            rotation_matrix.turn(turn, value)
            rotation_matrix.turn(state.R[s], value)
        if is_finite(value) and not (is_own and state.is_started[s] != 1):
            for i in range(5, 8):
                if not math.isnan(reading[i]):
                    sigma = max(sigma, min(reading[i], np.finfo(np.float64).max))
            kind = body.device_kind[int(reading[0])]
            take_reading(state, noise, int(reading[0]), kind, reading[1], value, sigma)


@compiled
def _outputs(
    wearing: Wearing,
    state: FilterState,
    scratch: Scratch,
    q_wb: FloatArray,
    rate: FloatArray,
    status: StatusArray,
) -> None:
    """Segments without module go with their parent; the others as the filter has them. A saturated gyrometer
    is none; with its accelerometer saturated, or off, a segment turns by its gyrometer alone."""
    for s in range(len(wearing.parents)):
        p = wearing.parents[s]
        status[s] = scratch.observed.status[s]
        if wearing.module_of_segment[s] < 0:
            status[s] = MISSING
            if p >= 0 and status[p] != MISSING:
                status[s] = PREDICTED
                for i in range(4):
                    q_wb[s, i] = q_wb[p, i]
                for i in range(3):
                    rate[s, i] = rate[p, i]
        elif state.is_started[s] == 0:
            status[s] = MISSING
        else:
            quaternion.from_matrix_into(q_wb[s], state.R[s])
            for i in range(3):
                rate[s, i] = state.rate[s, i] - state.bias[s, i]
            if scratch.is_valid[s] < 1.0:
                status[s] = PREDICTED
            elif scratch.is_valid[s] == 1.0:
                status[s] = UNAIDED
