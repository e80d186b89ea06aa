"""A whole trial of a fitted subject, with gaps bridged from both sides. Offline: it wants all frames.

The streaming method goes first. What it cannot know is how joints turned while too few markers were seen: it
holds them, and they jump when the markers come back. So every joint's rotation is smoothed over the trial by
what the markers showed of it, and every frame solved once more with its joints drawn to that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from gateway.body.markers import BodyMarkers
from gateway.body.skeleton import Skeleton
from gateway.frames import IntArray, MarkerFrame, SkeletonFrame
from gateway.reconstruction.optical.joint_smoothing import (
    Seen,
    from_turns,
    information,
    joint_turns,
    smoothed_turns,
)
from gateway.reconstruction.optical.pose_solver import HELD_SIGMA, Pose
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor

Progress = Callable[[int, int], None]

BRIDGED_SIGMA = np.radians(5.0)
"""How far a joint may be from where it was smoothed to before that counts, rad."""


def solve_both_ways(
    skeleton: Skeleton,
    markers: BodyMarkers,
    frames: Sequence[MarkerFrame],
    progress: Progress | None = None,
) -> tuple[list[SkeletonFrame], Counter[str]]:
    """All frames, and what was put right. Frames without a pose of their own stay as the streaming method has
    them."""
    forward = OpticalReconstructor(skeleton, markers)
    poses: list[Pose | None] = []
    solved: list[SkeletonFrame] = []
    for index, observation in enumerate(frames):
        solved.append(forward.update(observation))
        poses.append(None if forward.last is None else forward.pose)
        if progress is not None:
            progress(index, 2 * len(frames))
    known = [f for f, pose in enumerate(poses) if pose is not None]
    if not known:
        return solved, forward.counts
    parents = forward.model.parents
    first, last = known[0], known[-1] + 1
    times = np.array([each.time_ns for each in frames[first:last]]) * 1e-9
    turns = smoothed_turns(times - times[0], [_seen(parents, pose) for pose in poses[first:last]])
    again = OpticalReconstructor(skeleton, markers)
    for f in known:
        pose, fit = poses[f], solved[f].markers
        assert pose is not None
        assert fit is not None
        held = from_turns(parents, turns[f - first])
        solved[f] = again.solve_again(frames[f], fit, held, pose.root, BRIDGED_SIGMA**-2)
        if progress is not None:
            progress(len(frames) + f, 2 * len(frames))
    return solved, forward.counts


def _seen(parents: IntArray, pose: Pose | None) -> Seen | None:
    if pose is None or not np.isfinite(pose.factor).all():
        return None
    told = information(parents, pose.R, pose.factor, HELD_SIGMA**-2)
    return Seen(joint_turns(parents, pose.R), told)
