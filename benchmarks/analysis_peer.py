"""OpenSim beside our analysis: the same body, motion, floor forces and wires in its inverse dynamics and its
static optimisation, in a Python of its own."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.analysis_opensim_task import coordinate_names, euler_angles, straight, task_of
from benchmarks.opensim_peer import OpenSimMissingError, interpreter
from gateway.analysis.analysing import Analysis
from gateway.analysis.muscles import MuscleResult, find_muscles
from gateway.frames import FloatArray

CHILD = Path(__file__).with_name("analysis_opensim_child.py")
LEGS = ("thorax", *(f"{side}_{part}" for side in ("left", "right") for part in ("thigh", "shank", "foot")))
_LONGEST_S = 900
_AT_WORK = 0.05


@dataclass(frozen=True)
class Peer:
    """What OpenSim made of the same."""

    torque_rmse: float
    """N m, all torques of the legs and the spine."""
    static_optimisation_ms: float
    muscles: dict[str, tuple[float, float, float, float]]
    """By muscle: correlation, RMSE of activity, largest activity of OpenSim's and of ours."""
    note: str


def opensim_beside(found: Analysis, begin: int, end: int) -> Peer | str:
    """What OpenSim makes of the frames from begin to before end; or why it was not asked."""
    try:
        program = interpreter()
    except OpenSimMissingError as missing:
        return f"{missing}."
    muscles = find_muscles(found, model=straight())
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
    return _compared(found, muscles, begin, end, answer)


def _compared(found: Analysis, muscles: MuscleResult, begin: int, end: int, answer: dict[str, Any]) -> Peer:
    frames = slice(begin, end)
    at = np.array(answer["torques"]["time"])
    wrong = []
    for name in LEGS:
        ours = _about_gimbal_axes(found, name)[frames]
        for k, column in enumerate(coordinate_names(name)):
            theirs = np.interp(found.time_s[frames], at, answer["torques"][f"{column}_moment"])
            wrong.append(ours[:, k] - theirs)
    compared = {}
    at = np.array(answer["forces"]["time"])
    for i, name in enumerate(muscles.names):
        ours = np.interp(at, found.time_s, muscles.activity[:, i])
        theirs = np.array(answer["forces"][name]) / muscles.largest_force[i]
        if max(ours.max(), theirs.max()) > _AT_WORK:
            r = float(np.corrcoef(ours, theirs)[0, 1])
            error = float(np.sqrt(np.mean((ours - theirs) ** 2)))
            compared[name] = (r, error, float(theirs.max()), float(ours.max()))
    note = (
        f"OpenSim {answer['version']}; the left foot's step on its plate; the same body, motion, floor "
        f"forces and {len(muscles.names)} straight wires as ideal pullers (no bodies to slide over, no "
        f"force-length curves in either), squared activity. Inverse dynamics of {end - begin} frames, "
        f"optimisation of {len(at)}, at push-off. Shown are muscles that reach an activity of {_AT_WORK:g}."
    )
    return Peer(float(np.sqrt(np.mean(np.square(wrong)))), 1e3 * answer["force_s"] / len(at), compared, note)


def _about_gimbal_axes(found: Analysis, segment: str) -> FloatArray:
    """(F, 3) N m of a joint's moment along its axes x of the parent, y between, z of the segment."""
    s = found.skeleton.index(segment)
    turned = found.dynamics.rotation_wb
    parent = turned[:, found.skeleton.parents[s]]
    first = Rotation.from_euler("x", euler_angles(found)[:, s, :1]).as_matrix()
    axes = np.stack([parent[..., 0], (parent @ first)[..., 1], turned[:, s, :, 2]], axis=1)
    along: FloatArray = np.einsum("fki,fi->fk", axes, found.dynamics.moment[:, s])
    return along
