"""Modules that go on sending without sensing. Compiled.

A sensor's noise changes its last bits all the time. A module whose specific force and rate have not changed
for a while, though other modules' have, is stuck. (If none changes, they may be noise-free simulations at
rest: nothing is said.) Gyrometers alone are stuck when they repeat themselves while they turn, or while the
specific force says that the module moves: sooner than in rest, where coarse sensors may repeat themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, StatusArray
from gateway.geometry.compiled import compiled
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


class RepeatState(NamedTuple):
    """By module, changed in place."""

    last: FloatArray  # (m, 6) specific force and rate
    unchanged_s: FloatArray  # (m,) all of it
    rate_unchanged_s: FloatArray  # (m,)
    force_unchanged_s: FloatArray  # (m,)
    force_before: FloatArray  # (m, 3) when the rate changed last


def initial_repeats(m: int) -> RepeatState:
    """Of m modules."""
    return RepeatState(np.full((m, 6), np.nan), np.zeros(m), np.zeros(m), np.zeros(m), np.zeros((m, 3)))


@compiled
def stuck_modules(
    state: RepeatState,
    force: FloatArray,
    rate: FloatArray,
    status: StatusArray,
    dt: float,
    stuck: StatusArray,
) -> None:
    """stuck (m,) ← 1 for modules that are. force, rate: (m, 3) as sent; dt: since the frame before, s."""
    m = len(status)
    lively, lively_rates = 0, 0
    for i in range(m):
        stuck[i] = 0
        if status[i] > 1:  # held by the gateway, or missing: the assembler's matter
            continue
        force_changed, rate_changed = False, False
        for k in range(3):
            # NaN differs from itself: a sensor that is not there repeats nothing
            force_changed = force_changed or _differs(force[i, k], state.last[i, k])
            is_there = rate[i, k] == rate[i, k]
            rate_changed = rate_changed or (is_there and _differs(rate[i, k], state.last[i, 3 + k]))
            state.last[i, k], state.last[i, 3 + k] = force[i, k], rate[i, k]
        state.unchanged_s[i] = 0.0 if force_changed or rate_changed else state.unchanged_s[i] + dt
        state.force_unchanged_s[i] = 0.0 if force_changed else state.force_unchanged_s[i] + dt
        state.rate_unchanged_s[i] = 0.0 if rate_changed else state.rate_unchanged_s[i] + dt
        if rate_changed:
            for k in range(3):
                state.force_before[i, k] = force[i, k]
        lively_rates += state.rate_unchanged_s[i] < LIVELY_S
        lively += state.unchanged_s[i] < LIVELY_S
    for i in range(m):
        if status[i] <= 1:
            stuck[i] = lively > 0 and state.unchanged_s[i] >= STUCK_S
            stuck[i] |= lively_rates > 0 and _has_stuck_rate(state, i, force[i], rate[i])


@compiled
def _differs(value: float, before: float) -> bool:
    """By more than rounding: a repeated reading that was interpolated may be off in its last bit."""
    return not abs(value - before) <= ROUNDING * abs(before)


@compiled
def _has_stuck_rate(state: RepeatState, i: int, force: FloatArray, rate: FloatArray) -> bool:
    """Whether module i's gyrometers, if it has any, repeat themselves while it turns, or swings."""
    if state.force_unchanged_s[i] != 0.0 or state.rate_unchanged_s[i] < STUCK_IN_MOTION_S:
        return False
    if not norm(rate) >= 0.0:  # NaN: it has none
        return False
    return bool(norm(rate) > TURNING or norm(force - state.force_before[i]) > SWINGING)
