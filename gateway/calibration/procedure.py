"""What the wearer is asked to do, and what each step shows of which segment.

Movements turn segments about their z axis, which points to the right (ISB); segments are known by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from devices.calibration_script import GET_READY_S, STEPS
from gateway.body.skeleton import Skeleton
from gateway.errors import GatewayError
from gateway.frames import FloatArray

__all__ = ["GET_READY_S", "PROCEDURE", "Step", "StepKind", "pose_rotation", "procedure_for"]


class StepKind(Enum):
    """What a step is evaluated for."""

    POSE = "pose"
    MOVEMENT = "movement"
    """About one axis."""
    FREE = "free"
    """About all of them: joint centres."""


@dataclass(frozen=True)
class Step:
    """One thing to do."""

    name: str
    kind: StepKind
    seconds: float
    instruction: str
    turns: Mapping[str, int] = field(default_factory=dict)
    """For movements: segments that turn about their z axis, and the sign of the turn they begin with."""


_TRUNK = dict.fromkeys(("pelvis", "thorax", "head", "left_shoulder_girdle", "right_shoulder_girdle"), -1)
_ARMS = {f"{side}_{part}": 1 for side in ("left", "right") for part in ("upper_arm", "forearm", "hand")}
_SECONDS = dict(STEPS)


def _leg(side: str) -> dict[str, int]:
    return {f"{side}_{part}": 1 for part in ("thigh", "shank", "foot")}


PROCEDURE: tuple[Step, ...] = (
    Step(
        "n_pose",
        StepKind.POSE,
        _SECONDS["n_pose"],
        "stand upright and still, feet parallel and a hip's width apart, arms hanging, palms to the thighs",
    ),
    Step(
        "t_pose",
        StepKind.POSE,
        _SECONDS["t_pose"],
        "the same with both arms spread out level, palms down; still again",
    ),
    Step(
        "squat",
        StepKind.MOVEMENT,
        _SECONDS["squat"],
        "twice down into the knees and up again, the whole trunk and head leaning forward with it",
        _TRUNK,
    ),
    Step(
        "left_leg",
        StepKind.MOVEMENT,
        _SECONDS["left_leg"],
        "the stretched left leg forward, then the left knee up, and both again; straight ahead",
        _leg("left"),
    ),
    Step(
        "right_leg",
        StepKind.MOVEMENT,
        _SECONDS["right_leg"],
        "the same with the right leg",
        _leg("right"),
    ),
    Step(
        "arms",
        StepKind.MOVEMENT,
        _SECONDS["arms"],
        "both stretched arms twice forward and up, parallel, palms to each other",
        _ARMS,
    ),
    Step(
        "free",
        StepKind.FREE,
        _SECONDS["free"],
        "everything, briskly: circle hips, shoulders, arms; bend elbows, wrists, trunk, head; swing the legs",
    ),
)
"""In the order in which they are done; any can be left out or done again."""


def procedure_for(skeleton: Skeleton) -> tuple[Step, ...]:
    """Return the steps that are of use for this body. Raises ``GatewayError`` for other bodies."""
    names = set(skeleton.segment_names)
    if not names & {segment for step in PROCEDURE for segment in step.turns}:
        raise GatewayError(
            f"body '{skeleton.name}' has no segment that these movements turn: they are for people"
        )
    has_arms = any(name.endswith("upper_arm") for name in names)
    return tuple(
        step
        for step in PROCEDURE
        if (step.kind is not StepKind.MOVEMENT or names & set(step.turns))
        and (step.name != "t_pose" or has_arms)
    )


def pose_rotation(step: str, segment: str) -> FloatArray:
    """Return (3,) rotation vector, segment axes, from the neutral posture to a pose, rad."""
    part = segment.partition("_")[2]
    if step == "t_pose" and part in ("upper_arm", "forearm", "hand"):
        return np.array([np.pi / 2 if segment.startswith("left") else -np.pi / 2, 0.0, 0.0])
    return np.zeros(3)
