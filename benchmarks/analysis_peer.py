"""OpenSim beside our analysis: the same body, motion, floor forces and wires in its inverse dynamics and its
static optimisation, in a Python of its own."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.analysis_opensim_task import arms_at, coordinate, coordinate_names, gimbal_axes, task_of
from benchmarks.opensim_peer import OpenSimMissingError, interpreter
from gateway.analysis.analysing import Analysis
from gateway.analysis.muscles import MuscleResult
from gateway.analysis.tension import RESERVE_N_M
from gateway.frames import FloatArray

CHILD = Path(__file__).with_name("analysis_opensim_child.py")
LEGS = ("thorax", *(f"{side}_{part}" for side in ("left", "right") for part in ("thigh", "shank", "foot")))
_LONGEST_S = 1800
AT_WORK = 0.05
"""Muscles of less activity throughout are not shown."""
_HAS_ARM_M = 0.002
_AS_LOW = 1.05
"""Of our cost: an optimum that is not farther above it counts as found."""


@dataclass(frozen=True)
class Agreement:
    """Of two series."""

    r: float
    rmse: float
    theirs: float
    """Largest of OpenSim's."""
    ours: float


@dataclass(frozen=True)
class ArmAgreement:
    """Of the moment arms of all muscles that have one at an angle."""

    count: int
    rmse_mm: float
    worst_mm: float
    worst: str
    """The muscle that differs most, RMS."""


@dataclass(frozen=True)
class Peer:
    """What OpenSim made of the same."""

    version: str
    frames: int
    """That were optimised."""
    solved: int
    """Of them, in how many OpenSim came as low as we did: elsewhere its optimiser stopped short."""
    torque_rmse: float
    """N m, all torques of the legs and the spine."""
    static_optimisation_ms: float
    all_rmse: float
    """Of activity, all muscles, all frames."""
    all_r: float
    activity_rmse: float
    """All muscles, frames that OpenSim solved."""
    activity_r: float
    muscles: dict[str, Agreement]
    """In frames that OpenSim solved."""
    arms: dict[str, ArmAgreement]
    """By angle."""


def opensim_beside(found: Analysis, muscles: MuscleResult, begin: int, end: int) -> Peer | str:
    """What OpenSim makes of the frames from begin to before end; or why it was not asked."""
    try:
        program = interpreter()
    except OpenSimMissingError as missing:
        return f"{missing}."
    with TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "task.json").write_text(json.dumps(task_of(found, muscles, begin, end)))
        done = subprocess.run(
            [program, "-I", str(CHILD), folder],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=_LONGEST_S,
        )
        if done.returncode:
            return f"it ended with {done.returncode}: {(done.stderr or done.stdout).strip()[-400:]}"
        answer = json.loads((place / "answer.json").read_text())
    at = np.array(answer["forces"]["time"])
    ours = np.stack([np.interp(at, found.time_s, column) for column in muscles.activity.T], axis=1)
    theirs = np.stack([answer["forces"][name] for name in muscles.names], axis=1) / muscles.largest_force
    left = np.stack([np.interp(at, found.time_s, column) for column in muscles.left.T], axis=1)
    is_solved = _cost(theirs, _helped(found, muscles, answer["forces"])) < _AS_LOW * _cost(ours, left)
    a, b = ours[is_solved], theirs[is_solved]
    return Peer(
        answer["version"], len(at), int(is_solved.sum()),
        _torque_rmse(found, begin, end, answer["torques"]), 1e3 * answer["force_s"] / len(at),
        _rms(ours - theirs), _r(ours, theirs), _rms(a - b), _r(a, b), _activities(muscles, a, b),
        _arms(found, muscles, arms_at(begin, end), answer["arms"]),
    )  # fmt: skip


def _torque_rmse(found: Analysis, begin: int, end: int, torques: dict[str, list[float]]) -> float:
    frames, at = slice(begin, end), np.array(torques["time"])
    wrong = []
    for segment in LEGS:
        s = found.skeleton.index(segment)
        ours = np.einsum("fki,fi->fk", gimbal_axes(found, s), found.dynamics.moment[:, s])[frames]
        for k, column in enumerate(coordinate_names(found, s)):
            wrong.append(ours[:, k] - np.interp(found.time_s[frames], at, torques[f"{column}_moment"]))
    return _rms(np.array(wrong))


def _cost(activity: FloatArray, left: FloatArray) -> FloatArray:
    """(F,) what both programs minimise: squared activities, and squared torques left over, N m."""
    cost: FloatArray = np.sum(activity**2, axis=1) + np.sum((left / RESERVE_N_M) ** 2, axis=1)
    return cost


def _helped(found: Analysis, muscles: MuscleResult, forces: dict[str, list[float]]) -> FloatArray:
    """(F, R) N m that OpenSim left to something else than muscles."""
    columns = [forces[f"{coordinate(found, j, k)}_left"] for j, k in muscles.torques]
    return np.array(columns).T


def _activities(muscles: MuscleResult, ours: FloatArray, theirs: FloatArray) -> dict[str, Agreement]:
    """Of the muscles that work in either."""
    compared = {}
    for i, name in enumerate(muscles.names):
        a, b = ours[:, i], theirs[:, i]
        if max(a.max(), b.max()) > AT_WORK:
            r = float(np.corrcoef(a, b)[0, 1])
            compared[name] = Agreement(r, _rms(a - b), float(b.max()), float(a.max()))
    return compared


def _arms(
    found: Analysis, muscles: MuscleResult, frames: list[int], columns: dict[str, dict[str, list[float]]]
) -> dict[str, ArmAgreement]:
    """Of all muscles that reach ``_HAS_ARM_M``, by angle."""
    compared = {}
    for row, (j, k) in enumerate(muscles.torques):
        joint = found.skeleton.joints[j]
        angle = joint.angles[k]
        ours = muscles.arms[frames, row]
        theirs = angle.sign * np.array([columns[name][coordinate(found, j, k)] for name in muscles.names]).T
        has = np.abs(np.stack([ours, theirs])).max(axis=(0, 1)) > _HAS_ARM_M
        wrong = 1e3 * np.sqrt(np.mean((ours - theirs) ** 2, axis=0))
        worst = int(np.argmax(wrong))
        compared[f"{joint.name} {angle.name}".replace("_", " ")] = ArmAgreement(
            int(has.sum()), _rms(wrong[has]), float(wrong[worst]), muscles.names[worst]
        )
    return compared


def _r(a: FloatArray, b: FloatArray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
