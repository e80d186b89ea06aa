"""Modules that go on sending without sensing. Compiled.

A sensor's noise changes its last bits all the time. A module whose specific force and rate have not changed
in any bit for a while, though other modules' have, is stuck. (If none changes, they may be noise-free
simulations at rest: nothing is said.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gateway.frames import FloatArray, StatusArray
from gateway.geometry.compiled import compiled

STUCK_S = 0.5
"""Sensors of 16 bits at rest repeat a whole reading a few times in a row at most."""
LIVELY_S = 0.1


class RepeatState(NamedTuple):
    """By module, changed in place."""

    last: FloatArray  # (m, 6) specific force and rate
    unchanged_s: FloatArray  # (m,)


def initial_repeats(m: int) -> RepeatState:
    """Of m modules."""
    return RepeatState(np.full((m, 6), np.nan), np.zeros(m))


@compiled
def stuck_modules(
    state: RepeatState, force: FloatArray, rate: FloatArray, status: StatusArray, dt: float
) -> StatusArray:
    """(m,) 1 for modules that are stuck. force, rate: (m, 3) as sent; dt: since the frame before, s."""
    m = len(status)
    stuck = np.zeros(m, np.uint8)
    lively = 0
    for i in range(m):
        if status[i] > 1:  # held by the gateway, or missing: the assembler's matter
            continue
        changed = False
        for k in range(3):
            # NaN differs from itself: a sensor that is not there repeats nothing
            changed = changed or (force[i, k] != state.last[i, k])
            changed = changed or (rate[i, k] != state.last[i, 3 + k] and rate[i, k] == rate[i, k])
            state.last[i, k], state.last[i, 3 + k] = force[i, k], rate[i, k]
        state.unchanged_s[i] = 0.0 if changed else state.unchanged_s[i] + dt
        lively += state.unchanged_s[i] < LIVELY_S
    if lively:
        for i in range(m):
            stuck[i] = state.unchanged_s[i] >= STUCK_S and status[i] <= 1
    return stuck
