"""What a filter's own corrections say of its settings: whom it believes too much. Compiled.

Corrections of a filter whose noises are right are new each time. One that believes its gyroscopes too much
corrects in the same direction again and again; one that believes its rows too much goes to and fro (Kailath
1968, Mehra 1970). So the inclination's corrections, summed over half a second, are compared with those of
the half before. Where they go on, gyroscopes are taken to be off by part of what their rates change by from
sample to sample: sampled too slowly for the motion, or shaken. Where they go to and fro, as with modules
that move on their segments, joints count for less. Neither could be told beforehand. Headings are shown too
slowly for that.
"""

from __future__ import annotations

import math

from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_state import Corrections, Segment
from gateway.reconstruction.inertial.tuning import Tuning


@compiled
def note_correction(seen: Corrections, x: float, y: float, tuning: Tuning, dt: float) -> None:
    """x, y: rotation about the horizontal world axes that a segment was given over the last dt, rad."""
    now, before = seen.sums, seen.sums_before
    now[0] += x
    now[1] += y
    seen.seconds += dt
    if seen.seconds < tuning.correction_block_s:
        return
    gain = 1.0 - math.exp(-seen.seconds / tuning.correction_memory_s)
    square = 0.5 * (now[0] ** 2 + now[1] ** 2 + before[0] ** 2 + before[1] ** 2)
    seen.product += gain * (now[0] * before[0] + now[1] * before[1] - seen.product)
    seen.square += gain * (square - seen.square)
    if seen.square > 0.0:
        step = tuning.correction_gain * seen.product / seen.square
        seen.gyroscope = min(1.0, max(0.0, seen.gyroscope + step))
        seen.rows = min(1.0, max(0.0, seen.rows - step))
    for i in range(2):
        before[i], now[i] = now[i], 0.0
    seen.seconds = 0.0


@compiled
def gyroscope_inflation(segment: Segment, square: float, dt: float) -> float:
    """(rad/s)²/Hz by which a gyroscope's noise is raised; square: of what its rate changed by over dt."""
    return float(segment.corrections.gyroscope * square * dt)


@compiled
def row_inflation(child: Segment, parent: Segment, tuning: Tuning) -> float:
    """Factor by which the variance of the joint between the two is raised."""
    return float(1.0 + tuning.row_inflation * max(child.corrections.rows, parent.corrections.rows))
