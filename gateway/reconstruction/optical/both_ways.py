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
    SeenPlace,
    from_turns,
    information,
    joint_turns,
    markers_covariance,
    smoothed_places,
    smoothed_turns,
)
from gateway.reconstruction.optical.pose_solver import HELD_SIGMA, Held, Pose
from gateway.reconstruction.optical.reconstructor import OpticalReconstructor

Progress = Callable[[int, int], None]

BRIDGED_SIGMA = np.radians(5.0)
"""How far a joint, or the root, may be from where it was smoothed to before that counts, rad."""
BRIDGED_PLACE_SIGMA = 0.03
"""The same of the root's place, m."""


def solve_both_ways(
    skeleton: Skeleton,
    markers: BodyMarkers,
    frames: Sequence[MarkerFrame],
    progress: Progress | None = None,
) -> tuple[list[SkeletonFrame], Counter[str]]:
    """Return all frames, and what was put right. Before the first frame with a pose and after the last one
    frames stay as the streaming method has them; between them all have a pose, predicted where nothing was
    seen."""
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
    times -= times[0]
    seen = [_seen(parents, pose) for pose in poses[first:last]]
    turns = smoothed_turns(times, [each and each[0] for each in seen])
    places = smoothed_places(times, [each and each[1] for each in seen])
    again = OpticalReconstructor(skeleton, markers)
    for f, turn, place in zip(range(first, last), turns, places, strict=True):
        pose = poses[f]
        held = Held(
            from_turns(parents, turn), BRIDGED_SIGMA**-2, place, BRIDGED_SIGMA**-2, BRIDGED_PLACE_SIGMA**-2
        )
        root = place if pose is None else pose.root
        solved[f] = again.solve_again(frames[f], solved[f].markers, held, root)
        if progress is not None:
            progress(len(frames) + f, 2 * len(frames))
    return solved, forward.counts


def _seen(parents: IntArray, pose: Pose | None) -> tuple[Seen, SeenPlace] | None:
    if pose is None or not np.isfinite(pose.factor).all():
        return None
    covariance = markers_covariance(pose.factor, HELD_SIGMA**-2)
    turns = Seen(joint_turns(parents, pose.R), information(parents, pose.R, covariance))
    return turns, SeenPlace(pose.root, np.asarray(np.linalg.inv(covariance[:3, :3]), np.float64))
