"""Headings that nobody knows yet: found by the motion itself, in closed form. Compiled.

While a segment's heading against its parent is unobserved, a linearised filter may converge to anything. But
the horizontal accelerations of the joint seen from both sides are the same vector up to one angle ψ, whose
posterior is von Mises: ``exp(κ cos(ψ − ψ₀))`` with ``κ e^{iψ₀} = Σ u_p ū / σ²`` (horizontal parts as complex
numbers). Once κ is large enough the segment and all beyond it are turned by ψ₀ and the filter takes over.
Until then the field, if there is one, leads the heading as a compass does; it counts as evidence of its own.
"""

from __future__ import annotations

import math

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.records import Records
from gateway.geometry.vectors import dot
from gateway.reconstruction.inertial.chain_state import (
    Body,
    Heading,
    HeadingSums,
    Link,
    Segment,
    SegmentWork,
    Started,
    State,
    Work,
)
from gateway.reconstruction.inertial.tuning import Tuning

OBSERVED, UNOBSERVED = Heading.OBSERVED.value, Heading.UNOBSERVED.value
STARTED = Started.YES.value
GRAVITY = 9.81


@compiled
def tilt_spread(segment: Segment, tuning: Tuning, interval_s: float) -> float:
    """Variance ((m/s²)²) that an uncertain tilt of a segment gives to the horizontal part of a row.

    It stays for ``tilt_memory_s``, so rows every ``interval_s`` do not average it out. At the start it is all
    there is: two segments at rest that are tilted alike would otherwise seem to show their headings.
    """
    tilt = 0.5 * (segment.P[0, 0] + segment.P[1, 1])
    variance: float = GRAVITY**2 * tilt * max(1.0, tuning.tilt_memory_s / interval_s)
    return variance


@compiled
def second_order_variance(segment: Segment, u: FloatArray, tuning: Tuning, interval_s: float) -> float:
    """Variance ((m/s²)²) of a row every ``interval_s`` by what the linearisation leaves out; u (3,) of the
    segment.

    A tilt δ moves u by ``δ × u + ½ δ × (δ × u)``. Where inclinations are as uncertain as at a start in motion
    the second term is larger than the noise, and as lasting as the tilt: taken for linear, a few rows would
    make a wrong inclination certain.
    """
    tilt = 0.5 * (segment.P[0, 0] + segment.P[1, 1])
    variance: float = 2.0 * tilt * tilt * dot(u, u) * max(1.0, tuning.tilt_memory_s / interval_s)
    return variance


@compiled
def gather_heading(
    sums: HeadingSums, u: FloatArray, y: FloatArray, variance: float, tuning: Tuning, interval_s: float
) -> None:
    """One pair more: u (3,) of the segment, y (3,) what it must agree with, world."""
    decay = math.exp(-interval_s / tuning.heading_forgets_s)
    sums.along = sums.along * decay + (y[0] * u[0] + y[1] * u[1]) / variance
    sums.across = sums.across * decay + (y[1] * u[0] - y[0] * u[1]) / variance
    length = math.hypot(u[0], u[1]) * math.hypot(y[0], y[1])
    sums.length = sums.length * decay + length / variance
    sums.seconds += interval_s


@compiled
def shown_heading(segment: Segment, tuning: Tuning) -> tuple[float, float]:
    """Variance (rad²) and angle of a heading that motion has shown; variance 0: not yet."""
    sums, prior = segment.heading_sums, 0.0
    if segment.compass_s > tuning.compass_trusted_s:
        prior = tuning.heading_density / tuning.start_heading**2
    along, across = sums.along + prior, sums.across
    concentration = math.hypot(along, across)
    if sums.seconds < tuning.heading_time_s or concentration < tuning.heading_evidence:
        return 0.0, 0.0
    if concentration < tuning.heading_coherence * (sums.length + prior):
        return 0.0, 0.0
    return tuning.heading_density / concentration, math.atan2(across, along)


@compiled
def is_apart(segment: Segment, parent: Segment, has_parent: bool, tuning: Tuning) -> bool:
    """Whether the heading of a segment against its parent, of a root against the world, is lost."""
    variance = segment.P[2, 2]
    if has_parent:
        variance += parent.P[2, 2] - 2.0 * segment.C[2, 2]
    return bool(variance > tuning.lost_heading**2)


@compiled
def _is_left_behind(segment: Segment, parent: Segment, above: Link, tuning: Tuning) -> bool:
    """Whether the parent's heading alone is lost: it is found anew, and the segment keeps its own."""
    if segment.P[2, 2] > tuning.lost_heading**2:
        return False
    is_silent = parent.started != STARTED and above.heading_observable == 1
    return bool(parent.heading == UNOBSERVED or is_silent)


@compiled
def lose_headings(links: Records[Link], segments: Records[Segment], tuning: Tuning) -> None:
    """Headings that the filter itself no longer knows (gyroscopes saturated, long unseen) are unobserved
    again.

    A linearised filter would not find them; the next motion does, in closed form.
    """
    for s in range(len(links)):
        p, segment = links[s].parent, segments[s]
        parent, above = segments[max(p, 0)], links[max(p, 0)]
        is_observable = links[s].heading_observable == 1
        if segment.heading == UNOBSERVED or not is_observable or segment.started != STARTED:
            continue
        is_left_behind = p >= 0 and _is_left_behind(segment, parent, above, tuning)
        if is_apart(segment, parent, p >= 0, tuning) and not is_left_behind:
            sums = segment.heading_sums
            segment.heading, segment.compass_s = UNOBSERVED, 0.0
            sums.along, sums.across, sums.length, sums.seconds = 0.0, 0.0, 0.0, 0.0


@compiled
def compass_turn(segment: Segment, now: SegmentWork, tuning: Tuning, dt: float) -> float:
    """Turn (rad) of an unobserved heading that the field sees off; a disturbed field counts less."""
    segment.compass_s += dt / now.disturbance
    memory_s: float = max(dt, min(segment.compass_s, tuning.compass_s))
    return -now.field_off * min(1.0, dt / now.disturbance / memory_s)


@compiled
def turn_heading_sums(sums: HeadingSums, angle: float) -> None:
    """The evidence after its segment was turned by ``angle`` about the vertical (its parent: by −angle)."""
    if angle == 0.0:
        return
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y = sums.along, sums.across
    sums.along, sums.across = x * cosine + y * sine, y * cosine - x * sine


@compiled
def turn_beyond(body: Body, state: State, tuning: Tuning, work: Work, s: int, angle: float) -> None:
    """Segment s and all beyond it, up to those that have kept their own headings while it was lost."""
    links, segments, works = body.segments, state.segments, work.segments
    for c in range(s, len(links)):
        now, p = works[c], links[c].parent
        now.is_beyond = 1 if c == s else 0
        if p >= s and works[p].is_beyond:
            is_unobserved = segments[c].heading == UNOBSERVED
            is_kept = not is_unobserved and is_apart(segments[c], segments[p], True, tuning)
            now.is_beyond = 0 if is_kept else 1
        if now.is_beyond:
            now.turn[2] += angle
