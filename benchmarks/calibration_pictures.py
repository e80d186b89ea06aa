"""Pictures of the steps of a calibration and of the check: ``python -m benchmarks.calibration_pictures``.

Stick figures of the emulated wearer in every step, from the front and from the right: for
docs/guide/calibration.md (needs matplotlib) and, as lines, for the page.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path

import matplotlib as mpl
import numpy as np

from devices.calibration_script import timetable
from devices.emulators.motion.calibrating import WearerFaults, calibration_motion
from devices.emulators.motion.motions import BodyMotion
from gateway.body.kinematics import joint_positions
from gateway.body.rig import load_rig
from gateway.body.skeleton import Skeleton
from gateway.emulation.rig import dress
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.viewer.step_pictures import LINES, SHORTEST_M

FOLDER = Path(__file__).parent.parent / "docs" / "pictures"
_MOMENTS: dict[str, tuple[float, ...]] = {
    "n_pose": (0.5,),
    "t_pose": (0.5,),
    "squat": (0.0, 0.15, 0.27),
    "left_leg": (0.0, 0.14, 0.38),
    "right_leg": (0.0, 0.14, 0.38),
    "arms": (0.0, 0.15, 0.27),
    "free": (0.3, 0.5, 0.7),
}
"""Parts of a step at which the wearer is drawn, the last one darkest."""
_MOVEMENTS: dict[str, Mapping[str, tuple[float, float, float]]] = {
    "move_left_arm": {"left_upper_arm": (0.0, 0.0, 85.0)},
    "move_right_arm": {"right_upper_arm": (0.0, 0.0, 85.0)},
    "move_left_leg": {"left_thigh": (0.0, 0.0, 50.0)},
    "move_right_leg": {"right_thigh": (0.0, 0.0, 50.0)},
    "move_bow": {"pelvis": (0.0, 0.0, -15.0), "thorax": (0.0, 0.0, -40.0), "left_thigh": (0.0, 0.0, 15.0),
                 "right_thigh": (0.0, 0.0, 15.0), "left_upper_arm": (0.0, 0.0, 55.0),
                 "right_upper_arm": (0.0, 0.0, 55.0)},
}  # fmt: skip
"""How a movement of the check ends: turns of segments against their parents, degrees, own axes."""


def main() -> None:
    """Write one picture with all steps, and the lines for the page."""
    suit = load_rig("suit_17")
    motion = calibration_motion(dress(suit), 1, 0.0, WearerFaults(pose_error=0.0))
    drawn = {step: _drawn(motion, suit.skeleton, step) for step in _MOMENTS}
    _write_picture(drawn)
    still = _lines(suit.skeleton, *_posed(suit.skeleton, {}))
    for name, turns in _MOVEMENTS.items():
        drawn[name] = [still, _lines(suit.skeleton, *_posed(suit.skeleton, turns))]
    lines = {
        step: [[_as_numbers(each) for each in moment] for moment in moments]
        for step, moments in drawn.items()
    }
    rows = (f"{json.dumps(step)}: {json.dumps(moments)}" for step, moments in lines.items())
    LINES.write_text("{" + ",\n".join(rows) + "}\n", encoding="utf-8")
    sys.stdout.write(f"written to {LINES}\n")


Line = tuple[str, FloatArray]
"""Segment, and two points, (2, 3) m."""


def _as_numbers(line: Line) -> list[str | float]:
    return [line[0].partition("_")[0], *np.round(line[1], 2).ravel().tolist()]


def _write_picture(drawn: Mapping[str, list[list[Line]]]) -> None:
    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "calibration"  # the same picture, the same file
    from matplotlib import pyplot  # noqa: PLC0415 - after the choice of where it draws

    figure, axes = pyplot.subplots(2, len(drawn), figsize=(14, 5.6), sharex=True, sharey=True)
    for column, (step, moments) in enumerate(drawn.items()):
        for k, moment in enumerate(moments):
            grey = "black" if k == len(moments) - 1 else str(0.8 - 0.25 * k)
            for row, across in enumerate((1, 0)):  # facing east: from the front y, from the side x
                for _, line in moment:
                    axes[row, column].plot(line[:, across], line[:, 2], color=grey, linewidth=2)
        axes[0, column].set_title(step)
    for each, label in zip(axes[:, 0], ("from the front", "from the right"), strict=True):
        each.set_ylabel(label)
    for each in axes.ravel():
        each.set_aspect("equal")
        each.set_xticks([])
        each.set_yticks([])
    figure.tight_layout()
    FOLDER.mkdir(exist_ok=True)
    target = FOLDER / "calibration_steps.svg"
    figure.savefig(target, metadata={"Date": None})
    sys.stdout.write(f"written to {target}\n")


def _drawn(motion: BodyMotion, skeleton: Skeleton, step: str) -> list[list[Line]]:
    """The wearer at the moments of a step."""
    begin, end = timetable()[step]
    states = [motion.state([begin + moment * (end - begin)]) for moment in _MOMENTS[step]]
    return [_lines(skeleton, state.joint_position[0], state.R_wb[0]) for state in states]


def _posed(
    skeleton: Skeleton, turns: Mapping[str, tuple[float, float, float]]
) -> tuple[FloatArray, FloatArray]:
    """The neutral posture with segments turned: joints (s, 3) m, and rotations (s, 3, 3)."""
    q_wb: list[FloatArray] = []
    for name, parent in zip(skeleton.segment_names, skeleton.parents, strict=True):
        turn = quaternion.from_rotation_vector(np.radians(turns.get(name, (0.0, 0.0, 0.0))))
        q_wb.append(quaternion.multiply(skeleton.neutral if parent < 0 else q_wb[parent], turn))
    q = np.array(q_wb)
    rotations = np.array([quaternion.to_matrix(each) for each in q])
    return joint_positions(skeleton.parents, skeleton.offsets, q, np.zeros(3)), rotations


def _lines(skeleton: Skeleton, starts: FloatArray, rotations: FloatArray) -> list[Line]:
    """Two points of every segment, and from joint to joint, world, m; none that is too short to be seen."""
    names = skeleton.segment_names
    ends = starts + np.einsum("sij,sj->si", rotations, skeleton.tips)
    lines = [(name, np.stack(pair)) for name, *pair in zip(names, starts, ends, strict=True)]
    lines += [
        (names[n], np.stack([starts[parent], starts[n]]))
        for n, parent in enumerate(skeleton.parents)
        if parent >= 0
    ]
    return [each for each in lines if np.linalg.norm(each[1][1] - each[1][0]) > SHORTEST_M]


if __name__ == "__main__":
    main()
