"""What perfect sensors would read, given the true motion of the segments that carry them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.emulators.bodies import STANDARD_GRAVITY, FloatArray
from devices.emulators.motion.kinematics_truth import MotionState

GRAVITY: FloatArray = np.array([0.0, 0.0, -STANDARD_GRAVITY])
"""(3,) world ENU, m/s²."""

MAGNETIC_FIELD: FloatArray = 49.0 * np.array([0.0, np.cos(np.radians(66.0)), -np.sin(np.radians(66.0))])
"""(3,) world ENU, µT: 49 µT dipping 66° below magnetic north, as in central Europe."""

ACCELERATION, VELOCITY, POSITION = 1, 2, 3
"""Quantities of a local measuring device, as numbered on the wire."""
AIR_VELOCITY = 4
"""Velocity in still air by pressure tubes: a packet of its own on the wire."""


@dataclass(frozen=True)
class SensorValues:
    """Readings of M modules at T times, sensor axes."""

    specific_force: FloatArray  # (T, M, 3) m/s²
    angular_rate: FloatArray  # (T, M, 3) rad/s
    magnetic_field: FloatArray  # (T, M, 3) µT


def lever_term(state: MotionState, arms: FloatArray) -> FloatArray:
    """Return ``ω̇ × r + ω × (ω × r)`` (T, M, 3), m/s², for lever arms r (M, 3), all in segment axes."""
    omega = state.angular_rate
    term: FloatArray = np.cross(state.angular_acceleration, arms) + np.cross(omega, np.cross(omega, arms))
    return term


def sense(
    state: MotionState,
    lever_arms: FloatArray,
    R_bs: FloatArray,
    gravity: FloatArray = GRAVITY,
    magnetic_field: FloatArray = MAGNETIC_FIELD,
) -> SensorValues:
    """Ideal readings of modules on the segments of ``state``.

    lever_arms: (M, 3) proximal joint to module, segment axes, m.
    R_bs: (M, 3, 3) sensor axes to segment axes.
    gravity, magnetic_field: (3,) world, m/s² and µT.

    Specific force ``f = Rᵀ (a − g) + [ω̇, ω] ⊳ U``, then turned into sensor axes.
    """
    R_bw = np.swapaxes(state.R_wb, -1, -2)
    f_b = (R_bw @ (state.joint_acceleration - gravity)[..., None])[..., 0] + lever_term(state, lever_arms)
    R_sb = np.swapaxes(R_bs, -1, -2)
    return SensorValues(
        specific_force=_apply(R_sb, f_b),
        angular_rate=_apply(R_sb, state.angular_rate),
        magnetic_field=_apply(R_sb, R_bw @ magnetic_field),
    )


def measure_point(state: MotionState, points: FloatArray, quantity: int) -> FloatArray:
    """Return acceleration (without gravity), velocity or position of points of segments, world axes, (T, M,
    3).

    points: (M, 3) from the segment's proximal joint, segment axes, m. Raises ``ValueError`` for another
    quantity.
    """
    if quantity == POSITION:
        origin, in_segment = state.joint_position, np.broadcast_to(points, state.angular_rate.shape)
    elif quantity == VELOCITY:
        origin, in_segment = state.joint_velocity, np.cross(state.angular_rate, points)
    elif quantity == ACCELERATION:
        origin, in_segment = state.joint_acceleration, lever_term(state, points)
    else:
        raise ValueError(f"quantity {quantity}: there are 1 acceleration, 2 velocity, 3 position")
    measured: FloatArray = origin + (state.R_wb @ in_segment[..., None])[..., 0]
    return measured


def _apply(R: FloatArray, v: FloatArray) -> FloatArray:
    """Return R (M, 3, 3) times v (T, M, 3)."""
    turned: FloatArray = np.einsum("mij,tmj->tmi", R, v)
    return turned
