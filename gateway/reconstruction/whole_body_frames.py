"""What ``WholeBodyReconstructor`` does before and after the finder, many frames in one call. Compiled.

A live frame and a whole recording go through the same functions, so they agree bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.interpolation import FollowingRules, follow
from gateway.body.kinematics import joint_positions_into
from gateway.frames import Clipped, FloatArray, IntArray, Status, StatusArray
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.observations import SegmentObservations, by_segment_into
from gateway.reconstruction.inertial.root_position import (
    Contacts,
    PositionSettings,
    PositionState,
    advance_position,
)
from gateway.reconstruction.inertial.stance import StanceSettings, StanceState, watch_stance
from gateway.reconstruction.joint_agreement import AgreementState, Joints, watch_joints
from gateway.reconstruction.module_faults import RepeatState, stuck_modules
from gateway.reconstruction.mounting import JUDGED_EVERY_S, UNKNOWN

SHORTEST_STEP_S = 1e-5
LONGEST_STEP_S = 0.5
"""A longer pause counts as one of that length."""
NEVER_NS = int(np.iinfo(np.int64).min)
INTERPOLATED, MISSING, DOUBTFUL = Status.INTERPOLATED.value, Status.MISSING.value, Status.DOUBTFUL.value
PREDICTED, UNAIDED = Status.PREDICTED.value, Status.UNAIDED.value
RATE_CLIPPED, FORCE_CLIPPED = Clipped.ANGULAR_RATE.value, Clipped.SPECIFIC_FORCE.value
LARGEST = float(np.finfo(np.float64).max)


class Before(NamedTuple):
    """Constants and state of what is done before the finder."""

    module_of_segment: IntArray  # (n,) −1: none
    R_bs: FloatArray  # (n, 3, 3) sensor to segment
    carries: FloatArray  # (n,) 1 for segments that stand on the ground
    gravity: FloatArray  # (1,) its size, m/s²
    observed: SegmentObservations
    """Of the newest frame."""
    stuck: StatusArray  # (m,) 1 for modules that are stuck in the newest frame
    clock: IntArray  # (1,) when the newest frame was, ns
    repeats: RepeatState
    stance_settings: StanceSettings
    stance: StanceState


class After(NamedTuple):
    """Constants and state of what is done after it."""

    joints: Joints
    agreement: AgreementState
    judged: FloatArray  # (1,) s since it was last judged how modules are worn
    is_doubtful: StatusArray  # (n,)
    rules: FollowingRules
    walks: bool
    contacts: Contacts
    """Of no meaning where the root does not walk."""
    position_settings: PositionSettings
    position: PositionState
    parents: IntArray  # (n,)
    offsets: FloatArray  # (n, 3)
    rate: FloatArray  # (n, 3) of one frame, numbers throughout
    root: FloatArray  # (3,) where the root's joint is in one frame


@compiled
def prepare_frames(
    held: Before,
    time_ns: IntArray,
    specific_force: FloatArray,
    angular_rate: FloatArray,
    magnetic_field: FloatArray,
    status: StatusArray,
    clipped: StatusArray,
    force_of_segment: FloatArray,
    clipped_of_segment: StatusArray,
    resting: FloatArray,
    dt: FloatArray,
) -> bool:
    """Instants in time order; values of modules that are stuck are taken out in place.

    time_ns (T,), then (T, m, 3) and (T, m) by module. Written are, by segment and in its axes, specific force
    (T, n, 3), clipped sensors (T, n) and for how long each stands still (T, n), s; dt (T,) since the frame
    before, s. Returns whether any module is stuck.
    """
    any_stuck = False
    for t in range(len(time_ns)):
        dt[t] = _step(held.clock, time_ns[t])
        stuck_modules(held.repeats, specific_force[t], angular_rate[t], status[t], dt[t], held.stuck)
        for m in range(len(held.stuck)):
            if held.stuck[m]:
                any_stuck = True
                status[t, m] = MISSING
                for i in range(3):
                    specific_force[t, m, i], angular_rate[t, m, i] = np.nan, np.nan
                    magnetic_field[t, m, i] = np.nan
        observed = held.observed
        by_segment_into(
            observed, held.module_of_segment, held.R_bs, specific_force[t], angular_rate[t],
            magnetic_field[t], status[t], clipped[t],
        )  # fmt: skip
        watch_stance(
            resting[t], held.stance_settings, held.stance, held.carries, held.gravity[0],
            observed.specific_force, observed.angular_rate, observed.status, dt[t],
        )  # fmt: skip
        _copy(observed, force_of_segment[t], clipped_of_segment[t])
    return any_stuck


@compiled
def observe_frames(
    held: Before,
    specific_force: FloatArray,
    angular_rate: FloatArray,
    magnetic_field: FloatArray,
    status: StatusArray,
    clipped: StatusArray,
    force_of_segment: FloatArray,
    clipped_of_segment: StatusArray,
) -> None:
    """Only the specific forces (T, n, 3) and clipped sensors (T, n) by segment, of the same."""
    for t in range(len(status)):
        by_segment_into(
            held.observed, held.module_of_segment, held.R_bs, specific_force[t], angular_rate[t],
            magnetic_field[t], status[t], clipped[t],
        )  # fmt: skip
        _copy(held.observed, force_of_segment[t], clipped_of_segment[t])


@compiled
def _copy(observed: SegmentObservations, force: FloatArray, clipped: StatusArray) -> None:
    for s in range(len(clipped)):
        clipped[s] = observed.clipped[s]
        for i in range(3):
            force[s, i] = observed.specific_force[s, i]


@compiled
def _step(clock: IntArray, time_ns: int) -> float:
    """Seconds since the frame before."""
    dt = (time_ns - clock[0]) * 1e-9 if clock[0] > NEVER_NS else 0.0
    clock[0] = time_ns
    return min(max(dt, SHORTEST_STEP_S), LONGEST_STEP_S)


@compiled
def finish_frames(
    held: After,
    first: int,
    is_judged: bool,
    q_wb: FloatArray,
    rate: FloatArray,
    p_w: FloatArray,
    sigma: FloatArray,
    status: StatusArray,
    root: IntArray,
    force: FloatArray,
    clipped: StatusArray,
    resting: FloatArray,
    dt: FloatArray,
) -> int:
    """Poses in time order from ``first`` on, changed in place: (T, n, 4), (T, n, 3), (T, n) and root (T,).

    force, clipped, resting, dt: as ``prepare_frames`` has written them. Returns the frame after which it is
    to be judged how modules are worn; called again with it and ``is_judged``, it goes on. T: all is done.
    """
    for t in range(first, len(root)):
        if t > first or not is_judged:
            _tell_clipped(status[t], clipped[t])
            watch_joints(held.joints, held.agreement, q_wb[t], force[t], rate[t], status[t], dt[t])
            held.judged[0] += dt[t]
            if held.judged[0] >= JUDGED_EVERY_S:
                return t
        tell_doubtful(status[t], sigma[t], held.is_doubtful)
        follow(held.rules, q_wb[t], rate[t], sigma[t], status[t])
        if held.walks:
            _walk(held, q_wb[t], rate[t], force[t], resting[t], dt[t], p_w[t], root[t : t + 1])
        elif len(held.rules.segments) > 0:
            for i in range(3):
                held.root[i] = p_w[t, 0, i]
            joint_positions_into(p_w[t], held.parents, held.offsets, q_wb[t], held.root)
    return len(root)


@compiled
def _walk(
    held: After,
    q_wb: FloatArray,
    rate: FloatArray,
    force: FloatArray,
    resting: FloatArray,
    dt: float,
    p_w: FloatArray,
    root: IntArray,
) -> None:
    """One frame: p_w (n, 3) and root (1,), the segment that the body stands on, in place."""
    for s in range(len(rate)):
        for i in range(3):
            held.rate[s, i] = 0.0 if np.isnan(rate[s, i]) else min(max(rate[s, i], -LARGEST), LARGEST)
    place, stands_on = advance_position(
        held.contacts, held.position_settings, held.position, q_wb, held.rate, force, resting, dt
    )
    joint_positions_into(p_w, held.parents, held.offsets, q_wb, place)
    if stands_on >= 0:
        root[0] = stands_on


@compiled
def _tell_clipped(status: StatusArray, clipped: StatusArray) -> None:
    """In place: whoever found the orientations, a gyrometer at the end of its range does not say how far its
    segment has turned, nor such an accelerometer where down is."""
    for s in range(len(status)):
        if status[s] <= INTERPOLATED:
            if clipped[s] & RATE_CLIPPED:
                status[s] = PREDICTED
            elif clipped[s] & FORCE_CLIPPED:
                status[s] = UNAIDED


@compiled
def tell_doubtful(status: StatusArray, sigma: FloatArray, is_doubtful: StatusArray) -> None:
    """In place: measured segments that are doubtful; nothing is known of how they are turned."""
    for s in range(len(status)):
        if is_doubtful[s] and status[s] <= INTERPOLATED:
            status[s], sigma[s] = DOUBTFUL, UNKNOWN
