"""A segment that stands still is the rank-1 segment: its acceleration is known, it is zero. Compiled.

In a filter over the whole tree re-rooting needs no new order of the segments: the foot that stands adds one
row, ``R f = −g`` at its module, and aids its chain; the joint rows carry it on. In walking the feet
alternate, and the row comes and goes with its uncertainty, so nothing jumps.
"""

from __future__ import annotations

import math

from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.chain_rows import known_row
from gateway.reconstruction.inertial.chain_state import Body, State, Validity, Work
from gateway.reconstruction.inertial.tuning import Tuning

FORCE = Validity.FORCE.value


@compiled
def note_rolling(state: State, work: Work, dt: float) -> None:
    """``rolling`` ← rad/s²: ‖ω̇‖ + ‖ω‖² of what is taken to stand, from this rate and the last one.

    Called before the prediction, which takes the rate over. A foot that begins to roll off is felt here at
    once; what it accelerates by always points ahead, and would tilt whoever walks straight on.
    """
    segments, works = state.segments, work.segments
    for s in range(len(segments)):
        segment, now = segments[s], works[s]
        now.rolling = 0.0
        if now.stance_s > 0.0:
            change, square = 0.0, 0.0
            for i in range(3):
                change += (now.angular_rate[i] - segment.rate[i]) ** 2
                square += (now.angular_rate[i] - segment.bias[i]) ** 2
            now.rolling = math.sqrt(change) / dt + square


@compiled
def stance_rows(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Adds the rows of segments that stand still and marks them as aided.

    A segment that is not made to stand on may also move slowly and evenly, which its module's short window
    cannot tell from standing: its ``RestWatch`` must say so as well.
    """
    links, segments, works = body.segments, state.segments, work.segments
    for s in range(len(links)):
        segment, now, stands = segments[s], works[s], links[s].stands
        rest = segment.rest
        is_still = stands == 1 or rest.still_s > tuning.rest_s
        if now.stance_s > 0.0 and is_still and now.validity == FORCE:
            u = rotation_matrix.rotate(segment.R, now.specific_force)
            variance = tuning.stance_acceleration**2 + (tuning.stance_arm * now.rolling) ** 2
            variance *= max(1.0, tuning.stance_memory_s / dt)
            known_row(now, segment, u, body.world.at_rest, variance, tuning)
            now.aided = 1
            rest.standing_s = tuning.stride_s
        elif stands == 1 and rest.standing_s > 0.0:
            rest.standing_s -= dt
            now.aided = 1
