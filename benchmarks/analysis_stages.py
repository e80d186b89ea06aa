"""Processor time of an analysis by stage."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.analysis_trials import CUTOFF_HZ, GRAVITY, AnalysedTrial
from gateway.analysis.contact import estimated_floor
from gateway.analysis.inverse_dynamics import inverse_dynamics
from gateway.analysis.joint_torques import angle_axes, joint_torques
from gateway.analysis.muscles import MuscleResult, find_muscles
from gateway.analysis.plates import measured_floor
from gateway.analysis.smooth_motion import smooth_motion
from gateway.analysis.tension import TensionSolver
from gateway.body.joint_angles import joint_angles
from gateway.recording.exporters.formats import Axes
from gateway.recording.exporters.take import take_of

_REPEATS = 3


def stage_ms(trial: AnalysedTrial, muscles: MuscleResult) -> dict[str, float]:
    """Milliseconds a frame by stage, the least of three runs."""
    found, inertia = trial.measured, trial.inertia
    take = take_of(trial.arrays, trial.files.name, Axes.Z_UP)
    skeleton, motion, frames = found.skeleton, found.motion, len(found.time_s)
    free = inverse_dynamics(motion, inertia, GRAVITY)
    known = measured_floor(trial.plates, "z", motion, free, CUTOFF_HZ)
    turned = found.dynamics.rotation_wb

    def torques() -> None:
        axes = angle_axes(skeleton, joint_angles(skeleton, motion.orientations()), turned)
        joint_torques(skeleton, axes, found.dynamics.moment)

    stages: dict[str, Callable[[], Any]] = {
        "filters and splines": lambda: smooth_motion(
            skeleton, take.time_s, take.q_wb, take.p_w[:, 0], CUTOFF_HZ
        ),
        "inverse dynamics without the floor": lambda: inverse_dynamics(motion, inertia, GRAVITY),
        "force plates": lambda: measured_floor(trial.plates, "z", motion, free, CUTOFF_HZ),
        "floor forces where none is measured": lambda: estimated_floor(motion, free, known),
        "inverse dynamics with the floor": lambda: inverse_dynamics(motion, inertia, GRAVITY, found.floor),
        "angles and torques about them": torques,
    }
    spent = {name: 1e3 * _least(stage) / frames for name, stage in stages.items()}
    whole = 1e3 * _least(lambda: find_muscles(found)) / frames
    programme = 1e3 * _least(lambda: _solve(found.torques, muscles)) / frames
    return spent | {"wires and moment arms": whole - programme, "quadratic programme": programme}


def _solve(torques: np.ndarray, muscles: MuscleResult) -> None:
    """The programmes alone, of moment arms that are known."""
    count = len(muscles.names)
    solver = TensionSolver(muscles.largest_force, len(muscles.torques), np.ones(count))
    for f, arms in enumerate(muscles.arms):
        solver.solve(arms, np.array([torques[f, j, k] for j, k in muscles.torques]), np.zeros(count))


def _least(stage: Callable[[], Any]) -> float:
    """Seconds."""
    spent = []
    for _ in range(_REPEATS):
        begun = time.process_time()
        stage()
        spent.append(time.process_time() - begun)
    return min(spent)
