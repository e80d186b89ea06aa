"""The velocity of a module by what it feels, and what a wrong tilt makes of it. Compiled.

A tilt that is wrong turns part of gravity into an acceleration, and what that adds up to grows with time,
while the speeds of bodies are bounded. So the velocity that is felt shows the tilt, far better over seconds
than accelerations do. These are equations (39) to (39b) of ``docs/explanation/estimator.md``; the row that
follows is in ``unaided``.
"""

from __future__ import annotations

import math

from gateway.frames import FloatArray
from gateway.geometry import rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.geometry.vectors import dot
from gateway.reconstruction.inertial.tree.start import tilt_square
from gateway.reconstruction.inertial.tree.state import (
    Body,
    Segment,
    SegmentWork,
    State,
    Validity,
    Velocity,
    Work,
    World,
)
from gateway.reconstruction.inertial.tree.tuning import Tuning

FORCE, NOTHING = Validity.FORCE.value, Validity.NOTHING.value


@compiled
def predict_velocities(body: Body, state: State, tuning: Tuning, work: Work, dt: float) -> None:
    """Carry the velocities of all segments on over dt (s), equations (39) and (39a).

    A velocity begins anew after a gap over which forces need not change evenly.
    """
    segments, works = state.segments, work.segments
    for s in range(len(segments)):
        segment, now = segments[s], works[s]
        velocity = segment.velocity
        _forget_old_tilts(segment, now, body.world, dt)
        velocity.waits_s += dt
        if now.is_felt:
            if velocity.waits_s - dt > tuning.longest_bridge_s:
                _begin(velocity, tuning)
            else:
                _add_acceleration(segment, now, body.world, tuning, dt)
            velocity.waits_s = 0.0
        elif now.validity > NOTHING:
            velocity.waits_s = math.inf  # what it felt at the end of its range may have been any force


@compiled
def _begin(velocity: Velocity, tuning: Tuning) -> None:
    """Begin a velocity of which no more is known than how fast the body is as a rule."""
    for i in range(3):
        velocity.felt[i], velocity.lasting[i] = 0.0, 0.0
    velocity.tilted_s = 0.0
    velocity.square = max(velocity.square, tuning.unaided_speed**2)
    velocity.variance = velocity.square


@compiled
def _add_acceleration(segment: Segment, now: SegmentWork, world: World, tuning: Tuning, dt: float) -> None:
    """Add to the velocity what the specific force of now says, equation (39)."""
    velocity, R = segment.velocity, segment.R
    lasted_s = velocity.waits_s
    x, y, z = (
        now.specific_force[0] - segment.force_bias[0],
        now.specific_force[1] - segment.force_bias[1],
        now.specific_force[2] - segment.force_bias[2],
    )
    # (39) v ← v + (R f + g) Δt
    for i in range(3):
        force = R[i, 0] * x + R[i, 1] * y + R[i, 2] * z
        velocity.felt[i] += lasted_s * (force - world.at_rest[i])
    velocity.tilted_s += lasted_s
    # (39) U ← U + σ_fb² T_u Δt, and A_f² of what was missed, and of shocks
    velocity.variance += tuning.force_bias**2 * tuning.unaided_memory_s * lasted_s
    velocity.variance += segment.felt_square * (lasted_s - dt) ** 2
    if now.validity == FORCE:
        velocity.variance += 2.0 / 3.0 * (segment.vibration.shock * dt) ** 2


@compiled
def _forget_old_tilts(segment: Segment, now: SegmentWork, world: World, dt: float) -> None:
    """Move what the velocity owes to tilts that are gone into ``variance``, equation (39a)."""
    velocity, tilt, before = segment.velocity, tilt_square(segment), now.tilt_before
    if velocity.tilted_s == 0.0 or tilt == 0.0:
        return
    # (39a) the share of the tilt's error that it had before the prediction
    share = min(max(0.5 * (before + tilt - now.density * dt) / tilt, 0.0), 1.0)
    square = dot(world.gravity, world.gravity) * velocity.tilted_s**2
    velocity.variance += square * max(before - share**2 * tilt, 0.0)
    velocity.tilted_s *= share


@compiled
def turn_velocity(E: FloatArray, velocity: Velocity, world: World) -> None:
    """Take off the velocity what the tilt made of it that a turn E (3, 3) sets right, equation (39b)."""
    felt, rest = velocity.felt, world.at_rest
    rotation_matrix.turn(E, felt)
    rotation_matrix.turn(E, velocity.lasting)
    for i in range(3):
        turned = E[i, 0] * rest[0] + E[i, 1] * rest[1] + E[i, 2] * rest[2]
        felt[i] += velocity.tilted_s * (turned - rest[i])
        velocity.lasting[i] += velocity.tilted_s * (turned - rest[i])


@compiled
def learn_velocity(velocity: Velocity, variance: float) -> None:
    """Update the velocity by that it is 0 but for a variance, (m/s)², equation (40)."""
    kept = variance / (velocity.variance + variance)
    for i in range(3):
        velocity.felt[i] *= kept
    velocity.tilted_s *= kept
    velocity.variance *= kept
