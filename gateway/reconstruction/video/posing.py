"""Poses to skeleton frames: as they are, and smoothed as step 6 of JP2020-042476A says."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gateway.frames import FloatArray, SkeletonFrame, Status, unknown_pose
from gateway.geometry import quaternion
from gateway.reconstruction.optical.pose_solver import HELD_SIGMA, Held
from gateway.reconstruction.optical.rates import Rates
from gateway.reconstruction.video.inverse_kinematics import (
    Goal,
    VideoBody,
    VideoBodyPose,
    solve,
)
from gateway.reconstruction.video.low_pass import DELAY, LowPass

_STEPS = 8


def skeleton_frame(
    sequence: int, time_ns: int, body: VideoBody, pose: VideoBodyPose, sigma: FloatArray,
    status: NDArray[np.uint8],
) -> SkeletonFrame:  # fmt: skip
    """Return a pose as it is; rates and accelerations are not known (NaN). sigma: (S,) rad."""
    return replace(
        unknown_pose(len(body.model.parents), sequence, time_ns),
        q_wb=np.stack([quaternion.from_matrix(each) for each in pose.R]),
        p_w=body.model.joints_at(pose.R, pose.root),
        sigma=sigma,
        status=status,
    )


def statuses(shows: NDArray[np.bool_], lost: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return (n_segments,): measured where a keypoint that was found tells the segment's orientation, held
    where nothing was found at all, else predicted from the rest of the body.

    shows: (n_keypoints, n_segments); lost: (n_keypoints,).
    """
    if lost.all():
        return np.full(shows.shape[1], Status.HELD, dtype=np.uint8)
    shown = shows[~lost].any(axis=0)
    return np.where(shown, Status.MEASURED, Status.PREDICTED).astype(np.uint8)


class PoseSmoother:
    """Keypoints of the body through the low-pass, then inverse kinematics with uniform weights."""

    def __init__(self) -> None:
        self._low_pass = LowPass()
        self._rates = Rates()
        self._waiting: deque[tuple[SkeletonFrame, VideoBodyPose]] = deque(maxlen=DELAY + 1)

    def reset(self) -> None:
        """Take the next pose for the first."""
        self._low_pass.reset()
        self._rates.reset()
        self._waiting.clear()

    def add(
        self, newest: SkeletonFrame, body: VideoBody, pose: VideoBodyPose, floor: float
    ) -> SkeletonFrame | None:
        """Return the smoothed frame of ``DELAY`` poses before; None until there are as many."""
        targets = self._low_pass.add(body.model.markers_at(pose.R, pose.root))
        self._waiting.append((newest, pose))
        if len(self._waiting) <= DELAY:
            return None
        return self._smooth(targets, body, floor)

    def rest(self, body: VideoBody, floor: float) -> list[SkeletonFrame]:
        """Return, after the last pose, the frames that still wait, the last pose standing for those after
        it."""
        if not self._waiting:
            return []
        last = self._waiting[-1][1]
        places = body.model.markers_at(last.R, last.root)
        for _ in range(DELAY - len(self._waiting)):
            self._low_pass.add(places)
        if len(self._waiting) > DELAY:
            self._waiting.popleft()
        frames = []
        while self._waiting:
            frames.append(self._smooth(self._low_pass.add(places), body, floor))
            self._waiting.popleft()
        return frames

    def _smooth(self, targets: FloatArray, body: VideoBody, floor: float) -> SkeletonFrame:
        frame, pose = self._waiting[0]
        goal = Goal(targets, np.ones(len(targets)), Held(pose.R, HELD_SIGMA**-2), floor)
        smooth = solve(body, goal, pose.R, pose.root, _STEPS)
        p_w = body.model.joints_at(smooth.R, smooth.root)
        rate, acceleration = self._rates.add(frame.time_ns, smooth.R, p_w)
        q_wb = np.stack([quaternion.from_matrix(each) for each in smooth.R])
        return SkeletonFrame(
            sequence=frame.sequence,
            time_ns=frame.time_ns,
            q_wb=q_wb,
            angular_rate=rate,
            joint_acceleration=acceleration,
            p_w=p_w,
            sigma=frame.sigma,
            status=frame.status,
            root=0,
        )
