"""What perfect sensors would read, given the true motion of the segments that carry them.

``SensedMotion`` has it for all modules at their sampling instants. The kinematics of a whole body cost almost
the same for one instant as for fifty. So they are evaluated ahead, for the instants at which the modules will
sample if nothing is changed, and again when a command has changed it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from devices.emulators.bodies import FloatArray, IntArray
from devices.emulators.motion.kinematics_truth import MotionState
from devices.emulators.motion.motions import BodyMotion
from firmware_protocol.samples import ACCELERATION, POSITION, STANDARD_GRAVITY, VELOCITY

GRAVITY: FloatArray = np.array([0.0, 0.0, -STANDARD_GRAVITY])
"""(3,) world ENU, m/s²."""

MAGNETIC_FIELD: FloatArray = 49.0 * np.array([0.0, np.cos(np.radians(66.0)), -np.sin(np.radians(66.0))])
"""(3,) world ENU, µT: 49 µT dipping 66° below magnetic north, as in central Europe."""

AIR_VELOCITY = 4
"""Quantity of a local measuring device beside those of ``LocalMeasurement``: velocity in still air by
pressure tubes, a packet of its own on the wire."""


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


class Sensed(NamedTuple):
    """One module at n instants: what perfect sensors read in sensor axes, and where it is."""

    specific_force: FloatArray  # (n, 3) m/s²
    angular_rate: FloatArray  # (n, 3) rad/s
    magnetic_field: FloatArray  # (n, 3) µT
    R_ws: FloatArray  # (n, 3, 3) sensor to world
    position: FloatArray  # (n, 3) m, world

    def rows(self, start: int, n: int) -> Sensed:
        """Return a run of the instants."""
        return Sensed(*(values[start : start + n] for values in self))


class Wanted(NamedTuple):
    """Instants of one module."""

    column: int
    """Which module."""
    times: FloatArray  # (n,) true times, s, n > 0


class SensedMotion:
    """Modules fixed to segments of a moving body."""

    def __init__(
        self,
        motion: BodyMotion,
        segments: IntArray,
        lever_arms: FloatArray,
        R_bs: FloatArray,
        gravity: FloatArray,
        magnetic_field: FloatArray,
    ) -> None:
        """Prepare to evaluate.

        segments: (M,) which segment each module sits on.
        lever_arms: (M, 3) proximal joint to module, segment axes, m.
        R_bs: (M, 3, 3) sensor axes to segment axes.
        gravity, magnetic_field: (3,) world, m/s² and µT.
        """
        self._motion = motion
        self._segments = segments
        self._lever_arms = lever_arms
        self._R_bs = R_bs
        self._gravity = gravity
        self._magnetic_field = magnetic_field
        self._prepared: dict[int, tuple[FloatArray, Sensed]] = {}

    def prepare(self, plans: Sequence[Wanted]) -> None:
        """Evaluate ahead what will probably be asked for, in place of what was prepared before."""
        sensed = self._evaluate(plans)
        self._prepared = {plan.column: (plan.times, at) for plan, at in zip(plans, sensed, strict=True)}

    def has(self, wanted: Wanted) -> bool:
        """Return whether those instants are prepared."""
        return self._look_up(wanted) is not None

    def at(self, wanted: Sequence[Wanted]) -> list[Sensed]:
        """Return the modules at their instants, prepared or not."""
        found = [self._look_up(one) for one in wanted]
        missing = [one for one, sensed in zip(wanted, found, strict=True) if sensed is None]
        evaluated = iter(self._evaluate(missing))
        return [next(evaluated) if sensed is None else sensed for sensed in found]

    def _look_up(self, wanted: Wanted) -> Sensed | None:
        if wanted.column not in self._prepared:
            return None
        times, sensed = self._prepared[wanted.column]
        n = len(wanted.times)
        start = int(times.searchsorted(wanted.times[0]))
        found = times[start : start + n]
        # Instants come from the same arithmetic both times, so that equal ones are equal to the bit.
        return sensed.rows(start, n) if len(found) == n and (found == wanted.times).all() else None

    def _evaluate(self, wanted: Sequence[Wanted]) -> list[Sensed]:
        if not wanted:
            return []
        columns = [one.column for one in wanted]
        # Shorter columns are filled up with a time that nothing is read at.
        times = np.full((max(len(one.times) for one in wanted), len(wanted)), wanted[0].times[0])
        for place, one in enumerate(wanted):
            times[: len(one.times), place] = one.times
        arms, R_bs = self._lever_arms[columns], self._R_bs[columns]
        state = self._motion.module_state(self._segments[columns], times)
        values = sense(state, arms, R_bs, self._gravity, self._magnetic_field)
        whole = Sensed(
            values.specific_force,
            values.angular_rate,
            values.magnetic_field,
            state.R_wb @ R_bs,
            state.joint_position + (state.R_wb @ arms[..., None])[..., 0],
        )
        return [
            Sensed(*(array[: len(one.times), place] for array in whole)) for place, one in enumerate(wanted)
        ]
