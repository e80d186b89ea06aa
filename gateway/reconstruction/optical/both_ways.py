"""A whole trial of a fitted subject, with gaps bridged from both sides. Offline: it wants all frames.

The streaming method goes first. What it cannot know is how joints turned while too few markers were seen,
and where markers are right after it. So all poses are found once more, together; then again, joints drawn to
what they usually do in the trial; names are questioned by what came of it, and the poses found again with
those.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray, MarkerFrame, SkeletonFrame
from gateway.reconstruction.optical.pose_solver import Held, Pose
from gateway.reconstruction.optical.reconstructor import Named, OpticalReconstructor
from gateway.reconstruction.optical.tracking import NEAR
from gateway.reconstruction.optical.usual_posture import unknown_posture, usual_posture
from gateway.reconstruction.optical.whole_motion import bridged, found_together

Progress = Callable[[int, int], None]

BRIDGED_SIGMA = np.radians(5.0)
"""How sure a joint, or the root, is that no marker shows, rad."""
BRIDGED_PLACE_SIGMA = 0.03
"""The same of the root's place, m."""
_WIDE = 0.1
"""Distance at which a marker begins to lose its say while the motion is sought, m."""
_SHORTEST_S = 1e-4
"""Of the times between frames: two of one instant are that far apart."""


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
    named: list[Named] = []
    solved: list[SkeletonFrame] = []
    for index, observation in enumerate(frames):
        solved.append(forward.update(observation))
        fit = forward.last
        poses.append(None if fit is None else forward.pose)
        named.append((observation.positions, ()) if fit is None else (fit.positions, fit.renamed))
        if progress is not None:
            progress(index, 3 * len(frames))
    known = [f for f, pose in enumerate(poses) if pose is not None]
    if not known:
        return solved, forward.counts
    span = slice(known[0], known[-1] + 1)
    steps = np.diff([each.time_ns for each in frames[span]]) * 1e-9
    times_s = np.concatenate([[0.0], np.cumsum(np.maximum(steps, _SHORTEST_S))])
    model, within = forward.model, frames[span]

    def reporting(before: int) -> Callable[[int], None] | None:
        """Return what takes a part's count of frames done, after ``before`` of others."""
        return None if progress is None else lambda count: progress(before + count, 3 * len(frames))

    seen, unknown = _positions(named[span]), unknown_posture(len(model.parents), len(within))
    begun = bridged(model.parents, times_s, poses[span])
    motion = found_together(model, times_s, seen, begun, (_WIDE, NEAR), unknown, reporting(len(frames)))
    usual = usual_posture(model, times_s, seen, motion, NEAR)
    motion = found_together(model, times_s, seen, motion, (NEAR,), usual, reporting(len(frames)))
    again = OpticalReconstructor(skeleton, markers)
    questioned = [again.named(frame, *pose) for frame, *pose in zip(within, *motion, strict=True)]
    seen = _positions(questioned)
    motion = found_together(model, times_s, seen, motion, (NEAR,), usual, reporting(2 * len(frames)))
    for f, R, root, names in zip(range(*span.indices(len(frames))), *motion, questioned, strict=True):
        held = Held(R, BRIDGED_SIGMA**-2, root, BRIDGED_SIGMA**-2, BRIDGED_PLACE_SIGMA**-2)
        solved[f] = again.explained(frames[f], names, held)
    return solved, forward.counts


def _positions(named: Sequence[Named]) -> FloatArray:
    """Return the markers (F, M, 3) m of frames with names put right."""
    return np.array([positions for positions, _ in named])
