"""Keypoints that another program found in a picture, as heat maps: what a network here would have given."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gateway.errors import GatewayError
from gateway.frames import CameraHeatMaps, FloatArray
from gateway.reconstruction.video.networks.keypoints import BLAZEPOSE
from gateway.reconstruction.video.networks.person_detector import Person
from gateway.reconstruction.video.region import region_of_points

CELLS = 128
"""Of a map, a side."""
SPREAD_CELLS = 4.0
"""Standard deviation of a keypoint's place in its map, the same share of a person as in BlazePose's."""
LEAST_LIKELIHOOD = 0.05
"""Below it a keypoint counts as not found."""
_ROOM = 1.1
"""Circle about the hips that holds a person, over the farthest keypoint."""

_BODY = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder", "left_elbow",
    "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee", "right_knee",
    "left_ankle", "right_ankle",
)  # fmt: skip
_FEET = (
    "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
)  # fmt: skip
_OPENPOSE_25 = (
    "nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow",
    "left_wrist", "", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle",
    "right_eye", "left_eye", "right_ear", "left_ear", *_FEET,
)  # fmt: skip
_HALPE_26 = (
    *_BODY, "", "neck", "", "left_big_toe", "right_big_toe", "left_small_toe", "right_small_toe", "left_heel",
    "right_heel",
)  # fmt: skip
_OPENPOSE_18 = (*_OPENPOSE_25[:8], *_OPENPOSE_25[9:19])
LAYOUTS: dict[int, tuple[str, tuple[str, ...]]] = {
    17: ("coco_17", _BODY),
    18: ("openpose_18", _OPENPOSE_18),
    25: ("feet_24", _OPENPOSE_25),
    26: ("feet_24", _HALPE_26),
    33: ("blazepose_33", BLAZEPOSE),
    133: ("coco_23", (*_BODY, *_FEET, *[""] * 110)),
    136: ("feet_24", (*_HALPE_26, *[""] * 110)),
}
"""By the number of keypoints a person has: their set, and their names in order, empty for one left out.
COCO, OpenPose's COCO and BODY_25, Halpe (26 is the default of Pose2Sim, 136 is AlphaPose's whole body),
BlazePose of MediaPipe, COCO-WholeBody."""


def layout_of(n_keypoints: int, source: str) -> tuple[str, tuple[str, ...]]:
    """Return a keypoint set and the names in order. Raises ``GatewayError`` for a number that no known
    network has."""
    if n_keypoints not in LAYOUTS:
        raise GatewayError(
            f"{source}: {n_keypoints} keypoints a person: known are {', '.join(map(str, LAYOUTS))} (COCO, "
            "OpenPose, Halpe, MediaPipe, COCO-WholeBody)"
        )
    return LAYOUTS[n_keypoints]


def in_order(person: FloatArray, layout: tuple[str, ...], wanted: tuple[str, ...]) -> FloatArray:
    """Return (n, 3) x, y, likelihood of the wanted keypoints, of a person as the file has them."""
    return person[[layout.index(name) for name in wanted]]


def person_of(points: FloatArray, names: tuple[str, ...]) -> Person | None:
    """Return where somebody with keypoints (n, 3) is in a picture; None where too little of the trunk is
    seen."""
    seen = points[:, 2] >= LEAST_LIKELIHOOD
    hips, shoulders = (
        points[[k for k, name in enumerate(names) if name.endswith(part) and seen[k]], :2]
        for part in ("_hip", "_shoulder")
    )
    if not len(hips) or not len(shoulders):
        return None
    middle = hips.mean(axis=0)
    radius = _ROOM * float(np.linalg.norm(points[seen, :2] - middle, axis=1).max())
    return Person(float(points[seen, 2].mean()), middle, shoulders.mean(axis=0), radius)


def maps_of(points: FloatArray, names: tuple[str, ...]) -> CameraHeatMaps | None:
    """Return a map of each keypoint (n, 3), a hill about its place as high as it is likely; None where too
    little of the trunk is seen."""
    region = region_of_points(points[:, :2], points[:, 2], names)
    if region is None:
        return None
    affine = region.affine(CELLS)
    places = points[:, :2] @ affine[:, :2].T + affine[:, 2]
    cells = np.arange(CELLS, dtype=np.float64)
    across, down = (np.exp(-0.5 * ((cells - places[:, k, None]) / SPREAD_CELLS) ** 2) for k in range(2))
    found = np.where(points[:, 2] >= LEAST_LIKELIHOOD, np.clip(points[:, 2], 0.0, 1.0), 0.0)
    likelihood: NDArray[np.float32] = (found[:, None, None] * down[:, :, None] * across[:, None, :]).astype(
        np.float32
    )
    return CameraHeatMaps(likelihood, affine)
