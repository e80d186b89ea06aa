"""Skeleton and heat maps drawn on the pictures that they came from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from devices.cameras.opencv import cv2
from devices.cameras.pictures import Picture
from gateway.body.camera import Camera, project
from gateway.body.skeleton import Skeleton
from gateway.frames import CameraHeatMaps, FloatArray, SkeletonFrame, Status
from gateway.geometry import quaternion

_LEFT, _RIGHT, _MIDDLE = (80, 200, 80), (60, 60, 230), (240, 200, 60)
"""Blue, green, red."""
_OPACITY = 0.75
_LINE = 22
"""Pixels, of a line of text."""
_THICKNESS = 1 / 300
"""Of a line, as a share of the picture's height."""


def draw_heat_maps(picture: Picture, maps: CameraHeatMaps) -> Picture:
    """Return the picture with the likeliest keypoint's likelihood at each place laid over it."""
    height, width = picture.shape[:2]
    highest = maps.likelihood.max(axis=0)
    spread = cv2.warpAffine(
        highest, maps.map_from_pixel, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    )
    colours = cv2.applyColorMap(np.rint(255 * spread).astype(np.uint8), cv2.COLORMAP_INFERNO)
    share = (_OPACITY * np.clip(2.0 * spread, 0.0, 1.0))[:, :, None]
    laid: Picture = np.rint((1.0 - share) * picture + share * colours).astype(np.uint8)
    return laid


def draw_skeleton(picture: Picture, camera: Camera, skeleton: Skeleton, frame: SkeletonFrame) -> None:
    """Draw every segment as a line from its proximal joint to its tip onto the picture. Thin: predicted."""
    ends = segment_ends(skeleton, frame)
    pixels = project(camera, ends)
    thick = max(round(_THICKNESS * picture.shape[0]), 1)
    for name, line, status in zip(skeleton.segment_names, pixels, frame.status, strict=True):
        if not np.isfinite(line).all() or np.abs(line).max() > 1e5:
            continue
        colour = _LEFT if name.startswith("left_") else _RIGHT if name.startswith("right_") else _MIDDLE
        first, second = (tuple(round(value) for value in end) for end in line)
        width = thick if status == Status.MEASURED else max(thick // 2, 1)
        cv2.line(picture, first, second, colour, width, cv2.LINE_AA)
        cv2.circle(picture, first, thick, (255, 255, 255), -1, cv2.LINE_AA)


def segment_ends(skeleton: Skeleton, frame: SkeletonFrame) -> FloatArray:
    """Return (n_segments, 2, 3) m: proximal joint and tip of every segment."""
    tips = [
        p + quaternion.rotate(q, tip) for p, q, tip in zip(frame.p_w, frame.q_wb, skeleton.tips, strict=True)
    ]
    return np.stack([frame.p_w, np.array(tips)], axis=1)


def side_by_side(pictures: Sequence[Picture], names: Sequence[str], height: int, caption: str) -> Picture:
    """Return pictures of several cameras in a row, each with its name, all ``height`` pixels high; caption:
    what all of them show, below."""
    row = []
    for picture, name in zip(pictures, names, strict=True):
        width = max(round(picture.shape[1] * height / picture.shape[0]), 1)
        small: Picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
        _write(small, name, _LINE)
        row.append(small)
    joined = np.concatenate(row, axis=1)
    even: Picture = joined[: height - height % 2, : joined.shape[1] - joined.shape[1] % 2].astype(np.uint8)
    _write(even, caption, even.shape[0] - _LINE // 2)
    return even


def _write(picture: Picture, text: str, y: int) -> None:
    """Write white on black, at the left, ``y`` pixels below the upper edge."""
    for colour, thickness in (((0, 0, 0), 4), ((255, 255, 255), 2)):
        cv2.putText(picture, text, (8, y), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, thickness, cv2.LINE_AA)
