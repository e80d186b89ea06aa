"""Headings in the world: by the sun, or by definition. Compiled."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gateway.frames import FloatArray, ImuFrame, IntArray, SunSight
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.reconstruction.inertial.tree.start import root_of, tilt_square, turn_heading_sums
from gateway.reconstruction.inertial.tree.state import (
    Body,
    Heading,
    Link,
    Segment,
    SegmentWork,
    Started,
    State,
    SunSums,
    Validity,
    Work,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning
from gateway.reconstruction.inertial.tree.update import add_own, inverse_into

OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value
RATE, STARTED = Validity.RATE.value, Started.YES.value


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


DEFINED = 0.99
"""Share of the mean heading's error: with all of it two segments would have one error and its negative."""


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


# Headings in the world that nothing shows


@compiled
def define_headings(body: Body, state: State, tuning: Tuning) -> None:
    """Take for known how a body heads in the world where nothing can show it, equation (57a).

    The mean of its segments' headings is what the estimate says, by definition, once all of them have been
    found against each other. Were it left unknown, a joint beside a segment that was silent would tell of it
    and turn the body: a tree does not keep what the two sides of a segment have in common.
    """
    links, segments = body.segments, state.segments
    unknown = 0.5 * tuning.unknown_heading**2
    for root in range(len(links)):
        if body.world.is_tree == 0 or links[root].parent >= 0 or links[root].heading_observable == 1:
            continue
        if segments[root].P[2, 2] * len(links) > unknown:  # else it is defined, however many have been found
            n = _found(links, segments, root)
            if n > 1 and segments[root].P[2, 2] > unknown / n:
                _define_heading(links, segments, root, n, unknown / n)


@compiled
def open_headings(body: Body, state: State, tuning: Tuning, work: Work) -> None:
    """Make the heading in the world of a tree unknown that is about to see the sun for the first time."""
    links, segments = body.segments, state.segments
    for root in range(len(links)):
        if body.world.is_tree == 0 or links[root].parent >= 0 or links[root].heading_observable == 1:
            continue
        sees, has_seen, least = False, False, tuning.unknown_heading**2
        for s in range(root, len(links)):
            if _is_there(links, segments, s, root):
                has_seen = has_seen or segments[s].sun.has_shown == 1
                sees = sees or math.isfinite(work.segments[s].sun[0])
                least = min(least, segments[s].P[2, 2])
        more = tuning.unknown_heading**2 - least
        for s in range(root, len(links)):
            if sees and not has_seen and _is_there(links, segments, s, root):
                segments[s].P[2, 2] += more
                segments[s].defined_square = 0.0
                if _is_there(links, segments, links[s].parent, root):
                    segments[s].C[2, 2] += more


@compiled
def _found(links: Records[Link], segments: Records[Segment], root: int) -> int:
    """Return how many segments of a tree are there; 0 while a heading is not found or the sun seen."""
    n = 0
    for s in range(root, len(links)):
        if _is_there(links, segments, s, root):
            if segments[s].heading == UNOBSERVED or segments[s].sun.has_shown == 1:
                return 0
            n += 1
    return n


@compiled
def _is_there(links: Records[Link], segments: Records[Segment], s: int, root: int) -> bool:
    """Return whether s is a segment of the tree of ``root``, and is estimated."""
    return bool(s >= 0 and segments[s].started == STARTED and root_of(links, s) == root)


@compiled
def _define_heading(
    links: Records[Link], segments: Records[Segment], root: int, n: int, unknown: float
) -> None:
    """Make of errors of n segments' headings what they are against their mean, if that is unknown.

    unknown: variance from which it is, rad². The mean's covariances with the errors are summed up from the
    leaves to the root and back, as for the update (47).
    """
    count = len(links)
    known, with_mean, from_beyond = np.empty((count, 6, 6)), np.zeros((count, 6)), np.zeros((count, 6))
    for s in range(count - 1, root - 1, -1):
        segment, p = segments[s], links[s].parent
        if _is_there(links, segments, s, root):
            inverse_into(known[s], segment.P)
            with_mean[s] += segment.P[2] / n
            if _is_there(links, segments, p, root):
                from_beyond[s] = segment.C.T @ (known[s] @ with_mean[s])
                with_mean[p] += from_beyond[s]
    variance = 0.0
    for s in range(root, count):
        segment, p = segments[s], links[s].parent
        if _is_there(links, segments, s, root):
            if _is_there(links, segments, p, root):
                with_mean[s] += segment.C @ (known[p] @ (with_mean[p] - from_beyond[s]))
            variance += with_mean[s, 2] / n
    if variance < unknown:
        return
    for s in range(root, count):
        segment, p = segments[s], links[s].parent
        if _is_there(links, segments, s, root):
            _subtract_mean(segment.P, with_mean[s], with_mean[s], variance)
            segment.defined_square += variance
            if _is_there(links, segments, p, root):
                _subtract_mean(segment.C, with_mean[s], with_mean[p], variance)


@compiled
def _subtract_mean(P: FloatArray, first: FloatArray, second: FloatArray, variance: float) -> None:
    """Set the covariance P (6, 6) of two segments' errors to that after (57a).

    first, second: (6,), covariances of both with the mean of the headings. variance: of that, rad².
    """
    for i in range(6):
        P[i, 2] -= DEFINED * first[i]
        P[2, i] -= DEFINED * second[i]
    P[2, 2] += DEFINED**2 * variance
