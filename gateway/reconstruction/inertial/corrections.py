"""What a filter's own corrections say of its settings: whom it believes too much. Compiled.

Corrections of a filter whose noises are right are new each time. One that believes its gyrometers too much
corrects in the same direction again and again; one that believes its rows too much goes to and fro (Kailath
1968, Mehra 1970). So the inclination's corrections, summed over half a second, are compared with those of
the half before. Where they go on, gyrometers are taken to be off by part of what their rates change by from
sample to sample: sampled too slowly for the motion, or shaken. Where they go to and fro, as with modules
that move on their segments, joints count for less. Neither could be told beforehand. Headings are shown too
slowly for that.
"""

from __future__ import annotations

import math

from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_state import FilterState

BLOCK_S = 0.5
"""Several times what rows share."""
MEMORY_S = 5.0
GAIN = 0.05
"""By how much doubts may change with a block."""
ROW_DOUBT = 2.0
"""By how much a joint's variance is raised at the most, over itself."""


@compiled
def note_correction(state: FilterState, s: int, x: float, y: float, dt: float) -> None:
    """x, y: rotation about the horizontal world axes that segment s was given over the last dt, rad."""
    seen = state.corrections[s]
    seen[0] += x
    seen[1] += y
    seen[4] += dt
    if seen[4] < BLOCK_S:
        return
    gain = 1.0 - math.exp(-seen[4] / MEMORY_S)
    square = 0.5 * (seen[0] ** 2 + seen[1] ** 2 + seen[2] ** 2 + seen[3] ** 2)
    seen[5] += gain * (seen[0] * seen[2] + seen[1] * seen[3] - seen[5])
    seen[6] += gain * (square - seen[6])
    if seen[6] > 0.0:
        step = GAIN * seen[5] / seen[6]
        seen[7] = min(1.0, max(0.0, seen[7] + step))
        seen[8] = min(1.0, max(0.0, seen[8] - step))
    seen[2], seen[3] = seen[0], seen[1]
    seen[0], seen[1], seen[4] = 0.0, 0.0, 0.0


@compiled
def gyrometer_doubt(state: FilterState, s: int, square: float, dt: float) -> float:
    """(rad/s)²/Hz by which a gyrometer's noise is raised; square: of what its rate changed by over dt."""
    return float(state.corrections[s, 7] * square * dt)


@compiled
def row_doubt(state: FilterState, s: int, p: int) -> float:
    """Factor by which the variance of the joint of s and p is raised."""
    return float(1.0 + ROW_DOUBT * max(state.corrections[s, 8], state.corrections[p, 8]))
