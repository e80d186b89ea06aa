"""Pictures for docs/calibration.md: ``python -m benchmarks.calibration_pictures``. Needs matplotlib.

Stick figures of the emulated wearer in the middle of every step, from the front and from the right.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np

from devices.calibration_script import timetable
from devices.emulators.calibrating import WearerFaults, calibration_motion
from devices.emulators.motions import BodyMotion
from gateway.body.rig import load_rig
from gateway.body.skeleton import Skeleton
from gateway.emulation.rig import dress
from gateway.frames import FloatArray

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


def main() -> None:
    """Write one picture with all steps."""
    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "calibration"  # the same picture, the same file
    from matplotlib import pyplot  # noqa: PLC0415 - after the choice of where it draws

    suit = load_rig("suit_17")
    motion = calibration_motion(dress(suit), 1, 0.0, WearerFaults(pose_error=0.0))
    figure, axes = pyplot.subplots(2, len(_MOMENTS), figsize=(14, 5.6), sharex=True, sharey=True)
    for column, (step, moments) in enumerate(_MOMENTS.items()):
        for k, moment in enumerate(moments):
            grey = "black" if k == len(moments) - 1 else str(0.8 - 0.25 * k)
            for row, across in enumerate((1, 0)):  # facing east: from the front y, from the side x
                for line in _lines(motion, suit.skeleton, step, moment):
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


def _lines(motion: BodyMotion, skeleton: Skeleton, step: str, moment: float) -> list[FloatArray]:
    """Two points of every segment, world, m."""
    begin, end = timetable()[step]
    state = motion.state([begin + moment * (end - begin)])
    starts = state.joint_position[0]
    ends = starts + np.einsum("sij,sj->si", state.R_wb[0], skeleton.tips)
    joints = [
        np.stack([starts[parent], starts[n]]) for n, parent in enumerate(skeleton.parents) if parent >= 0
    ]
    return [np.stack(pair) for pair in zip(starts, ends, strict=True)] + joints


if __name__ == "__main__":
    main()
