"""OpenSim's inverse kinematics on the gateway's own body and markers, as a yardstick of time and error.

OpenSim lives in an environment of its own (its wheels hold their own numpy). ``MOCAP_OPENSIM`` names that
environment's Python interpreter; without it, this one is tried. Make one with::

    python3.11 -m venv opensim && opensim/bin/pip install opensim
    MOCAP_OPENSIM=$PWD/opensim/bin/python python -m benchmarks speed
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray
from gateway.reconstruction.optical.pose_solver import FREE_SIGMA, body_model

VARIABLE = "MOCAP_OPENSIM"
ACCURACY = 1e-5
"""Of the assembly, OpenSim's own default for inverse kinematics."""
_CHILD = Path(__file__).with_name("opensim_child.py")
_LONGEST_S = 900.0


class OpenSimMissingError(RuntimeError):
    """There is no interpreter that imports OpenSim; the message says what was tried."""


@dataclass(frozen=True)
class OpenSimSolution:
    """What OpenSim found, in the gateway's world and axes."""

    R: FloatArray
    """(F, S, 3, 3) segment to world."""
    p_w: FloatArray
    """(F, S, 3) proximal joints, m."""
    residuals: FloatArray
    """(F, M) m, distance of measured and virtual marker; NaN: not seen."""
    ms: float
    """Processor time a frame, of the solver alone: no files, no model building, no first assembly."""
    version: str

    @property
    def rmse(self) -> float:
        """m, of all markers seen."""
        return float(np.sqrt(np.nanmean(self.residuals**2)))


def interpreter() -> str:
    """The Python that imports OpenSim. Raises ``OpenSimMissingError``."""
    named = os.environ.get(VARIABLE)
    tried = named or sys.executable
    complaint = _complaint(tried)
    if complaint is None:
        return tried
    where = f"{VARIABLE}={named}" if named else f"{VARIABLE} is not set, and this Python"
    raise OpenSimMissingError(f"{where}: {complaint}")


@cache
def _complaint(python: str) -> str | None:
    """Why that interpreter will not do, or None."""
    command = [python, "-I", "-c", "import numpy, opensim"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120.0, check=False)
    except OSError as error:
        return f"not a Python interpreter ({error.strerror})"
    except subprocess.TimeoutExpired:
        return "importing opensim took more than two minutes"
    return None if done.returncode == 0 else (done.stderr.strip().splitlines() or ["no message"])[-1]


def solve(skeleton: Skeleton, markers: BodyMarkers, observed: FloatArray, rate_hz: float) -> OpenSimSolution:
    """Every frame by OpenSim's ``InverseKinematicsSolver``, each begun from the one before.

    The model is the fitted body: the same lengths, the same places of markers, weights 1/σ². A joint turns
    about the angles it is free about (a knee about one), in the order of its Cardan angles; limits are not
    enforced.

    observed: (F, M, 3) m, world, in the order of ``markers``; NaN rows for markers not seen.
    Raises ``OpenSimMissingError``, and ``RuntimeError`` with OpenSim's last line where it fails.
    """
    python = interpreter()
    with tempfile.TemporaryDirectory() as folder:
        case, answer = Path(folder) / "case.npz", Path(folder) / "answer.npz"
        np.savez(case, allow_pickle=False, **_case(skeleton, markers, observed, rate_hz))
        done = subprocess.run(
            [python, "-I", str(_CHILD), str(case), str(answer)],
            cwd=folder, capture_output=True, text=True, timeout=_LONGEST_S, check=False,
        )  # fmt: skip
        if done.returncode != 0 or not answer.is_file():
            last = ((done.stderr or done.stdout).strip().splitlines() or ["no message"])[-1]
            raise RuntimeError(f"OpenSim gave up: {last}")
        with np.load(answer) as found:
            R, p_w = found["R"], found["p"]
            ms, version = float(found["ms"]), str(found["version"])
    virtual = p_w[:, markers.segments] + np.einsum("fmij,mj->fmi", R[:, markers.segments], markers.positions)
    return OpenSimSolution(R, p_w, np.linalg.norm(observed - virtual, axis=2), ms, version)


def _case(
    skeleton: Skeleton, markers: BodyMarkers, observed: FloatArray, rate_hz: float
) -> dict[str, FloatArray]:
    """All arrays that the child needs; axes and freedoms of every segment's joint by segment."""
    model, n = body_model(skeleton, markers), skeleton.n_segments
    axes, free = np.zeros((n, 3), dtype=np.int64), np.zeros((n, 3), dtype=np.bool_)
    axes[model.distals] = model.axes
    free[model.distals] = model.stiffness <= FREE_SIGMA**-2
    weights = markers.sigmas**-2
    return {
        "parents": skeleton.parents,
        "offsets": skeleton.offsets,
        "axes": axes,
        "free": free,
        "segments": markers.segments,
        "positions": markers.positions,
        "weights": weights / weights.mean(),
        "observed": observed,
        "times": np.arange(len(observed)) / rate_hz,
        "accuracy": np.array(ACCURACY),
    }
