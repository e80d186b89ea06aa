"""A leg of two links between hip and ankle: joint angles from where the foot is."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from devices.deferred import Rotation
from devices.emulators.bodies import EmulatedBody, FloatArray

HEEL, TOE = (-0.05, -0.068), (0.15, -0.068)
"""m, from the ankle: forward and up; of feet whose contact points are not given."""


@dataclass(frozen=True)
class Leg:
    """Lengths in m; vectors forward, up and right."""

    segments: list[int]
    """Thigh, shank, foot."""
    hip: FloatArray  # (3,) in the pelvis' axes
    thigh: float
    shank: float
    heel: FloatArray  # (2,) forward and up of the ankle
    toe: FloatArray  # (2,)


def has_legs(body: EmulatedBody) -> bool:
    """Return whether the body's segments include two legs that hang on its root."""
    names = [f"{side}_{part}" for side in ("left", "right") for part in ("thigh", "shank", "foot")]
    if not set(names) <= set(body.segment_names):
        return False
    hips = [body.segment_names.index(f"{side}_thigh") for side in ("left", "right")]
    return all(body.parents[hip] == 0 for hip in hips)


def leg_of(body: EmulatedBody, side: str) -> Leg:
    """Return a leg of the body. Raises ``ValueError`` for a body without that leg."""
    if not has_legs(body):
        raise ValueError("to walk, a body needs left_ and right_ thigh, shank and foot below its root")
    thigh, shank, foot = (body.segment_names.index(f"{side}_{part}") for part in ("thigh", "shank", "foot"))
    points = [point for segment, point in body.contacts if segment == foot]
    # A body that names no contacts has those of a usual foot.
    points = points or [np.array([*HEEL, 0.0]), np.array([*TOE, 0.0])]
    return Leg(
        segments=[thigh, shank, foot],
        hip=body.offsets[thigh],
        thigh=float(np.linalg.norm(body.offsets[shank])),
        shank=float(np.linalg.norm(body.offsets[foot])),
        heel=min(points, key=lambda point: float(point[0]))[:2],
        toe=max(points, key=lambda point: float(point[0]))[:2],
    )


def leg_angles(
    leg: Leg,
    pelvis: FloatArray,
    facing: FloatArray,
    ankle: FloatArray,
    foot_heading: FloatArray,
    foot_pitch: FloatArray,
) -> FloatArray:
    """Return ``leg_angles_of`` a pelvis that only turns about the vertical.

    facing, foot_heading, foot_pitch: (T,) rad.
    """
    R_pelvis = Rotation.from_euler("y", facing[:, None])
    return leg_angles_of(leg, pelvis, R_pelvis, ankle, foot_turn(foot_heading, foot_pitch))


def foot_turn(heading: FloatArray, pitch: FloatArray) -> Rotation:
    """Return the orientation of a foot in the plan: (T,) rad each, toes up is positive."""
    return Rotation.from_euler("y", heading[:, None]) * Rotation.from_euler("z", pitch[:, None])


def leg_angles_of(
    leg: Leg, pelvis: FloatArray, R_pelvis: Rotation, ankle: FloatArray, R_foot: Rotation
) -> FloatArray:
    """Return angles (T, 3, 3) of thigh, shank and foot about x, y, z, each against its parent, order z, x, y.

    pelvis, ankle: (T, 3) places, m: forward, up, right. Raises ``ValueError`` where the leg is too short.
    """
    reach = ankle - pelvis - R_pelvis.apply(leg.hip)
    length = np.linalg.norm(reach, axis=1)
    longest = leg.thigh + leg.shank
    if (length > longest * (1 + 1e-9)).any():
        raise ValueError(f"the step is too long for the leg: {length.max():.3f} m of {longest:.3f} m")
    up = -reach / length[:, None]
    across = R_pelvis.apply([0.0, 0.0, 1.0]) + R_foot.apply([0.0, 0.0, 1.0])
    across -= np.sum(across * up, axis=1, keepdims=True) * up
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    plane = Rotation.from_matrix(np.stack([np.cross(up, across), up, across], axis=2))
    # half angles: exact for a leg that is nearly straight
    slack = np.maximum(longest - length, 0.0) * (longest + length)
    knee = 2.0 * np.arcsin(np.sqrt(np.minimum(1.0, slack / (4.0 * leg.thigh * leg.shank))))
    hip = np.arctan2(leg.shank * np.sin(knee), leg.thigh + leg.shank * np.cos(knee))
    R_thigh = plane * Rotation.from_euler("z", hip[:, None])
    R_shank = R_thigh * Rotation.from_euler("z", -knee[:, None])
    chain = [R_pelvis, R_thigh, R_shank, R_foot]
    turns = [(parent.inv() * child).as_euler("ZXY") for parent, child in pairwise(chain)]
    return np.stack([np.unwrap(turn, axis=0)[:, [1, 2, 0]] for turn in turns], axis=1)
