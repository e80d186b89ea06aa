"""What ``WholeBodyReconstructor`` does before and after the finder, many frames in one call. Compiled.

A live frame and a whole recording go through the same functions, so they agree bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.body.interpolation import FollowingRule, follow
from gateway.body.kinematics import joint_positions_into
from gateway.frames import Clipped, FloatArray, IntArray, Status, StatusArray
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.reconstruction.inertial.contacts import (
    ContactPlace,
    PositionState,
    StanceState,
    Walk,
    Walker,
    advance_position,
    watch_stance,
)
from gateway.reconstruction.inertial.observations import SegmentObservations, by_segment_into
from gateway.reconstruction.joint_agreement import AgreementState, FramePose, Joints, watch_joints
from gateway.reconstruction.module_faults import RepeatState, watch_repeats
from gateway.reconstruction.mounting import JUDGED_EVERY_S, UNKNOWN
from gateway.reconstruction.stacked_frames import PoseArrays, StackedFrames

SHORTEST_STEP_S = 1e-5
LONGEST_STEP_S = 0.5
"""A longer pause counts as one of that length."""
NEVER_NS = int(np.iinfo(np.int64).min)
INTERPOLATED, MISSING, DOUBTFUL = Status.INTERPOLATED.value, Status.MISSING.value, Status.DOUBTFUL.value
PREDICTED, UNAIDED = Status.PREDICTED.value, Status.UNAIDED.value
RATE_CLIPPED, FORCE_CLIPPED = Clipped.ANGULAR_RATE.value, Clipped.SPECIFIC_FORCE.value
LARGEST = float(np.finfo(np.float64).max)


class SegmentFrames(NamedTuple):
    """T instants of n segments, as the finder and what follows it are to see them."""

    specific_force: FloatArray  # (T, n, 3) segment axes, m/s²
    clipped: StatusArray  # (T, n) ``Clipped`` sensors
    stood_s: FloatArray  # (T, n) for how long each segment stands still, s; 0: it does not
    dt: FloatArray  # (T,) s since the frame before


def segment_room(n_frames: int, n: int) -> SegmentFrames:
    """Return arrays for what ``prepare_frames`` writes of n segments."""
    clipped = np.empty((n_frames, n), np.uint8)
    return SegmentFrames(np.empty((n_frames, n, 3)), clipped, np.empty((n_frames, n)), np.empty(n_frames))


class Before(NamedTuple):
    """Constants and state of what is done before the finder."""

    module_of_segment: IntArray  # (n,) −1: none
    R_bs: FloatArray  # (n, 3, 3) sensor to segment
    carries: FloatArray  # (n,) 1 for segments that stand on the ground
    gravity: FloatArray  # (1,) its size, m/s²
    clock: IntArray  # (1,) when the newest frame was, ns
    repeats: RepeatState
    stance: StanceState


class After(NamedTuple):
    """Constants and state of what is done after it."""

    judged: FloatArray  # (1,) s since it was last judged how modules are worn
    is_doubtful: StatusArray  # (n,)
    joints: Joints
    agreement: AgreementState
    rules: Records[FollowingRule]
    parents: IntArray  # (n,)
    offsets: FloatArray  # (n, 3)
    places: Records[ContactPlace]
    walks: Records[Walk]  # one; none where the root does not walk
    position: PositionState


@compiled
def prepare_frames(modules: StackedFrames, segments: SegmentFrames, before: Before) -> bool:
    """Prepare instants in time order for the finder; return whether any sensor is stuck.

    modules: values of stuck modules, and the field of stuck magnetometers, are taken out in place.
    segments: is written.
    """
    observed = _nothing_observed(len(before.module_of_segment))
    repeats = before.repeats.modules
    any_stuck = False
    for t in range(len(modules.time_ns)):
        force, rate, field = modules.specific_force[t], modules.angular_rate[t], modules.magnetic_field[t]
        status, dt = modules.status[t], _step(before.clock, modules.time_ns[t])
        segments.dt[t] = dt
        watch_repeats(repeats, force, rate, field, status, dt)
        for m in range(len(repeats)):
            if repeats[m].is_stuck:
                status[m] = MISSING
                for i in range(3):
                    force[m, i], rate[m, i] = np.nan, np.nan
            if repeats[m].is_stuck or repeats[m].has_stuck_field:
                any_stuck = True
                for i in range(3):
                    field[m, i] = np.nan
        by_segment_into(
            observed, before.module_of_segment, before.R_bs, force, rate, field, status, modules.clipped[t]
        )
        watch_stance(segments.stood_s[t], before.stance, before.carries, before.gravity[0], observed, dt)
        _copy(observed, segments, t)
    return any_stuck


@compiled
def observe_frames(modules: StackedFrames, segments: SegmentFrames, before: Before) -> None:
    """Write specific forces and clipped sensors of ``segments`` again, as ``prepare_frames`` does."""
    observed = _nothing_observed(len(before.module_of_segment))
    for t in range(len(modules.time_ns)):
        force = modules.specific_force[t]
        by_segment_into(
            observed, before.module_of_segment, before.R_bs, force, force, force, modules.status[t],
            modules.clipped[t],
        )  # fmt: skip
        _copy(observed, segments, t)


@compiled
def _nothing_observed(n: int) -> SegmentObservations:
    """Return the observations of n segments without any sample."""
    force, rate, field = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    return SegmentObservations(force, rate, field, np.full(n, MISSING, np.uint8), np.zeros(n, np.uint8))


@compiled
def _copy(observed: SegmentObservations, segments: SegmentFrames, t: int) -> None:
    """Write the specific forces and clipped sensors of instant t."""
    for s in range(len(observed.clipped)):
        segments.clipped[t, s] = observed.clipped[s]
        for i in range(3):
            segments.specific_force[t, s, i] = observed.specific_force[s, i]


@compiled
def _step(clock: IntArray, time_ns: int) -> float:
    """Return the time since the frame before, s, and set the clock.

    It is at least ``SHORTEST_STEP_S`` and at most ``LONGEST_STEP_S``.
    """
    dt = (time_ns - clock[0]) * 1e-9 if clock[0] > NEVER_NS else 0.0
    clock[0] = time_ns
    return min(max(dt, SHORTEST_STEP_S), LONGEST_STEP_S)


@compiled
def finish_frames(first: int, watched: int, poses: PoseArrays, segments: SegmentFrames, after: After) -> int:
    """Finish poses in time order from frame ``first`` on, in place.

    Returns the frame after which it is to be judged how modules are worn: to go on, call again from that
    one, whose joints have been watched. T: all is done. watched: frames before it have been watched.
    """
    n = len(after.parents)
    finite_rate, origin = np.empty((n, 3)), np.empty(3)
    for t in range(first, len(poses.root)):
        q_wb, rate, p_w, status = poses.q_wb[t], poses.angular_rate[t], poses.p_w[t], poses.status[t]
        force, dt = segments.specific_force[t], segments.dt[t]
        if t >= watched:
            _mark_clipped(status, segments.clipped[t])
            watch_joints(after.joints, after.agreement, FramePose(q_wb, force, rate, status), dt)
            after.judged[0] += dt
            if after.judged[0] >= JUDGED_EVERY_S:
                return t

        mark_doubtful(status, poses.sigma[t], after.is_doubtful)
        follow(after.rules, q_wb, rate, poses.sigma[t], status)

        if len(after.walks) > 0:
            _bounded(rate, finite_rate)
            body, contacts = after.position.body[0], after.position.contacts
            walker = Walker(after.parents, after.offsets, after.places, after.walks[0], body, contacts)
            place, stands_on = advance_position(walker, q_wb, finite_rate, force, segments.stood_s[t], dt)
            joint_positions_into(p_w, after.parents, after.offsets, q_wb, place)
            if stands_on >= 0:
                poses.root[t] = stands_on
        elif len(after.rules) > 0:
            for i in range(3):
                origin[i] = p_w[0, i]
            joint_positions_into(p_w, after.parents, after.offsets, q_wb, origin)
    return len(poses.root)


@compiled
def _bounded(rate: FloatArray, finite_rate: FloatArray) -> None:
    """Write angular rates (n, 3), rad/s, within ±``LARGEST``; one that is not known counts as none."""
    for s in range(len(finite_rate)):
        for i in range(3):
            w = rate[s, i]
            finite_rate[s, i] = 0.0 if np.isnan(w) else min(max(w, -LARGEST), LARGEST)


@compiled
def _mark_clipped(status: StatusArray, clipped: StatusArray) -> None:
    """Set ``status`` of segments with a sensor at the end of its range, in place.

    PREDICTED: such a gyroscope does not show how far the segment has turned, whatever the finder. UNAIDED:
    such an accelerometer does not show where down is.
    """
    for s in range(len(status)):
        if status[s] <= INTERPOLATED:
            if clipped[s] & RATE_CLIPPED:
                status[s] = PREDICTED
            elif clipped[s] & FORCE_CLIPPED:
                status[s] = UNAIDED


@compiled
def mark_doubtful(status: StatusArray, sigma: FloatArray, is_doubtful: StatusArray) -> None:
    """Mark measured segments whose modules seem to be worn otherwise, in place.

    They become DOUBTFUL, with the sigma of an unknown orientation.
    """
    for s in range(len(status)):
        if is_doubtful[s] and status[s] <= INTERPOLATED:
            status[s], sigma[s] = DOUBTFUL, UNKNOWN
