"""What the floor does to the feet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from gateway.body.anthropometry import LENGTH_OF_STATURE
from gateway.body.inertia import HEEL_BEHIND_ANKLE, leg_stature, part_name
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray, IntArray

LEAST_FORCE_N = 20.0
"""Below it, up, a foot counts as off the floor."""
_FLOOR_PERCENTILE = 2.0
_BALL_OF_FOOT, _TOE_OF_FOOT = 0.70, 0.95
"""From the heel, of the foot's length."""
_HALF_WIDTH_OF_FOOT = 0.17
_TOE_SPRING = 0.06
"""How much higher than the ball the toe's tip stands, of the foot's length."""


class ForceSource(IntEnum):
    """Where a foot's force at an instant came from."""

    NONE = 0
    MEASURED = 1
    ESTIMATED = 2
    UNKNOWN = 3
    """The foot stands, and nothing tells its force."""


@dataclass(frozen=True)
class FloorForces:
    """What the floor does to C segments over F instants; world axes."""

    segments: IntArray  # (C,)
    force: FloatArray  # (F, C, 3) N
    moment: FloatArray  # (F, C, 3) N m, about the world's origin
    source: NDArray[np.uint8]  # (F, C) ``ForceSource``
    height_m: FloatArray  # (F, C) of what is under the foot
    notes: tuple[str, ...] = ()
    """Sentences on what is doubtful."""

    def total(self) -> FloatArray:
        """Return (F, 3) N."""
        summed: FloatArray = self.force.sum(axis=1)
        return summed

    def known_beyond(self, skeleton: Skeleton) -> NDArray[np.bool_]:
        """Return (F, S) whether the force on every foot that hangs on a segment, or is it, is known."""
        known = np.ones((len(self.source), skeleton.n_segments), dtype=bool)
        for c, foot in enumerate(self.segments.tolist()):
            segment = foot
            while segment >= 0:
                known[:, segment] &= self.source[:, c] != ForceSource.UNKNOWN
                segment = int(skeleton.parents[segment])
        return known

    def part(self, instants: slice) -> FloorForces:
        """Return those of some instants."""
        force, moment, source = self.force[instants], self.moment[instants], self.source[instants]
        return replace(self, force=force, moment=moment, source=source, height_m=self.height_m[instants])

    def centre_of_pressure(self) -> FloatArray:
        """Return (F, C, 3) m on the floor; NaN where there is no force to speak of."""
        up = np.where(self.force[..., 2] < LEAST_FORCE_N, np.nan, self.force[..., 2])
        x = (self.height_m * self.force[..., 0] - self.moment[..., 1]) / up
        y = (self.height_m * self.force[..., 1] + self.moment[..., 0]) / up
        return np.stack([x, y, np.where(np.isnan(up), np.nan, self.height_m)], axis=-1)


def feet(skeleton: Skeleton) -> IntArray:
    """Return indices of the segments that stand on the floor: those named feet, else those with contacts."""
    named = [s for s, name in enumerate(skeleton.segment_names) if part_name(name) == "foot"]
    return np.array(named or sorted({s for s, _ in skeleton.contacts}), dtype=np.int64)


def sole_points(skeleton: Skeleton) -> tuple[IntArray, FloatArray]:
    """Return segments (P,) and places (P, 3) m in their axes of the points of all soles.

    Of a person heel, ball and toe tip by the stature of the legs, left and right; of other bodies the
    contacts of the body file.
    """
    stature = leg_stature(skeleton)
    if stature is None:
        carriers = np.array([s for s, _ in skeleton.contacts], dtype=np.int64)
        return carriers, np.array([point for _, point in skeleton.contacts]).reshape(-1, 3)
    length, depth = LENGTH_OF_STATURE["foot"] * stature, LENGTH_OF_STATURE["foot_height"] * stature
    along = np.array([0.0, 0.0, _BALL_OF_FOOT, _BALL_OF_FOOT, _TOE_OF_FOOT]) - HEEL_BEHIND_ANKLE
    across = np.array([-0.6, 0.6, -1.0, 1.0, 0.0]) * _HALF_WIDTH_OF_FOOT
    rise = np.array([0.0, 0.0, 0.0, 0.0, _TOE_SPRING])
    one = np.stack([along * length, rise * length - depth, across * length], axis=1)
    on = feet(skeleton)
    return np.repeat(on, len(one)), np.tile(one, (len(on), 1))


def sole_paths(
    carriers: IntArray, points: FloatArray, p_w: FloatArray, rotation_wb: FloatArray
) -> FloatArray:
    """Return (F, P, 3) m of points (P, 3) of segments (P,); p_w (F, S, 3), rotation_wb (F, S, 3, 3)."""
    paths: FloatArray = p_w[:, carriers] + np.einsum("fpij,pj->fpi", rotation_wb[:, carriers], points)
    return paths


def floor_height(paths: FloatArray) -> float:
    """Return the height of the floor under soles (F, P, 3), m: their lowest point hardly ever goes below."""
    return float(np.percentile(paths[..., 2].min(axis=1), _FLOOR_PERCENTILE)) if paths.size else 0.0
