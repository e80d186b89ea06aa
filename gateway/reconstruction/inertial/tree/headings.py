"""Headings by the sun in the tree filter. Compiled."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gateway.frames import FloatArray, ImuFrame, IntArray, SunSight
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.tree.start import tilt_square, turn_heading_sums
from gateway.reconstruction.inertial.tree.state import (
    Body,
    Heading,
    Segment,
    SegmentWork,
    State,
    SunSums,
    Validity,
    Work,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import add_own

OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value
RATE = Validity.RATE.value


# The sun
#
# Of the direction that the cells see only the azimuth counts: light of sky and ground comes from all around
# and shifts its height alone. A wrong tilt θ shifts the azimuth by ``θ tan(height)``; the variance has it.


def stacked_sights(observations: Sequence[ImuFrame]) -> FloatArray:
    """Return where the modules of each frame see the sun, (T, m + 1, 4).

    A row is a direction in sensor axes and its standard deviation, rad. The last row is the sun's direction
    in the world. (T, 0, 4) if none of the frames has it.
    """
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
    """Return the sight that one frame's rows, (m + 1, 4) or (0, 4), were stacked from; None: it had none."""
    if len(rows) == 0 or np.isnan(rows[-1, 0]):
        return None
    return SunSight(rows[-1, :3], rows[:-1, :3], rows[:-1, 3])


@compiled
def take_sun(work: Work, module_of_segment: IntArray, R_bs: FloatArray, sun: FloatArray) -> None:
    """Copy the directions of the sun, (m + 1, 4), from modules to their segments, in segment axes.

    Segments without a module are left as they are.
    """
    m = len(sun) - 1
    for i in range(3):
        work.shared.sun[i] = sun[m, i]
    for s in range(len(module_of_segment)):
        row, now = module_of_segment[s], work.segments[s]
        if row >= 0:
            rotation_matrix.rotate_into(now.sun, R_bs[s], sun[row])
            now.sun_sigma = sun[row, 3]


@compiled
def follow_sun(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Add a row for every segment that sees the sun, or turn an unobserved heading to it."""
    n, world = len(body.segments), work.shared.sun
    across = math.hypot(world[0], world[1])
    for s in range(n):
        now = work.segments[s]
        now.is_settled = 0
        if now.validity >= RATE and math.isfinite(now.sun[0] + now.sun_sigma + across):
            _follow_sun(state.segments[s], now, world, tuning, dt)
    for s in range(n):
        # of a root they turn with all its turns, see ``turn_segments``
        p, sums = body.segments[s].parent, state.segments[s].heading_sums
        if p >= 0 and work.segments[s].is_settled:
            turn_heading_sums(sums, work.segments[s].turn[2])
        if p >= 0 and work.segments[p].is_settled:
            turn_heading_sums(sums, -work.segments[p].turn[2])


@compiled
def _follow_sun(segment: Segment, now: SegmentWork, world: FloatArray, tuning: Tuning, dt: float) -> None:
    """Add the row (35) of one segment, or turn it if its heading is not known well.

    world: (3,) direction of the sun.
    """
    across, heading_variance = math.hypot(world[0], world[1]), segment.P[2, 2]
    off, height_off = _sun_error(segment.R, now.sun, world)
    tilt = tilt_square(segment)
    variance = (now.sun_sigma**2 + tilt * world[2] ** 2) / across**2
    variance *= 1.0 + (height_off / tuning.sun_height_tolerance) ** 2
    segment.sun.has_shown = 1
    if segment.heading == UNOBSERVED or heading_variance > tuning.sun_unsure**2:
        angle = _steady_turn(segment.sun, off, tuning, dt)
        if angle != 0.0:
            now.turn[2], now.is_settled = angle, 1
            segment.heading = OBSERVED
            add_own(now.evidence, (0.0, 0.0, 1.0), 0.0, variance)
        return
    sigma = math.sqrt(variance + min(heading_variance, tuning.unknown_heading**2))
    weight = max(1.0, abs(off) / sigma / tuning.huber)
    variance = variance * weight * max(1.0, tuning.sun_memory_s / dt)
    add_own(now.evidence, (0.0, 0.0, 1.0), -off, variance)


@compiled
def _sun_error(R: FloatArray, sun: FloatArray, world: FloatArray) -> tuple[float, float]:
    """Return the heading and the height by which a direction (3,) in segment axes is off the sun, rad."""
    seen = rotation_matrix.rotate(R, sun)
    off = math.atan2(world[0] * seen[1] - world[1] * seen[0], world[0] * seen[0] + world[1] * seen[1])
    height = math.atan2(seen[2], math.hypot(seen[0], seen[1]))
    return off, height - math.atan2(world[2], math.hypot(world[0], world[1]))


@compiled
def _steady_turn(look: SunSums, off: float, tuning: Tuning, dt: float) -> float:
    """Return the turn that brings an unknown heading to the sun, rad; 0: not yet.

    The sun must have been seen steadily.
    """
    decay = math.exp(-dt / tuning.sun_look_memory_s)
    look.along = look.along * decay + math.cos(off) * dt
    look.across = look.across * decay + math.sin(off) * dt
    look.seconds = look.seconds * decay + dt
    length = math.hypot(look.along, look.across)
    if look.seconds < tuning.sun_look_s or length < tuning.sun_steady * look.seconds:
        return 0.0
    angle = -math.atan2(look.across, look.along)
    look.along, look.across, look.seconds = 0.0, 0.0, 0.0
    return angle if angle != 0.0 else -1e-12  # 0 means not yet
