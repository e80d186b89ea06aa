"""What ``WholeBodyReconstructor`` does before and after the finder, many frames in one call. Compiled.

A live frame and a whole recording go through the same functions, so they agree bit for bit.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gateway.body.interpolation import FollowingRule, follow
from gateway.body.kinematics import joint_positions_into
from gateway.frames import Clipped, FloatArray, IntArray, Status, StatusArray
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.reconstruction.inertial.contacts import (
    Contact,
    ContactPlace,
    Position,
    PositionState,
    Stance,
    StanceState,
    Walk,
    Walker,
    advance_position,
    watch_stance,
)
from gateway.reconstruction.inertial.observations import SegmentObservations, by_segment_into
from gateway.reconstruction.joint_agreement import (
    AgreementState,
    Block,
    Felt,
    Joints,
    Pose,
    Products,
    Side,
    watch_joints,
)
from gateway.reconstruction.module_faults import Repeats, RepeatState, watch_repeats
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
    clock: IntArray  # (1,) when the newest frame was, ns
    repeats: RepeatState
    stance: StanceState

    def arrays(self) -> tuple[Any, ...]:
        """Return the parts as the arguments of ``prepare_frames``.

        Numba finds the type of an array that is an argument of its own at once, and that of one in a tuple
        slowly.
        """
        return (*self[:5], *self.repeats, *self.stance)


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

    def arrays(self) -> tuple[Any, ...]:
        """Return the parts as the arguments of ``finish_frames``."""
        return (*self[:2], *self.joints, *self.agreement, *self[4:9], *self.position)


@compiled
def prepare_frames(
    time_ns: IntArray,
    specific_force: FloatArray,
    angular_rate: FloatArray,
    magnetic_field: FloatArray,
    status: StatusArray,
    clipped: StatusArray,
    force_of_segment: FloatArray,
    clipped_of_segment: StatusArray,
    stood_s: FloatArray,
    dt: FloatArray,
    module_of_segment: IntArray,
    R_bs: FloatArray,
    carries: FloatArray,
    gravity: FloatArray,
    clock: IntArray,
    repeats: Records[Repeats],
    stances: Records[Stance],
) -> bool:
    """Prepare instants in time order for the finder; return whether any sensor is stuck.

    Values of stuck modules, and the field of stuck magnetometers, are taken out in place. time_ns (T,), then
    (T, m, 3) and (T, m) by module. Written are, by segment and in its axes, specific force (T, n, 3), clipped
    sensors (T, n) and for how long each stands still (T, n), s; dt (T,) since the frame before, s; then the
    arrays of a ``Before``.
    """
    observed = _nothing_observed(len(module_of_segment))
    stance = StanceState(stances)
    any_stuck = False
    for t in range(len(time_ns)):
        dt[t] = _step(clock, time_ns[t])
        watch_repeats(repeats, specific_force[t], angular_rate[t], magnetic_field[t], status[t], dt[t])
        for m in range(len(repeats)):
            if repeats[m].is_stuck:
                status[t, m] = MISSING
                for i in range(3):
                    specific_force[t, m, i], angular_rate[t, m, i] = np.nan, np.nan
            if repeats[m].is_stuck or repeats[m].has_stuck_field:
                any_stuck = True
                for i in range(3):
                    magnetic_field[t, m, i] = np.nan
        by_segment_into(
            observed, module_of_segment, R_bs, specific_force[t], angular_rate[t],
            magnetic_field[t], status[t], clipped[t],
        )  # fmt: skip
        watch_stance(stood_s[t], stance, carries, gravity[0], observed, dt[t])
        _copy(observed, force_of_segment[t], clipped_of_segment[t])
    return any_stuck


@compiled
def observe_frames(
    module_of_segment: IntArray,
    R_bs: FloatArray,
    specific_force: FloatArray,
    status: StatusArray,
    clipped: StatusArray,
    force_of_segment: FloatArray,
    clipped_of_segment: StatusArray,
) -> None:
    """Write specific forces (T, n, 3) and clipped sensors (T, n) by segment, as ``prepare_frames`` does."""
    observed = _nothing_observed(len(module_of_segment))
    for t in range(len(status)):
        force = specific_force[t]
        by_segment_into(observed, module_of_segment, R_bs, force, force, force, status[t], clipped[t])
        _copy(observed, force_of_segment[t], clipped_of_segment[t])


@compiled
def _nothing_observed(n: int) -> SegmentObservations:
    """Return the observations of n segments without any sample."""
    force, rate, field = np.full((n, 3), np.nan), np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    return SegmentObservations(force, rate, field, np.full(n, MISSING, np.uint8), np.zeros(n, np.uint8))


@compiled
def _copy(observed: SegmentObservations, force: FloatArray, clipped: StatusArray) -> None:
    for s in range(len(clipped)):
        clipped[s] = observed.clipped[s]
        for i in range(3):
            force[s, i] = observed.specific_force[s, i]


@compiled
def _step(clock: IntArray, time_ns: int) -> float:
    """Return the time since the frame before, s, and set the clock.

    It is at least ``SHORTEST_STEP_S`` and at most ``LONGEST_STEP_S``.
    """
    dt = (time_ns - clock[0]) * 1e-9 if clock[0] > NEVER_NS else 0.0
    clock[0] = time_ns
    return min(max(dt, SHORTEST_STEP_S), LONGEST_STEP_S)


@compiled
def finish_frames(
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
    stood_s: FloatArray,
    dt: FloatArray,
    judged: FloatArray,
    is_doubtful: StatusArray,
    sides: Records[Side],
    gravity: FloatArray,
    block: Records[Block],
    felt: Records[Felt],
    pairs: Records[Products],
    rules: Records[FollowingRule],
    parents: IntArray,
    offsets: FloatArray,
    places: Records[ContactPlace],
    walks: Records[Walk],
    bodies: Records[Position],
    contacts: Records[Contact],
) -> int:
    """Finish poses in time order from ``first`` on, in place: (T, n, 4), (T, n, 3), (T, n) and root (T,).

    force, clipped, stood_s, dt: as ``prepare_frames`` has written them; then the arrays of an ``After``.
    Returns the frame after which it is to be judged how modules are worn; called again with it and
    ``is_judged``, it goes on. T: all is done.
    """
    joints, agreement = Joints(sides, gravity), AgreementState(block, felt, pairs)
    finite_rate, origin = np.empty((len(parents), 3)), np.empty(3)
    for t in range(first, len(root)):
        if t > first or not is_judged:
            _mark_clipped(status[t], clipped[t])
            watch_joints(joints, agreement, Pose(q_wb[t], force[t], rate[t], status[t]), dt[t])
            judged[0] += dt[t]
            if judged[0] >= JUDGED_EVERY_S:
                return t

        mark_doubtful(status[t], sigma[t], is_doubtful)
        follow(rules, q_wb[t], rate[t], sigma[t], status[t])

        if len(walks) > 0:
            _bounded(rate[t], finite_rate)
            walker = Walker(parents, offsets, places, walks[0], bodies[0], contacts)
            place, stands_on = advance_position(walker, q_wb[t], finite_rate, force[t], stood_s[t], dt[t])
            joint_positions_into(p_w[t], parents, offsets, q_wb[t], place)
            if stands_on >= 0:
                root[t] = stands_on
        elif len(rules) > 0:
            for i in range(3):
                origin[i] = p_w[t, 0, i]
            joint_positions_into(p_w[t], parents, offsets, q_wb[t], origin)
    return len(root)


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
