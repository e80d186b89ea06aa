"""A suit lying in a box that is put on all its sides and then turned about: for calibrating sensors.

All segments keep the reference posture against each other; the box turns about the root's joint.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from devices.deferred import Rotation
from devices.emulators.bodies import NO_PARENT, EmulatedBody, FloatArray, IntArray
from devices.emulators.motion.kinematics_truth import MotionState
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.motion.waves import waves

REST_S = 2.0
"""In each of the positions of the first part."""
MOVE_S = 1.0
"""From one position to the next."""
TURNS = 60
"""Random turns without rest after the positions; then all begins anew."""

_SIDES = (
    *(("xy", (angle, 0)) for angle in (0, 90, 180, 270)),
    *(("xy", (0, angle)) for angle in (90, 270)),
    *(("xy", (angle, lean)) for lean in (35, -35) for angle in (45, 135, 225, 315)),
)
"""Six sides and eight corners: rotations about x, then y, degrees."""


@dataclass(frozen=True)
class _Schedule:
    """Turns one after another: each begins at its time, from its attitude, about its axis, by its angle."""

    begin: FloatArray  # (K,) s
    attitude: FloatArray  # (K, 3, 3)
    turn: FloatArray  # (K, 3) rotation vector, rad, in axes of the attitude
    period: float


class TumblingMotion(BodyMotion):
    """Positions at rest with turns between them, then turns only; repeats itself."""

    def __init__(self, body: EmulatedBody, seed: int) -> None:
        super().__init__(body, waves(body.n_segments, []))
        self._schedule = _schedule(np.random.default_rng([seed, 7]))
        self._reference = Rotation.from_quat(body.reference_posture, scalar_first=True).as_matrix()
        self._arms = np.zeros((body.n_segments, 3))  # of the joints from the root's, reference posture, world
        for n, parent in enumerate(body.parents):
            if parent != NO_PARENT:
                self._arms[n] = self._arms[parent] + self._reference[parent] @ body.offsets[n]

    def state(self, t: ArrayLike) -> MotionState:
        """Return the state as ``BodyMotion.state`` does."""
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        n = self.body.n_segments
        return self.module_state(np.arange(n), np.broadcast_to(times[:, None], (len(times), n)))

    def module_state(self, segments: IntArray, times: FloatArray) -> MotionState:
        """Return the state as ``BodyMotion.module_state`` does."""
        R, omega, alpha = self._box(np.asarray(times, dtype=np.float64))
        arms, reference = self._arms[segments], self._reference[segments]
        swept = np.cross(omega, arms)
        # Tangential and centripetal acceleration of a point that turns with the box.
        lever = np.cross(alpha, arms) + np.cross(omega, swept)

        def to_world(v: FloatArray) -> FloatArray:
            turned: FloatArray = np.einsum("tmij,tmj->tmi", R, v)
            return turned

        return MotionState(
            R @ reference,
            np.einsum("mji,tmj->tmi", reference, omega),
            np.einsum("mji,tmj->tmi", reference, alpha),
            to_world(np.broadcast_to(arms, omega.shape)),
            to_world(swept),
            to_world(lever),
        )

    def _box(self, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return attitude (T, M, 3, 3), angular rate and acceleration (T, M, 3) in the box's axes."""
        schedule = self._schedule
        at = np.mod(np.maximum(times, 0.0), schedule.period)
        k = np.searchsorted(schedule.begin, at, side="right") - 1
        u = np.clip((at - schedule.begin[k]) / MOVE_S, 0.0, 1.0)[..., None]
        turn = schedule.turn[k]
        # the quintic from 0 to 1 that begins and ends without speed or acceleration
        angle = turn * (u**3 * (10.0 - 15.0 * u + 6.0 * u**2))
        step = Rotation.from_rotvec(angle.reshape(-1, 3)).as_matrix().reshape(*angle.shape, 3)
        rate = turn * (30.0 * u**2 * (1.0 - u) ** 2) / MOVE_S
        acceleration = turn * (60.0 * u * (1.0 - u) * (1.0 - 2.0 * u)) / MOVE_S**2
        return schedule.attitude[k] @ step, rate, acceleration


def _schedule(rng: np.random.Generator) -> _Schedule:
    attitudes = [Rotation.identity()]
    attitudes += [Rotation.from_euler(axes, angles, degrees=True) for axes, angles in _SIDES[1:]]
    rests = [REST_S + MOVE_S] * len(attitudes)
    attitudes += list(Rotation.from_quat(rng.standard_normal((TURNS, 4))))
    rests += [MOVE_S] * TURNS
    first = REST_S  # the turn to attitude k + 1 begins when the rest in attitude k is over
    begin = first + np.concatenate([[0.0], np.cumsum(rests[1:])])
    turns = [
        (a.inv() * b).as_rotvec() for a, b in zip(attitudes, [*attitudes[1:], attitudes[0]], strict=True)
    ]
    return _Schedule(
        begin=np.concatenate([[0.0], begin]),
        attitude=np.stack([np.eye(3), *(attitude.as_matrix() for attitude in attitudes)]),
        turn=np.stack([np.zeros(3), *turns]),
        period=float(begin[-1] + MOVE_S),
    )
