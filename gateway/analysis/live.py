"""Muscles of a motion that still goes on, at reduced detail: the last moment, again and again.

Only what has come is used: the last part of a second, on a grid, goes through the same low-pass and inverse
dynamics as a recording. Floor and muscles are found for one instant of it, ``LAG_S`` before its end, where
the filter has something on both sides.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from gateway.analysis.contact import estimated_floor
from gateway.analysis.inverse_dynamics import Dynamics, inverse_dynamics
from gateway.analysis.joint_torques import angle_axes, joint_torques
from gateway.analysis.muscle_model import muscle_model
from gateway.analysis.muscle_paths import MusclePaths
from gateway.analysis.muscles import knee_flexion, moment_arms, muscle_torques
from gateway.analysis.smooth_motion import DEFAULT_CUTOFF_HZ, SmoothMotion, relative, smooth_motion
from gateway.analysis.tension import TensionSolver
from gateway.body.inertia import body_inertia
from gateway.body.joint_angles import joint_angles
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray

GRID, STEP_S = 41, 0.02
SPAN_S = (GRID - 1) * STEP_S
LAG = 6
LAG_S = LAG * STEP_S
_LONGEST_GAP_S = 0.4
_MOST_KEPT = 1024
GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True)
class LiveActivity:
    """W muscles."""

    time_s: float
    """Instant of the activities: that of the newest pose less ``LAG_S``."""
    activity: FloatArray  # (W,) 0 to 1


class LiveMuscles:
    """Takes poses as they come; tells activities when asked."""

    def __init__(self, skeleton: Skeleton, body_kg: float) -> None:
        """Begin without poses. skeleton: with joints.

        Raises ``GatewayError`` for a body without legs, or without the extra ``biomech``.
        """
        self._skeleton = skeleton
        self._inertia = body_inertia(skeleton, body_kg)
        self._paths = MusclePaths(skeleton, muscle_model())
        self._asked = muscle_torques(skeleton)
        self._largest = np.array([wire.peak_force_n for wire in self._paths.wires])
        self._solver = TensionSolver(self._largest, len(self._asked), np.ones(len(self._largest)))
        self._poses: deque[tuple[float, FloatArray, FloatArray]] = deque(maxlen=_MOST_KEPT)

    def add(self, time_s: float, q_wb: FloatArray, root: FloatArray) -> None:
        """Add a pose: q_wb (S, 4) without NaN, root (3,) m, world. A gap or a jump back begins anew."""
        if self._poses and not 0.0 < time_s - self._poses[-1][0] < _LONGEST_GAP_S:
            if time_s == self._poses[-1][0]:
                return
            self._poses.clear()
        self._poses.append((time_s, q_wb, root))
        while len(self._poses) > 1 and self._poses[1][0] <= time_s - SPAN_S:
            self._poses.popleft()

    def now(self) -> LiveActivity | None:
        """Return the newest activities; None until enough poses have come."""
        if not self._poses or self._poses[0][0] > self._poses[-1][0] - SPAN_S:
            return None
        motion = smooth_motion(self._skeleton, *self._on_grid(), DEFAULT_CUTOFF_HZ)
        reported = slice(GRID - 1 - LAG, None)
        dynamics = self._dynamics(motion, reported)
        angles = joint_angles(self._skeleton, motion.part(reported).orientations())
        axes = angle_axes(self._skeleton, angles, dynamics.rotation_wb)
        torques = joint_torques(self._skeleton, axes, dynamics.moment)
        knees = knee_flexion(self._skeleton, angles)
        then = {side: float(flexion[0]) for side, flexion in knees.items()}
        self._paths.place(motion.root[reported.start], motion.rotation[reported.start], then)
        arms = moment_arms(self._paths, self._asked, dynamics.rotation_wb[0], axes[0], then)
        wanted = np.array([torques[0, j, k] for j, k in self._asked])
        activity, _ = self._solver.solve(arms, wanted, np.zeros(len(self._largest)))
        return LiveActivity(self._poses[-1][0] - LAG_S, activity)

    def wires(self, q_wb: FloatArray, root: FloatArray) -> list[FloatArray]:
        """Return each muscle's points (n, 3) m in a posture q_wb (S, 4), root (3,) m; all in the world."""
        angles = joint_angles(self._skeleton, q_wb[None])
        flexion = {side: float(knee[0]) for side, knee in knee_flexion(self._skeleton, angles).items()}
        self._paths.place(root, relative(self._skeleton, q_wb[None])[0], flexion)
        return self._paths.polylines()

    def _dynamics(self, motion: SmoothMotion, reported: slice) -> Dynamics:
        """Return the dynamics of the instants reported, the first of them with the floor's forces."""
        free = inverse_dynamics(motion, self._inertia, GRAVITY)
        instant = range(reported.start, reported.start + 1)
        floor = estimated_floor(motion, free, instants=instant).part(reported)
        return inverse_dynamics(motion.part(reported), self._inertia, GRAVITY, floor)

    def _on_grid(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return times (GRID,), q_wb (GRID, S, 4), root (GRID, 3), laid between the poses that came."""
        came = np.array([pose[0] for pose in self._poses])
        q_wb = np.array([pose[1] for pose in self._poses])
        flips = np.where(np.sum(q_wb[1:] * q_wb[:-1], axis=-1) < 0.0, -1.0, 1.0)
        q_wb[1:] *= np.cumprod(flips, axis=0)[..., None]
        values = np.concatenate([q_wb.reshape(len(came), -1), [pose[2] for pose in self._poses]], axis=1)
        grid: FloatArray = np.arange(0.0, GRID, dtype=np.float64) * STEP_S
        laid = np.stack([np.interp(grid + came[-1] - SPAN_S, came, column) for column in values.T], axis=1)
        turned: FloatArray = laid[:, :-3].reshape(GRID, -1, 4)
        turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
        places: FloatArray = laid[:, -3:]
        return grid, turned, places
