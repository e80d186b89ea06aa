"""Headings by the sun in the chain filters. Compiled.

Of the direction that the cells see only the azimuth counts: light of sky and ground comes from all around
and shifts its height alone. A wrong tilt θ shifts the azimuth by ``θ tan(height)``; the variance has it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gateway.frames import FloatArray, ImuFrame, IntArray, SunSight
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_state import OPEN_SIGMA, ChainBody, FilterState, Noise
from gateway.reconstruction.inertial.heading_start import turn_evidence
from gateway.reconstruction.inertial.tree_filter import Evidence, add_own

SUN_MEMORY_S = 1.0
"""For how long cells stay off to the same side while the module turns."""
HEIGHT_TOLERANCE = 0.1
"""rad: light from higher or lower than the sun by that much is half believed."""
LOOK_S = 0.3
"""Seen steadily for so long, the sun settles an open heading."""
LOOK_MEMORY_S = 1.0
STEADY = 0.97
"""Mean resultant length of the headings seen meanwhile."""
UNSURE = 0.5
"""rad: a heading no surer than this is turned at once, not by a linearised row."""


def stacked_sights(observations: Sequence[ImuFrame]) -> FloatArray:
    """(T, m + 1, 4) where modules see the sun, sensor axes, with its standard deviation; the last row: where
    it stands in the world. (T, 0, 4) if none of the frames has it."""
    if all(observation.sun is None for observation in observations):
        return np.zeros((len(observations), 0, 4))
    m = len(observations[0].status)
    stacked = np.full((len(observations), m + 1, 4), np.nan)
    for rows, observation in zip(stacked, observations, strict=True):
        if observation.sun is not None:
            rows[:m, :3], rows[:m, 3] = observation.sun.direction, observation.sun.sigma
            rows[m, :3] = observation.sun.world
    return stacked


def sight_of(rows: FloatArray) -> SunSight | None:
    """What one frame's rows, (m + 1, 4) or (0, 4), were stacked from; None: it had none."""
    if len(rows) == 0 or np.isnan(rows[-1, 0]):
        return None
    return SunSight(rows[-1, :3], rows[:-1, :3], rows[:-1, 3])


@compiled
def sun_by_segment_into(
    seen: FloatArray, module_of_segment: IntArray, R_bs: FloatArray, sun: FloatArray
) -> None:
    """Rows (m + 1, 4) of modules to (n + 1, 4) of segments, segment axes; those without module are left."""
    n, m = len(module_of_segment), len(sun) - 1
    for i in range(4):
        seen[n, i] = sun[m, i]
    for s in range(n):
        row = module_of_segment[s]
        if row >= 0:
            rotation_matrix.rotate_into(seen[s], R_bs[s], sun[row])
            seen[s, 3] = sun[row, 3]


@compiled
def follow_sun(
    evidence: Evidence,
    body: ChainBody,
    state: FilterState,
    noise: Noise,
    is_valid: FloatArray,
    sun: FloatArray,
    dt: float,
    turns: FloatArray,
) -> None:
    """A row for every segment that sees the sun; an open heading is turned to it. sun: (n + 1, 4) direction
    in segment axes and its standard deviation, the last row: in the world; NaN where it is not seen."""
    n = len(body.parents)
    world, settled = sun[n], np.zeros(n)
    across = math.hypot(world[0], world[1])
    for s in range(n):
        is_seen = math.isfinite(sun[s, 0] + sun[s, 3] + across)
        if is_valid[s] < 1.0 or not is_seen:
            continue
        off, height_off = _sun_error(state.R[s], sun[s, :3].copy(), world)
        tilt = 0.5 * (state.P[s, 0, 0] + state.P[s, 1, 1])
        variance = (sun[s, 3] ** 2 + tilt * world[2] ** 2) / across**2
        variance *= 1.0 + (height_off / HEIGHT_TOLERANCE) ** 2
        if state.is_open[s] == 1 or state.P[s, 2, 2] > UNSURE**2:
            angle = _steady_turn(state, s, off, dt)
            if angle != 0.0:
                turns[s, 2], settled[s] = angle, 1.0
                state.is_open[s] = 0
                _heading_row(evidence, s, 0.0, variance)
            continue
        sigma = math.sqrt(variance + min(state.P[s, 2, 2], OPEN_SIGMA**2))
        weight = max(1.0, abs(off) / sigma / noise.huber)
        _heading_row(evidence, s, -off, variance * weight * max(1.0, SUN_MEMORY_S / dt))
    for s in range(n):
        if settled[s] > 0.0:
            turn_evidence(state, s, turns[s, 2])
        elif body.parents[s] >= 0 and settled[body.parents[s]] > 0.0:
            turn_evidence(state, s, -turns[body.parents[s], 2])


@compiled
def _sun_error(R: FloatArray, seen: FloatArray, world: FloatArray) -> tuple[float, float]:
    """Heading and height by which a direction (3,) in segment axes is off the sun, rad."""
    rotation_matrix.turn(R, seen)
    off = math.atan2(world[0] * seen[1] - world[1] * seen[0], world[0] * seen[0] + world[1] * seen[1])
    height = math.atan2(seen[2], math.hypot(seen[0], seen[1]))
    return off, height - math.atan2(world[2], math.hypot(world[0], world[1]))


@compiled
def _steady_turn(state: FilterState, s: int, off: float, dt: float) -> float:
    """The turn that brings an unknown heading to the sun, once it was seen steadily; 0: not yet."""
    look = state.sun[s]
    decay = math.exp(-dt / LOOK_MEMORY_S)
    look[0] = look[0] * decay + math.cos(off) * dt
    look[1] = look[1] * decay + math.sin(off) * dt
    look[2] = look[2] * decay + dt
    if look[2] < LOOK_S or math.hypot(look[0], look[1]) < STEADY * look[2]:
        return 0.0
    angle = -math.atan2(look[1], look[0])
    look[:] = 0.0
    return angle if angle != 0.0 else -1e-12


@compiled
def _heading_row(evidence: Evidence, s: int, residual: float, variance: float) -> None:
    row = np.zeros(3)
    row[2] = 1.0
    add_own(evidence, s, row, residual, variance)
