"""Magnetometers that are stuck in their own axes: what they measure stays while their modules turn. Compiled.

Any field of the surroundings turns against a module that turns. A value that does not, because its sensor
hangs or because iron on the module outweighs everything, says nothing of a heading.

One that hangs is found by ``module_faults.py`` too, before any method, by repeating its last bit. Here the
readings may be noisy, and only the direction counts, turned as the filter knows it.
"""

from __future__ import annotations

import math

from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot, is_finite
from gateway.reconstruction.inertial.tree.state import (
    FieldWatch,
    Segment,
    SegmentWork,
    State,
    Validity,
    Work,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning

RATE = Validity.RATE.value


@compiled
def leave_out_stuck_fields(state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Make the field of every module NaN whose magnetometer is stuck, and reset its compass, section 8.

    Called after the prediction, which sets the mean rate of the step. dt: s since the instant before.
    """
    segments, works = state.segments, work.segments
    for s in range(len(segments)):
        segment, now = segments[s], works[s]
        if not is_finite(now.magnetic_field):
            continue
        if _is_stuck(segment, now, tuning, dt):
            segment.compass.seconds = 0.0
            segment.field_watch.seconds = 0.0
            for i in range(3):
                now.magnetic_field[i] = math.nan


@compiled
def _is_stuck(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> bool:
    """Return whether a module's field has stayed while it should have turned by far more.

    The last field that was new is turned by the gyroscope as one of the surroundings would have turned. Rates
    that may be a bias do not count.
    """
    watch, m, turn, w = segment.field_watch, now.magnetic_field, now.rotation, now.mean_rate
    changed = 0.0
    for i in range(3):
        changed += (m[i] - watch.stays[i]) ** 2
    if now.validity < RATE or changed > tuning.stuck_change**2 * dot(m, m):
        _begin(watch, now)
        return False
    watch.stays_s += dt
    if dot(w, w) > tuning.largest_bias**2:
        # a field of the surroundings turns the other way round in the module's axes
        rotation_matrix.exponential_into(turn, -w[0] * dt, -w[1] * dt, -w[2] * dt)
        rotation_matrix.turn(turn, watch.turned)
    along = dot(watch.turned, watch.stays)
    is_off = along < math.cos(tuning.stuck_turn) * dot(watch.stays, watch.stays)
    watch.is_stuck = 1 if watch.is_stuck == 1 or (is_off and watch.stays_s > tuning.stuck_s) else 0
    return watch.is_stuck == 1


@compiled
def _begin(watch: FieldWatch, now: SegmentWork) -> None:
    """Begin to watch from a field that is new."""
    watch.stays_s, watch.is_stuck = 0.0, 0
    for i in range(3):
        watch.stays[i], watch.turned[i] = now.magnetic_field[i], now.magnetic_field[i]
