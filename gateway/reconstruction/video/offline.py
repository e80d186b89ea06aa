"""Recorded heat maps: what was hidden for a while is recovered from later frames.

Step 4 of JP2020-042476A: tracking runs forwards, then backwards from the last frame. A keypoint that one run
had lost is taken from the other; one that both had lost moves evenly from where the forward run has it to
where the backward run has it, with little weight. Inverse kinematics and smoothing follow as they do live.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.body.camera import Camera
from gateway.frames import FloatArray, HeatMapFrame, SkeletonFrame, unknown_pose
from gateway.reconstruction.video.inverse_kinematics import VideoBodyPose
from gateway.reconstruction.video.keypoint_set import KeypointSet
from gateway.reconstruction.video.posing import PoseSmoother, skeleton_frame, statuses
from gateway.reconstruction.video.tracker import KeypointTracker, Sighting, VideoOptions

BRIDGED_WEIGHT = 0.2
"""Likelihood of a keypoint that neither run could see."""


@dataclass(frozen=True)
class _Run:
    """One direction, frame by frame in the order of time."""

    sightings: list[Sighting]
    poses: list[VideoBodyPose | None]
    places: list[FloatArray]  # (n_keypoints, 3) m; NaN without a pose


def reconstruct_recorded(
    cameras: Sequence[Camera],
    keypoints: KeypointSet,
    frames: Sequence[HeatMapFrame],
    options: VideoOptions | None = None,
    advanced: Callable[[], object] = lambda: None,
) -> list[SkeletonFrame]:
    """Return the smoothed pose of every frame, with the same lengths in all.

    frames: in the order of time; each is asked for more than once, so they may come from a file. advanced:
    called twice for every frame, for a progress bar.
    """
    tracker = KeypointTracker(cameras, keypoints, options or VideoOptions())
    forward = _run(tracker, frames, advanced, backwards=False)
    tracker.keep_lengths()
    tracker.reset()
    backward = _run(tracker, frames, advanced, backwards=True)
    merged = _merged(forward, backward)
    smoothed = PoseSmoother()
    poses: list[SkeletonFrame] = []
    for f, sighting in enumerate(merged):
        tracker.pose = forward.poses[f] or backward.poses[f]
        frame = frames[f]
        if tracker.pose is None:
            poses += smoothed.rest(tracker.body, tracker.floor)
            smoothed.reset()
            poses.append(unknown_pose(tracker.person.skeleton.n_segments, frame.sequence, frame.time_ns))
            continue
        tracker.solve(sighting)
        newest = skeleton_frame(
            frame.sequence, frame.time_ns, tracker.body, tracker.pose, tracker.orientation_sigmas(sighting),
            statuses(keypoints.shows, sighting.likelihood <= BRIDGED_WEIGHT),
        )  # fmt: skip
        ready = smoothed.add(newest, tracker.body, tracker.pose, tracker.floor)
        poses += [] if ready is None else [ready]
    return poses + smoothed.rest(tracker.body, tracker.floor)


def _run(
    tracker: KeypointTracker,
    frames: Sequence[HeatMapFrame],
    advanced: Callable[[], object],
    backwards: bool,
) -> _Run:
    run = _Run([], [], [])
    for f in range(len(frames))[:: -1 if backwards else 1]:
        run.sightings.append(tracker.track(frames[f].cameras))
        run.poses.append(tracker.pose)
        known = tracker.pose is not None
        run.places.append(tracker.places if known else np.full((len(tracker.keypoints.names), 3), np.nan))
        advanced()
    return _Run(run.sightings[::-1], run.poses[::-1], run.places[::-1]) if backwards else run


def _merged(forward: _Run, backward: _Run) -> list[Sighting]:
    """Return for every frame and keypoint the candidate of the run that sees it, the likelier one where both
    do."""
    there = np.stack([sighting.candidates for sighting in forward.sightings])
    back = np.stack([sighting.candidates for sighting in backward.sightings])
    likely = np.stack([np.where(s.lost, 0.0, s.likelihood) for s in forward.sightings])
    likely_back = np.stack([np.where(s.lost, 0.0, s.likelihood) for s in backward.sightings])
    take_back = likely_back > likely
    candidates = np.where(take_back[..., None], back, there)
    likelihood = np.maximum(likely, likely_back)
    bridged = _bridged(likelihood == 0.0, np.stack(forward.places), np.stack(backward.places))
    lost = np.isnan(candidates[..., 0])
    candidates = np.where(lost[..., None], bridged, candidates)
    likelihood = np.where(lost & np.isfinite(candidates[..., 0]), BRIDGED_WEIGHT, likelihood)
    return [Sighting(*rows) for rows in zip(candidates, likelihood, strict=True)]


def _bridged(lost: NDArray[np.bool_], there: FloatArray, back: FloatArray) -> FloatArray:
    """Return (F, n_keypoints, 3) m: over every stretch of lost frames (F, n_keypoints) from one run to the
    other."""
    bridged = np.full_like(there, np.nan)
    for m in range(lost.shape[1]):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], lost[:, m].astype(int), [0]])))
        for start, stop in edges.reshape(-1, 2).tolist():
            u = ((np.arange(start, stop) + 1 - start) / (stop - start + 1))[:, None]
            bridged[start:stop, m] = (1 - u) * there[start:stop, m] + u * back[start:stop, m]
    return bridged
