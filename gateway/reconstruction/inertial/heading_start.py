"""Headings that nobody knows yet: found by the motion itself, in closed form. Compiled.

While a segment's heading against its parent is open, a linearised filter may converge to anything. But the
horizontal accelerations of the joint seen from both sides are the same vector up to one angle ψ, whose
posterior is von Mises: ``exp(κ cos(ψ − ψ₀))`` with ``κ e^{iψ₀} = Σ u_p ū / σ²`` (horizontal parts as complex
numbers). Once κ is large enough the segment and all beyond it are turned by ψ₀ and the filter takes over.
Until then the field, if there is one, leads the heading as a compass does; it counts as evidence of its own.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.frames import FloatArray
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot
from gateway.reconstruction.inertial.chain_state import ChainBody, FilterState, Noise

FORGET_S = 20.0
"""Evidence older than this counts less: gyrometers drift."""
COMPASS_S = 10.0
"""The field leads an open heading with its mean over at most that long."""
COMPASS_TRUSTED_S = 0.3
"""Having seen an undisturbed field for so long, its heading counts beside the motion."""
LOST_SIGMA = 1.0
"""rad: a heading less certain than that is open again."""
GRAVITY = 9.81
TILT_MEMORY_S = 1.0
DENSE = 5.0
"""Rows share errors: the angle found is less sure than the evidence says by this factor."""


@compiled
def tilt_spread(state: FilterState, s: int, interval_s: float) -> float:
    """Variance ((m/s²)²) that an uncertain tilt of segment s gives to the horizontal part of a row.

    It stays for ``TILT_MEMORY_S``, so rows every ``interval_s`` do not average it out. At the start it is all
    there is: two segments at rest that are tilted alike would otherwise seem to show their headings.
    """
    tilt = 0.5 * (state.P[s, 0, 0] + state.P[s, 1, 1])
    variance: float = GRAVITY**2 * tilt * max(1.0, TILT_MEMORY_S / interval_s)
    return variance


@compiled
def bending(state: FilterState, s: int, u: FloatArray, interval_s: float) -> float:
    """Variance ((m/s²)²) of a row every ``interval_s`` by what the linearisation leaves out; u (3,) of s.

    A tilt δ moves u by ``δ × u + ½ δ × (δ × u)``. Where inclinations are as uncertain as at a start in motion
    the second term is larger than the noise, and as lasting as the tilt: taken for linear, a few rows would
    make a wrong inclination certain.
    """
    tilt = 0.5 * (state.P[s, 0, 0] + state.P[s, 1, 1])
    variance: float = 2.0 * tilt * tilt * dot(u, u) * max(1.0, TILT_MEMORY_S / interval_s)
    return variance


@compiled
def gather_heading(
    state: FilterState, s: int, u: FloatArray, y: FloatArray, variance: float, interval_s: float
) -> None:
    """One pair more: u (3,) of segment s, y (3,) what it must agree with, world."""
    decay = math.exp(-interval_s / FORGET_S)
    heading = state.heading[s]
    heading[0] = heading[0] * decay + (y[0] * u[0] + y[1] * u[1]) / variance
    heading[1] = heading[1] * decay + (y[1] * u[0] - y[0] * u[1]) / variance
    length = math.hypot(u[0], u[1]) * math.hypot(y[0], y[1])
    heading[2] = heading[2] * decay + length / variance
    heading[3] += interval_s


@compiled
def shown_heading(state: FilterState, noise: Noise, s: int) -> tuple[float, float]:
    """Variance (rad²) and angle of a heading that motion has shown; variance 0: not yet."""
    prior = 0.0
    if state.compass_s[s] > COMPASS_TRUSTED_S:
        prior = DENSE / noise.start_heading**2
    along, across = state.heading[s, 0] + prior, state.heading[s, 1]
    concentration = math.hypot(along, across)
    if state.heading[s, 3] < noise.heading_time_s or concentration < noise.heading_evidence:
        return 0.0, 0.0
    if concentration < noise.heading_coherence * (state.heading[s, 2] + prior):
        return 0.0, 0.0
    return DENSE / concentration, math.atan2(across, along)


@compiled
def is_apart(body: ChainBody, state: FilterState, s: int) -> bool:
    """Whether the heading of segment s against its parent, of a root against the world, is lost."""
    p, variance = body.parents[s], state.P[s, 2, 2]
    if p >= 0:
        variance += state.P[p, 2, 2] - 2.0 * state.C[s, 2, 2]
    return bool(variance > LOST_SIGMA**2)


@compiled
def _is_left_behind(body: ChainBody, state: FilterState, s: int) -> bool:
    """Whether the parent's heading alone is lost: it is found anew, and segment s keeps its own."""
    p = body.parents[s]
    if p < 0 or state.P[s, 2, 2] > LOST_SIGMA**2:
        return False
    return bool(state.is_open[p] == 1 or (state.is_started[p] != 1 and body.opens[p] == 1))


@compiled
def reopen_headings(body: ChainBody, state: FilterState) -> None:
    """Headings that the filter itself no longer knows (gyrometers saturated, long unseen) are open again.

    A linearised filter would not find them; the next motion does, in closed form.
    """
    for s in range(len(body.parents)):
        if state.is_open[s] == 1 or body.opens[s] == 0 or state.is_started[s] != 1:
            continue
        if is_apart(body, state, s) and not _is_left_behind(body, state, s):
            state.is_open[s], state.compass_s[s] = 1, 0.0
            state.heading[s] = 0.0


@compiled
def compass_turn(state: FilterState, s: int, off: float, disturbance: float, dt: float) -> float:
    """Turn (rad) of an open heading that the field sees off; disturbance: 1 none, more counts less."""
    state.compass_s[s] += dt / disturbance
    memory_s: float = max(dt, min(state.compass_s[s], COMPASS_S))
    return -off * min(1.0, dt / disturbance / memory_s)


@compiled
def turn_evidence(state: FilterState, s: int, angle: float) -> None:
    """The evidence after segment s was turned by ``angle`` about the vertical (its parent: by −angle)."""
    heading = state.heading[s]
    if angle == 0.0:
        return
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y = heading[0], heading[1]
    heading[0], heading[1] = x * cosine + y * sine, y * cosine - x * sine


@compiled
def turn_beyond(body: ChainBody, state: FilterState, s: int, angle: float, turns: FloatArray) -> None:
    """Segment s and all beyond it, up to those that have kept their own headings while it was lost."""
    beyond = np.zeros(len(body.parents))
    beyond[s] = 1.0
    for c in range(s, len(body.parents)):
        if body.parents[c] >= 0 and beyond[body.parents[c]] > 0.0:
            beyond[c] = 1.0 if state.is_open[c] == 1 or not is_apart(body, state, c) else 0.0
        if beyond[c] > 0.0:
            turns[c, 2] += angle
