"""Known truth: people of known motion as heat maps of real camera calibrations, found again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import Figure
from gateway.body.camera import Camera
from gateway.calibration.cameras_import import import_cameras
from gateway.emulation.video_truth import KnownPerson, rendered, ring_of_cameras, true_regions, walking
from gateway.frames import FloatArray
from gateway.reconstruction.video.crowd import VideoCrowd
from gateway.reconstruction.video.keypoint_set import load_keypoint_set
from gateway.reconstruction.video.offline import reconstruct_recorded
from gateway.reconstruction.video.reconstructor import VideoReconstructor

CALIBRATION = Path(__file__).parents[2] / "shared/data/pose2sim_single/calibration/Calib.qca.txt"
KEYPOINTS = load_keypoint_set("blazepose_33")
FRAMES = 46
SEED = 5
_START, _VELOCITY = (-1.4, -0.5), (0.2, 0.9)
_HIDDEN = range(20, 40)
_JOINTS = [
    f"{side}_{part}"
    for side in ("left", "right")
    for part in ("upper_arm", "forearm", "hand", "thigh", "shank", "foot")
]
_ARM = [KEYPOINTS.index(f"left_{name}") for name in ("elbow", "wrist", "pinky", "index", "thumb")]
Hidden = Callable[[int], NDArray[np.bool_] | None]


def truth_rows() -> tuple[list[Figure], tuple[list[str], list[list[str]]]]:
    """Figures, and a table of all cases."""
    cameras = import_cameras(CALIBRATION) if CALIBRATION.is_file() else ring_of_cameras(4)
    person = walking(KEYPOINTS, FRAMES, _START, _VELOCITY)
    hands = walking(KEYPOINTS, FRAMES, _START, _VELOCITY, upside_down=True)
    hidden, whole = _live(cameras, person, _arm_hidden), _recorded(cameras, person)
    errors = {
        "walking, 4 cameras": _live(cameras, person),
        "on the hands, 4 cameras": _live(cameras, hands),
        "walking, maps a cell off at random": _live(cameras, person, noise=1.0),
        "left arm hidden for 20 frames, the others": np.delete(hidden, [1, 2], 1),
        "the arm while hidden": hidden[_HIDDEN.start : _HIDDEN.stop, 1:3],
        "the arm afterwards": hidden[_HIDDEN.stop + 3 :, 1:3],
        "the arm while hidden, from later frames": whole[_HIDDEN.start : _HIDDEN.stop, 1:3],
        "walking, 3 cameras": _live(cameras[:3], person),
        "walking, 2 cameras": _live([cameras[0], cameras[2]], person),
        "4 cameras, from frame 20 on 1": _live(cameras, person, left=1)[20:],
        "two people crossing": _crossing(cameras),
    }
    figures = [
        _median("truth_joint_error_mm", errors["walking, 4 cameras"], "rendered walker, real calibrations"),
        _median("truth_inverted_joint_error_mm", errors["on the hands, 4 cameras"], "the same on the hands"),
        _median(
            "truth_recovered_joint_error_mm", errors["the arm afterwards"], "elbow and wrist, hidden before"
        ),
        _median(
            "truth_crossing_joint_error_mm", errors["two people crossing"], "two people passing at 0.4 m"
        ),
    ]
    rows = [
        [name, *(f"{1e3 * np.percentile(error, share):.1f}" for share in (50, 95, 100))]
        for name, error in errors.items()
    ]
    return figures, (["case", "median", "p95", "largest"], rows)


def _median(name: str, errors: FloatArray, note: str) -> Figure:
    return Figure(name, 1e3 * float(np.median(errors)), "mm", "<=4", f"median over 12 joints; {note}")


def _arm_hidden(frame: int) -> NDArray[np.bool_] | None:
    if frame not in _HIDDEN:
        return None
    hidden = np.zeros((4, len(KEYPOINTS.names)), dtype=bool)
    hidden[:, _ARM] = True
    return hidden


def _live(
    cameras: list[Camera] | tuple[Camera, ...], person: KnownPerson, hidden: Hidden = lambda _: None,
    noise: float = 0.0, left: int | None = None,
) -> FloatArray:  # fmt: skip
    """(F, 12) m, unsmoothed. noise: by how many cells every blob is off, standard deviation; left: so many
    cameras from frame 20 on."""
    generator = np.random.default_rng(SEED)
    reconstructor = VideoReconstructor(cameras, KEYPOINTS)
    regions = true_regions(cameras, KEYPOINTS, person.keypoints[0])
    rows = [person.skeleton.index(name) for name in _JOINTS]
    errors = []
    for f, points in enumerate(person.keypoints):
        shown = [region if left is None or f < 20 or c < left else None for c, region in enumerate(regions)]
        off = noise * generator.normal(size=(len(cameras), len(points), 2)) if noise else None
        pose = reconstructor.update(rendered(cameras, shown, points[None], f, hidden(f), off))
        regions = pose.regions
        errors.append(np.linalg.norm(pose.newest.p_w[rows] - person.joints[f][rows], axis=1))
    return np.array(errors)


def _recorded(cameras: list[Camera] | tuple[Camera, ...], person: KnownPerson) -> FloatArray:
    """(F, 12) m, from all frames at once."""
    frames = [
        rendered(cameras, true_regions(cameras, KEYPOINTS, points), points[None], f, _arm_hidden(f))
        for f, points in enumerate(person.keypoints)
    ]
    rows = [person.skeleton.index(name) for name in _JOINTS]
    solved = reconstruct_recorded(cameras, KEYPOINTS, frames)
    return np.array(
        [np.linalg.norm(s.p_w[rows] - j[rows], axis=1) for s, j in zip(solved, person.joints, strict=True)]
    )


def _crossing(cameras: list[Camera] | tuple[Camera, ...]) -> FloatArray:
    """(F, 24) m: two people who pass each other, each seen in the other's maps; a swap would be metres."""
    people = [
        walking(KEYPOINTS, 90, (-1.4, -1.0), (0.0, 1.4)),
        walking(KEYPOINTS, 90, (-1.0, 1.1), (0.0, -1.4), phase=1.0),
    ]
    crowd = VideoCrowd(cameras, KEYPOINTS, 2)
    regions = [true_regions(cameras, KEYPOINTS, person.keypoints[0]) for person in people]
    rows = [people[0].skeleton.index(name) for name in _JOINTS]
    errors = []
    for f in range(90):
        everyone = np.stack([person.keypoints[f] for person in people])
        shown = [everyone if f else everyone[k : k + 1] for k in range(2)]
        crowd.update([rendered(cameras, regions[k], shown[k], f) for k in range(2)])
        regions = [
            true_regions(cameras, KEYPOINTS, points)
            for points in crowd.expected_after(1)
            if points is not None
        ]
        errors.append(
            np.concatenate(
                [
                    np.linalg.norm(tracker.joints[rows] - person.joints[f][rows], axis=1)
                    for tracker, person in zip(crowd.trackers, people, strict=True)
                ]
            )
        )
    return np.array(errors)
