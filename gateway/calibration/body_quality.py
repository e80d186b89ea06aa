"""How good one module's place is known, and what was wrong, in words for the wearer."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from devices.deferred import Rotation
from gateway.body.skeleton import WornSuit
from gateway.calibration.axes import MovementAxis
from gateway.calibration.body_result import ModuleEvidence
from gateway.calibration.body_solver import Solution
from gateway.calibration.procedure import pose_rotation
from gateway.calibration.quality import Quality, QualityAspect, graded, judged
from gateway.frames import FloatArray

STEP_NAMES = {"n_pose": "the N-pose", "t_pose": "the T-pose", "left_leg": "the left leg's step"}
STEP_NAMES |= {"right_leg": "the right leg's step", "arms": "the arms' step", "squat": "the squat"}
STEP_NAMES |= {"free": "the free movement"}

_MOVED = (3.0, 10.0)  # degrees: from good to useless, as all pairs here
_SHAKEN = (0.5, 2.0)  # m/s²
_FIELD = (0.10, 0.35)
_RANGE = (25.0, 10.0)  # degrees
_SPREAD = (6.0, 25.0)  # degrees
_OFF_POSE = (10.0, 35.0)  # degrees
_OFF_POSE_ARMS = (20.0, 50.0)
_JOINT = (0.016, 0.045)  # m
_ROTATION = (3.5, 9.0)  # degrees


def judge_module(
    found: ModuleEvidence, expected: set[str], solution: Solution, segment: int, suit: WornSuit
) -> Quality:
    """Return how well one module is calibrated, with reasons in words.

    expected: names of the movements that were done and should have turned this segment.
    """
    name = found.segment.replace("_", " ")
    findings = [*_presence(found, name), *_still(found, name), *_field(found, name)]
    for step in sorted(expected):
        if step in found.movements:
            findings += _movement(found.movements[step], STEP_NAMES[step], name)
    if np.isfinite(solution.sensor_to_segment[segment]).all():
        findings += _against_poses(found, solution, segment, suit, name)
        findings += _certainty(solution, segment, name)
    return judged(*findings)


def _presence(found: ModuleEvidence, name: str) -> Iterator[QualityAspect]:
    if found.unreceived:
        steps = ", ".join(STEP_NAMES[step] for step in found.unreceived)
        yield QualityAspect(
            0.0, f"module {found.module} ({name}) was not heard during {steps}: is it in reach?"
        )
    else:
        yield QualityAspect(1.0 if found.poses else 0.0, f"{name} was in no pose: do the N-pose with all on")
    if found.has_no_heading:
        yield QualityAspect(
            0.0, f"{name} has neither a steady field nor a movement that tells its heading: do all the steps"
        )


def _still(found: ModuleEvidence, name: str) -> Iterator[QualityAspect]:
    for step, pose in found.poses.items():
        moved = float(np.degrees(pose.moved_rad))
        yield QualityAspect(
            graded(moved, *_MOVED),
            f"{name} moved during {STEP_NAMES[step]} by {moved:.0f}°: stand still, and do it again",
        )
        yield QualityAspect(
            graded(pose.shaken, *_SHAKEN),
            f"{name} was shaken during {STEP_NAMES[step]} ({pose.shaken:.1f} m/s²): is it strapped tightly?",
        )


def _field(found: ModuleEvidence, name: str) -> Iterator[QualityAspect]:
    if found.earth_field is None:
        return
    yield QualityAspect(
        graded(found.earth_field.change, *_FIELD),
        f"the field at {name} changed by {100 * found.earth_field.change:.0f} %: "
        "go away from iron, cables and loudspeakers, or use --no-field",
    )


def _movement(movement: MovementAxis | None, step: str, name: str) -> Iterator[QualityAspect]:
    size = 0.0 if movement is None else float(np.degrees(movement.range_rad))
    yield QualityAspect(
        graded(size, *_RANGE),
        f"the movement of {name} in {step} was too small ({size:.0f}°): at least {_RANGE[0]:.0f}° are needed",
    )
    if movement is not None and size > _RANGE[1]:
        spread = float(np.degrees(movement.spread_rad))
        yield QualityAspect(
            graded(spread, *_SPREAD),
            f"the axis of {name} in {step} was not repeatable ({spread:.0f}° between the repetitions): "
            "move straight forward and back",
        )


def _against_poses(
    found: ModuleEvidence, solution: Solution, segment: int, suit: WornSuit, name: str
) -> Iterator[QualityAspect]:
    neutral = Rotation.from_rotvec([0, 0, solution.facing]) * Rotation.from_quat(
        suit.skeleton.neutral, scalar_first=True
    )
    R_bs = Rotation.from_quat(solution.sensor_to_segment[segment], scalar_first=True)
    own = Rotation.from_rotvec([0, 0, solution.headings[segment]])
    for step, pose in found.poses.items():
        turn: FloatArray = pose_rotation(step, found.segment)
        stood = own * Rotation.from_matrix(pose.R_es) * R_bs.inv()
        off = float(np.degrees(((neutral * Rotation.from_rotvec(turn)).inv() * stood).magnitude()))
        limits = _OFF_POSE_ARMS if turn.any() else _OFF_POSE
        yield QualityAspect(
            graded(off, *limits),
            f"{name} was {off:.0f}° away from {STEP_NAMES[step]} by what the movements say: hold it as drawn",
        )


def _certainty(solution: Solution, segment: int, name: str) -> Iterator[QualityAspect]:
    degrees, metres = np.degrees(solution.rotation_sigma[segment]), float(solution.place_sigma[segment])
    yield QualityAspect(
        graded(float(degrees), *_ROTATION),
        f"the orientation of {name} is uncertain by {degrees:.1f}°: do the movements that turn it",
    )
    yield QualityAspect(
        graded(metres, *_JOINT),
        f"the place of {name} is uncertain by {100 * metres:.1f} cm: do the free movement, about all axes",
    )
