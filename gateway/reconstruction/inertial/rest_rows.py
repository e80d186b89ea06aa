"""A segment that stands still is the rank-1 segment: its acceleration is known, it is zero. Compiled.

In a filter over the whole tree re-rooting needs no new order of the segments: the foot that stands adds one
row, ``R f = −g`` at its module, and holds up its chain; the joint rows carry it on. In walking the feet
alternate, and the row comes and goes with its uncertainty, so nothing jumps.
"""

from __future__ import annotations

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_averages import REST_S
from gateway.reconstruction.inertial.chain_rows import known_row
from gateway.reconstruction.inertial.chain_state import ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.tree_filter import Evidence

REST_ACCELERATION = 0.3
"""m/s²: of a foot that stands in a shoe."""
CORRELATION_S = 0.1
"""For how long it is off to the same side."""


@compiled
def rest_rows(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    is_valid: FloatArray,
    force: FloatArray,
    resting: FloatArray,
    dt: float,
    anchored: FloatArray,
) -> None:
    """Adds the rows and marks ``anchored`` (n,) in place. resting: (n,) s, 0: not at rest.

    A segment that is not made to stand on may also move slowly and evenly, which its module's short window
    cannot tell from rest: it must have passed ``watch_rest`` as well.
    """
    variance = REST_ACCELERATION**2 * max(1.0, CORRELATION_S / dt)
    for s in range(len(body.parents)):
        is_still = body.carries[s] == 1 or state.rest[s, 8] > REST_S
        if resting[s] > 0.0 and is_still and is_valid[s] == 2.0:
            u = rotation_matrix.rotate(state.R[s], force[s])
            known_row(evidence, state, noise, s, u, -body.gravity, variance, False)
            anchored[s] = 1.0
