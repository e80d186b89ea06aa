"""Find for which placements ``articulated`` loses the heading where modules have no gyrometers.

At rest a module off its joint tells nothing of a turn about the field but by the acceleration that such a
turn would cause (``gyro_free``): where the arm from the joint lies in the plane of vertical and field, only
the pendulum equation is left, and that is stable for a module that hangs below the joint. So it is tried,
with the equations of ``gyro_free`` themselves: from a start that is wrong by a degree, a body at rest in the
neutral posture gives exact readings, and the error has to shrink. It depends on the way that the body faces.
"""

from __future__ import annotations

import math

import numpy as np

from gateway.body.skeleton import WornSuit
from gateway.frames import FloatArray
from gateway.geometry import quaternion, rotation_matrix
from gateway.geometry.compiled import compiled
from gateway.reconstruction.inertial.articulated import ON_JOINT, ArticulatedSettings, travelled_chain
from gateway.reconstruction.inertial.gyro_free import Rotation, Weights, next_rotation

FACINGS = tuple(range(0, 360, 15))
"""Ways to face, degrees clockwise from north. Placements are lost within 10° or more to either side."""
_NEUTRAL_FACING = 90
_START_ERROR = math.radians(1.0)
_N_FRAMES, _INTERVAL_S = 200, 0.005
"""What hangs below its joint has lost a quarter of the error by then, what stands above it is off by 5°."""


def unobserved_headings(suit: WornSuit) -> dict[str, tuple[int, ...]]:
    """Return, by segment, those of ``FACINGS`` in which its heading is not observed; none: not in the result.

    Of ``articulated`` without gyrometers, at rest in the neutral posture. Segments without a module, or with
    one on their joint, have no such ways.
    """
    settings = ArticulatedSettings()
    weights = Weights(
        settings.specific_force_sigma, settings.direction_sigma, settings.second_difference_sigma
    )
    sigma = np.repeat([settings.start_orientation_sigma, settings.start_rate_sigma], 3)
    U = travelled_chain(suit).U
    neutral = quaternion.to_matrix(quaternion.normalise(suit.skeleton.neutral))
    found: dict[str, tuple[int, ...]] = {}
    for s in np.flatnonzero((suit.module_of_segment >= 0) & (np.linalg.norm(U, axis=1) >= ON_JOINT)):
        lost = tuple(
            facing
            for facing in FACINGS
            if _largest_error_at_rest(
                _turned(neutral, facing),
                -suit.gravity,
                suit.magnetic_field,
                U[s],
                weights,
                np.diag(sigma**2),
            )
            > _START_ERROR
        )
        if lost:
            found[suit.skeleton.segment_names[s]] = lost
    return found


def _turned(neutral: FloatArray, facing: int) -> FloatArray:
    """Return the orientation (3, 3) of segments whose body faces that way."""
    angle = math.radians(_NEUTRAL_FACING - facing)  # counter-clockwise from above
    turn = rotation_matrix.from_rotation_vector(np.array([0.0, 0.0, angle]))
    return np.asarray(turn @ neutral)


@compiled
def _largest_error_at_rest(
    truth: FloatArray,
    up: FloatArray,
    field: FloatArray,
    U: FloatArray,
    weights: Weights,
    covariance: FloatArray,
) -> float:
    """Return the angle, rad, that the orientation is off after a second at rest, having begun a degree off.

    truth: (3, 3) segment to world; up: (3,) a − g, m/s²; field: (3,) µT, both in the world.
    The degree is about the field, one way and the other; the larger outcome counts.
    """
    f, x = rotation_matrix.rotate_inverse(truth, up), rotation_matrix.rotate_inverse(truth, field)
    largest = 0.0
    for sign in (-1.0, 1.0):
        turn = field * (sign * _START_ERROR / math.sqrt((field * field).sum()))
        R = rotation_matrix.multiply(rotation_matrix.from_rotation_vector(turn), truth)
        now = Rotation(R, np.zeros(3), np.zeros(3), covariance)
        for _ in range(_N_FRAMES):
            now = next_rotation(now, _INTERVAL_S, _INTERVAL_S, f, x, up, field, U, weights)
        off = now.R - truth  # the sum of its squares is 8 sin²(angle / 2)
        largest = max(largest, 2.0 * math.asin(min(1.0, math.sqrt((off * off).sum() / 8.0))))
    return largest
