"""OpenSim beside our analysis: the same body, motion, floor forces and wires in its inverse dynamics and its
static optimisation, in a Python of its own."""

from __future__ import annotations

import os
from dataclasses import dataclass

from gateway.analysis.analysing import Analysis
from gateway.analysis.muscles import MuscleResult

PYTHON = "OPENSIM_PYTHON"
"""Environment variable: a Python that has OpenSim 4.6."""


@dataclass(frozen=True)
class Peer:
    """What OpenSim made of the same."""

    torque_rmse: float
    """N m, all torques of the legs and the spine."""
    static_optimisation_ms: float
    muscles: dict[str, tuple[float, float, float, float]]
    """By muscle: correlation, RMSE of activity, largest activity of OpenSim's and of ours."""
    note: str


def opensim_beside(found: Analysis, muscles: MuscleResult) -> Peer | str:
    """What OpenSim makes of it; or why it was not asked."""
    program = os.environ.get(PYTHON)
    if not program:
        return f"{PYTHON} does not name a Python with OpenSim."
    return "pending"
