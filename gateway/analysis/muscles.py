"""Tensions and activities of muscles over an analysed motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gateway.analysis.analysing import Analysis
from gateway.analysis.muscle_curves import force_shares
from gateway.analysis.muscle_model import muscle_model
from gateway.analysis.muscle_paths import MusclePaths, absent_segments
from gateway.analysis.muscle_settings import MuscleCosts, plain_costs
from gateway.analysis.tension import TensionSolver
from gateway.body.anthropometry import SIDES
from gateway.body.inertia import part_name
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray

Progress = Callable[[int, int], None]
ASKED = {"thorax": 3, "thigh": 3, "shank": 1, "foot": 2}
"""How many of a joint's angles muscles move, by its distal segment: a knee's ligaments take what would bend
it sideways or twist it, the bones of the ankle what would twist it."""
_FRAMES_A_REPORT = 16


@dataclass(frozen=True)
class MuscleResult:
    """F instants of W muscles, and the R torques that they were asked for."""

    names: tuple[str, ...]
    largest_force: FloatArray  # (W,) N, at the best length
    share: FloatArray  # (F, W) of it that the muscle has at its length and speed; 1 without curves
    activity: FloatArray  # (F, W) tension over largest force, 0 to 1
    paths: tuple[tuple[FloatArray, ...], ...]
    """For each instant and muscle its points (n, 3) m in the world."""
    torques: tuple[tuple[int, int], ...]
    """(joint, angle) of what muscles were asked for."""
    arms: FloatArray  # (F, R, W) m
    left: FloatArray  # (F, R) N m that no muscle gives

    @property
    def tension(self) -> FloatArray:
        """(F, W) N."""
        tension: FloatArray = self.activity * self.largest_force * self.share
        return tension


def muscle_torques(skeleton: Skeleton) -> tuple[tuple[int, int], ...]:
    """Return (joint, angle) of the torques that muscles of legs and trunk are asked for, by ``ASKED``. Raises
    ``GatewayError`` for a body without them."""
    chosen = []
    names = skeleton.segment_names
    for j, joint in enumerate(skeleton.joints):
        is_whole = joint.proximal < 0 or names[joint.proximal] != "t12"  # pelvis to thorax, not one vertebra
        if is_whole:
            count = ASKED.get(part_name(names[joint.distal]), 0)
            chosen += [(j, k) for k in range(min(count, len(joint.angles)))]
    if not chosen:
        raise GatewayError(f"body '{skeleton.name}' has no joints that muscles of legs and trunk move")
    return tuple(chosen)


def has_muscles(skeleton: Skeleton) -> bool:
    """Return whether the body has the segments that the muscles of legs and trunk pull at."""
    return not absent_segments(skeleton)


def find_muscles(
    found: Analysis,
    costs: Callable[[MusclePaths], MuscleCosts] | None = None,
    progress: Progress | None = None,
) -> MuscleResult:
    """Return what muscles would make the torques of an analysis.

    costs: of the muscles that the body carries; None: all alike.

    Raises ``GatewayError`` for a body without legs, or without the extra ``biomech``.
    """
    paths = MusclePaths(found.skeleton, muscle_model())
    asked = muscle_torques(found.skeleton)
    frames, names = len(found.time_s), tuple(wire.name for wire in paths.wires)
    chosen = plain_costs(names, frames) if costs is None else costs(paths)
    largest = np.array([wire.peak_force_n for wire in paths.wires]) * chosen.strength
    activity, lengths = np.zeros((2, frames, len(names)))
    arms, left = np.zeros((frames, len(asked), len(names))), np.zeros((frames, len(asked)))
    drawn = []
    knees = knee_flexion(found.skeleton, found.angles)
    for f in range(frames):
        flexion = {side: float(angles[f]) for side, angles in knees.items()}
        paths.place(found.motion.root[f], found.motion.rotation[f], flexion)
        arms[f] = moment_arms(paths, asked, found.dynamics.rotation_wb[f], found.axes[f], flexion)
        lengths[f] = paths.lengths()
        drawn.append(tuple(paths.polylines()))
        if progress is not None and f % _FRAMES_A_REPORT == 0:
            progress(f, 2 * frames)
    share = force_shares(paths, lengths, found.time_s, chosen.curves)
    bias = np.where(chosen.is_force, np.clip(chosen.bias / share, 0.0, 1.0), chosen.bias)
    solver = TensionSolver(largest, len(asked), chosen.weight[0])
    for f in range(frames):
        wanted = np.array([found.torques[f, j, k] for j, k in asked])
        activity[f], left[f] = solver.solve(arms[f] * share[f], wanted, bias[f], chosen.weight[f])
        if progress is not None and f % _FRAMES_A_REPORT == 0:
            progress(frames + f, 2 * frames)
    return MuscleResult(
        names=names,
        largest_force=largest,
        share=share,
        activity=activity,
        paths=tuple(drawn),
        torques=asked,
        arms=arms,
        left=left,
    )


def moment_arms(
    paths: MusclePaths,
    asked: tuple[tuple[int, int], ...],
    rotation_wb: FloatArray,
    axes: FloatArray,
    flexion: dict[str, float],
) -> FloatArray:
    """Return (R, W) m: the work of each wire's newton on each angle, in the posture that paths are in.

    asked: of ``muscle_torques``. rotation_wb: (S, 3, 3). axes: (J, 3, 3) of the angles, world. flexion: of
    the knees by side, rad.
    """
    rows = []
    names = paths.skeleton.segment_names
    for j, k in asked:
        joint = paths.skeleton.joints[j]
        row = paths.moments(joint.distal) @ (rotation_wb[joint.distal].T @ axes[j, k])
        side = next((side for side in SIDES if names[joint.distal] == f"{side}shank"), None)
        if side is not None and k == 0:
            row = row + paths.patella_moments(side, flexion[side])
        rows.append(row)
    return np.stack(rows)


def knee_flexion(skeleton: Skeleton, angles: FloatArray) -> dict[str, FloatArray]:
    """Return (F,) rad of the knees' flexion by side, of all angles (F, J, 3)."""
    names = skeleton.segment_names
    return {
        side: angles[:, j, 0]
        for j, joint in enumerate(skeleton.joints)
        for side in SIDES
        if names[joint.distal] == f"{side}shank"
    }
