"""How near a robot comes to recorded people, whether it keeps its limits, and what a pose costs.

What the makers' own filters found of a person, at 100 Hz, is solved onto iCub.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import icub_models
import numpy as np

from benchmarks.figures import Figure, table
from benchmarks.joint_recordings import HIPOSE_STILL_S, QMT_STILL_S, as_segments, dressed, facing_of, read_qmt
from benchmarks.never_worse.recordings import DATA
from devices.emulators.data_sets import read_hipose_mtw17
from devices.recorded_tracks import RecordedTracks
from gateway.body.retargeting import Retargeter, RobotPose
from gateway.body.robot import load_robot
from gateway.body.skeleton import Skeleton
from gateway.emulation.recordings import reference_at
from gateway.frames import FloatArray, SkeletonFrame

RATE_HZ = 100.0
SETTLED_S = 1.0
"""A robot begins in its own posture and may turn no faster than its rates."""
_STILL = {"hipose_mtw17": HIPOSE_STILL_S, "qmt_fullbody16": QMT_STILL_S}


class Followed(NamedTuple):
    """One recording on the robot."""

    name: str
    errors: FloatArray
    """Of all links and poses, degrees."""
    at_limit: float
    """Share of poses with a joint at a limit."""
    violations: int
    """Angles beyond limits, and turns faster than rates."""
    ms: FloatArray
    """Processor time of each pose."""


def figures() -> tuple[list[Figure], list[str]]:
    """Figures and tables; both empty without the recordings."""
    found = [_followed(recording) for recording in _recordings()]
    if not found:
        return [], []
    ms = np.concatenate([one.ms for one in found])
    violations = sum(one.violations for one in found)
    worst = max(float(np.mean(one.errors)) for one in found)
    rows = [
        [
            one.name,
            str(len(one.ms)),
            f"{np.median(one.errors):.1f} / {np.mean(one.errors):.1f} / {np.percentile(one.errors, 95):.1f}",
            f"{100 * one.at_limit:.0f} %",
            str(one.violations),
            f"{np.median(one.ms):.2f} / {np.percentile(one.ms, 99):.2f}",
        ]
        for one in found
    ]
    heads = ["recording", "poses", "error °, median / mean / 95 %", "a joint at its limit",
             "limits or rates broken", "ms a pose, median / 99 %"]  # fmt: skip
    what = "links of iCub from where they should be, mean, the worse of the recorded people"
    return [
        Figure("robot_error_deg", worst, "°", "", what),
        Figure("robot_violations", violations, "", "<=0", "angles beyond limits, and turns above rates"),
        Figure("robot_ms", float(np.median(ms)), "ms", "<=2", "processor time of one pose on 32 joints"),
    ], ["## iCub follows recorded people\n\n" + table(heads, rows)]


def _recordings() -> Iterator[RecordedTracks]:
    for read, path in (
        (read_hipose_mtw17, DATA / "hipose_mtw17"),
        (read_qmt, DATA / "qmt_fullbody16" / "full_body_example_data.mat"),
    ):
        if path.exists():
            yield read(path)
        else:
            print(f"skipped: {path} is not there")


def _followed(recording: RecordedTracks) -> Followed:
    skeleton = dressed(recording).skeleton
    robot = load_robot("icub", skeleton, Path(icub_models.get_model_file("iCubGazeboV2_7")))
    solver = Retargeter(robot, skeleton)
    poses: list[RobotPose] = []
    ms = []
    for frame in _frames(recording, skeleton):
        begun = time.process_time()
        pose = solver.solve(frame)
        ms.append(1e3 * (time.process_time() - begun))
        if pose is not None:
            poses.append(pose)
    angles = np.array([pose.angles for pose in poses])
    low, high = robot.limits.T
    fastest = robot.rates * (1 + 1e-9) / RATE_HZ
    beyond = (angles < low) | (angles > high)
    too_fast = np.abs(np.diff(angles, axis=0)) > fastest
    errors = np.degrees([pose.errors for pose in poses[round(SETTLED_S * RATE_HZ) :]])
    return Followed(
        recording.name,
        errors[np.isfinite(errors)],
        float(np.mean(((angles == low) | (angles == high)).any(axis=1))),
        int(beyond.sum() + too_fast.sum()),
        np.array(ms),
    )


def _frames(recording: RecordedTracks, skeleton: Skeleton) -> Iterator[SkeletonFrame]:
    """Yield the person as the makers' filter found it, axes of modules turned to those of segments."""
    n = skeleton.n_segments
    times = np.arange(recording.references[0].times[0], recording.references[0].times[-1], 1 / RATE_HZ)
    q_ref = np.full((len(times), n, 4), np.nan)
    for reference in recording.references:
        q_ref[:, skeleton.index(reference.name)] = reference_at(times, reference)
    still = _STILL[recording.name]
    is_still = (times >= still[0]) & (times <= still[1])
    q_wb = as_segments(q_ref, is_still, facing_of(q_ref, is_still, skeleton), skeleton)
    zeros, nowhere = np.zeros((n, 3)), np.full((n, 3), np.nan)
    for k, turns in enumerate(q_wb):
        yield SkeletonFrame(
            k, round(k * 1e9 / RATE_HZ), turns, zeros, zeros, nowhere, np.zeros(n), np.zeros(n, np.uint8), 0
        )
