"""Modules that go on sending without sensing. Compiled.

A sensor's noise changes its last bits all the time. A module whose specific force and rate have not changed
for a while, though other modules' have, is stuck. (If none changes, they may be noise-free simulations at
rest: none is called stuck.) Gyroscopes alone are stuck when they repeat themselves while they turn, or while
the specific force shows that the module moves: sooner than at rest, where coarse sensors may repeat
themselves. A magnetometer alone is stuck when it repeats itself while the gyroscopes turn: longer than slow
magnetometers take between two readings. That is a broken sensor, and whoever wears it is told, whatever the
method. A magnetometer that works but whose field turns with the module, as of iron on it, never repeats
itself; the filter alone can find and needs to leave out such a one: ``inertial/tree/stuck.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, StatusArray
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Record, Records, Vector, records
from gateway.geometry.vectors import norm

STUCK_S = 0.5
"""Sensors of 16 bits at rest repeat a whole reading a few times in a row at most."""
LIVELY_S = 0.1
ROUNDING = 1e-12
STUCK_IN_MOTION_S = 0.15
"""In motion no reading of 16 bits comes twice on all three axes, but by rare chance."""
TURNING = 0.05
"""rad/s: a rate that stays exactly this large is no rest."""
SWINGING = 1.0
"""m/s²: change of specific force over that time that no rest has."""

FIELD_STUCK_S = 2.0
"""Magnetometers that take a reading only once a second are repeated for as long."""
FIELD_STUCK_TURN = 1.0
"""rad turned under one reading. About the field's own axis none changes, but nobody turns that exactly."""
FIELD_TURNING = 0.3
"""rad/s: rates below may be an offset of the gyroscopes, which turns nothing."""


class Repeats(Record):
    """How long a module has repeated itself."""

    force: Vector  # last
    rate: Vector
    unchanged_s: float  # all of it
    rate_unchanged_s: float
    force_unchanged_s: float
    force_before: Vector  # when the rate changed last
    has_stuck_rate: int  # 1 since it was found, until the rate changes
    is_stuck: int  # 1 in the newest frame
    field: Vector  # last
    field_unchanged_s: float
    turned: float  # since the field changed, rad
    has_stuck_field: int  # 1 in the newest frame that has a field


class RepeatState(NamedTuple):
    """The state of all modules; changed in place."""

    modules: Records[Repeats]


def initial_repeats(m: int) -> RepeatState:
    """Return the state of m modules before the first frame."""
    modules = records(Repeats, m)
    modules["force"], modules["rate"], modules["field"] = np.nan, np.nan, np.nan
    return RepeatState(modules)


@compiled
def watch_repeats(
    modules: Records[Repeats],
    force: FloatArray,
    rate: FloatArray,
    field: FloatArray,
    status: StatusArray,
    dt: float,
) -> None:
    """Set ``is_stuck`` and ``has_stuck_field`` of each module.

    force, rate, field: (m, 3) as sent; dt: since the frame before, s.
    """
    m = len(status)
    lively, lively_rates = 0, 0
    for i in range(m):
        module = modules[i]
        module.is_stuck = 0
        if status[i] > 1:  # held by the gateway, or missing: the assembler's matter
            module.has_stuck_field = 0
            continue
        force_changed, rate_changed = False, False
        for k in range(3):
            # NaN differs from itself: a sensor that is not there repeats nothing
            force_changed = force_changed or _differs(force[i, k], module.force[k])
            is_there = rate[i, k] == rate[i, k]
            rate_changed = rate_changed or (is_there and _differs(rate[i, k], module.rate[k]))
            module.force[k], module.rate[k] = force[i, k], rate[i, k]
        module.unchanged_s = 0.0 if force_changed or rate_changed else module.unchanged_s + dt
        module.force_unchanged_s = 0.0 if force_changed else module.force_unchanged_s + dt
        module.rate_unchanged_s = 0.0 if rate_changed else module.rate_unchanged_s + dt
        if rate_changed:
            module.has_stuck_rate = 0
            for k in range(3):
                module.force_before[k] = force[i, k]
        elif force_changed and _shows_stuck_rate(module, force[i], rate[i]):
            module.has_stuck_rate = 1
        _watch_field(module, field[i], rate[i], dt)
        lively_rates += module.rate_unchanged_s < LIVELY_S
        lively += module.unchanged_s < LIVELY_S
    for i in range(m):
        if status[i] <= 1:
            is_stuck = lively > 0 and modules[i].unchanged_s >= STUCK_S
            is_stuck |= lively_rates > 0 and modules[i].has_stuck_rate == 1
            modules[i].is_stuck = int(is_stuck)


@compiled
def _watch_field(module: Repeats, field: FloatArray, rate: FloatArray, dt: float) -> None:
    """Set ``has_stuck_field`` of a module: its magnetometer repeats itself while the module turns."""
    module.field_unchanged_s += dt
    if norm(rate) > FIELD_TURNING:
        module.turned += norm(rate) * dt
    if not norm(field) >= 0.0:  # NaN: a slow magnetometer has no reading for every frame
        return
    changed = False
    for k in range(3):
        changed = changed or _differs(field[k], module.field[k])
        module.field[k] = field[k]
    if changed:
        module.field_unchanged_s, module.turned = 0.0, 0.0
    is_stuck = module.field_unchanged_s >= FIELD_STUCK_S and module.turned >= FIELD_STUCK_TURN
    module.has_stuck_field = int(is_stuck)


def gives_one_field(field: FloatArray, rate: FloatArray, dt: FloatArray) -> bool:
    """Return whether a magnetometer gives one reading throughout, and its module turns.

    field, rate: (T, 3) as sent, NaN: no reading. dt: (T,) since the sample before, s.
    """
    readings = field[np.isfinite(field).all(axis=1)]
    if len(readings) < 2 or np.ptp(readings, axis=0).any():
        return False
    module = initial_repeats(1).modules[0]
    for now in zip(field, rate, dt, strict=True):
        _watch_field(module, *now)
    return bool(module.has_stuck_field)


@compiled
def _differs(value: float, before: float) -> bool:
    """Return whether two readings differ by more than rounding: a repeated one may be off in its last bit.

    That is so where it was interpolated.
    """
    return not abs(value - before) <= ROUNDING * abs(before)


@compiled
def _shows_stuck_rate(module: Repeats, force: FloatArray, rate: FloatArray) -> bool:
    """Return whether gyroscopes, if there are any, repeat themselves while their module turns, or swings."""
    if module.rate_unchanged_s < STUCK_IN_MOTION_S or not norm(rate) >= 0.0:  # NaN: it has none
        return False
    return bool(norm(rate) > TURNING or norm(force - module.force_before) > SWINGING)
