"""A segment that stands still is the rank-1 segment: its acceleration is known, it is zero. Compiled.

In a filter over the whole tree re-rooting needs no new order of the segments: the foot that stands adds one
row, ``R f = −g`` at its module, and holds up its chain; the joint rows carry it on. In walking the feet
alternate, and the row comes and goes with its uncertainty, so nothing jumps.
"""

from __future__ import annotations

import math

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_averages import REST_S
from gateway.reconstruction.inertial.chain_rows import known_row
from gateway.reconstruction.inertial.chain_state import ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.tree_filter import Evidence

REST_ACCELERATION = 0.3
"""m/s²: of a foot that stands in a shoe."""
ROLLING_ARM = 0.12
"""m: of its module from the heel or ball about which it rolls on and off."""
STRIDE_S = 1.0
"""A foot that has stood holds up its chain for so long: runners touch the ground for a fifth of the time."""
CORRELATION_S = 0.1
"""For how long it is off to the same side."""


@compiled
def note_rolling(
    motion: FloatArray, state: FilterState, rate: FloatArray, resting: FloatArray, dt: float
) -> None:
    """motion (n,) ← rad/s²: ‖ω̇‖ + ‖ω‖² of what is taken to rest, from this rate (n, 3) and the last one.

    Called before the prediction, which takes the rate over. A foot that begins to roll off is felt here at
    once; what it accelerates by always points ahead, and would tilt whoever walks straight on.
    """
    for s in range(len(resting)):
        motion[s] = 0.0
        if resting[s] > 0.0:
            change, square = 0.0, 0.0
            for i in range(3):
                change += (rate[s, i] - state.rate[s, i]) ** 2
                square += (rate[s, i] - state.bias[s, i]) ** 2
            motion[s] = math.sqrt(change) / dt + square


@compiled
def rest_rows(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    is_valid: FloatArray,
    force: FloatArray,
    resting: FloatArray,
    turning: FloatArray,
    dt: float,
    anchored: FloatArray,
) -> None:
    """Adds the rows and marks ``anchored`` (n,) in place. resting: (n,) s, 0: not at rest; turning: (n,) see
    ``note_rolling``.

    A segment that is not made to stand on may also move slowly and evenly, which its module's short window
    cannot tell from rest: it must have passed ``watch_rest`` as well.
    """
    for s in range(len(body.parents)):
        is_still = body.carries[s] == 1 or state.rest[s, 8] > REST_S
        if resting[s] > 0.0 and is_still and is_valid[s] == 2.0:
            u = rotation_matrix.rotate(state.R[s], force[s])
            variance = REST_ACCELERATION**2 + (ROLLING_ARM * turning[s]) ** 2
            variance *= max(1.0, CORRELATION_S / dt)
            known_row(evidence, state, noise, s, u, body.at_rest, variance, False)
            anchored[s] = 1.0
            state.rest[s, 9] = STRIDE_S
        elif body.carries[s] == 1 and state.rest[s, 9] > 0.0:
            state.rest[s, 9] -= dt
            anchored[s] = 1.0
