"""How long the parts of a person are, from keypoints: the standard skeleton scaled part by part.

Step 3 of JP2020-042476A: every part has one ratio to the standard skeleton, the same left and right, from
distances between keypoints over the first frames.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gateway.body.skeleton import BodyMarkers, Skeleton
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.video.inverse_kinematics import video_body
from gateway.reconstruction.video.keypoint_set import KeypointSet

_SIDES = ("left", "right")
_LIMBS = {
    "upper_arm": ("shoulder", "elbow"),
    "forearm": ("elbow", "wrist"),
    "hand": ("wrist", "index"),
    "thigh": ("hip", "knee"),
    "shank": ("knee", "ankle"),
    "foot": ("heel", "foot_index"),
}
"""Part of either side, and the keypoints between which it is measured."""
_WIDTHS = {"hips": "hip", "shoulders": "shoulder", "head": "ear"}
"""Distance between the left and the right one of a keypoint."""
_TRUNK = ("l5", "l3", "t12", "thorax")
PARTS = (*_LIMBS, *_WIDTHS, "trunk")
LARGEST_DEVIATION = 1.6
"""Ratio to the person as a whole beyond which a part is not believed."""


def part_lengths(keypoints: KeypointSet, points: FloatArray) -> FloatArray:
    """Return (n_parts,) m, in the order of ``PARTS``; NaN where the keypoints (n_keypoints, 3) are not
    there."""
    place = {name: points[n] for n, name in enumerate(keypoints.names)}

    def between(a: str, b: str) -> float:
        if a not in place or b not in place:
            return np.nan
        return float(np.linalg.norm(place[a] - place[b]))

    def mean(values: list[float]) -> float:
        known = [value for value in values if np.isfinite(value)]
        return sum(known) / len(known) if known else np.nan

    limbs = [mean([between(f"{s}_{a}", f"{s}_{b}") for s in _SIDES]) for a, b in _LIMBS.values()]
    widths = [between(f"left_{name}", f"right_{name}") for name in _WIDTHS.values()]
    hips = 0.5 * (place["left_hip"] + place["right_hip"])
    shoulders = 0.5 * (place["left_shoulder"] + place["right_shoulder"])
    return np.array([*limbs, *widths, np.linalg.norm(hips - shoulders)])


def standard_lengths(keypoints: KeypointSet) -> FloatArray:
    """Return the same of the standard skeleton in neutral posture."""
    body = video_body(keypoints.skeleton, keypoints.markers)
    R = np.tile(quaternion.to_matrix(keypoints.skeleton.neutral), (keypoints.skeleton.n_segments, 1, 1))
    return part_lengths(keypoints, body.model.markers_at(R, np.zeros(3)))


def sized(keypoints: KeypointSet, lengths: FloatArray) -> tuple[Skeleton, BodyMarkers]:
    """Return the standard skeleton and its keypoints with the parts' lengths (n_parts,) m; NaN: as the
    others.

    Lengths that cannot belong to the same person as most are taken as not known.
    """
    ratios = lengths / standard_lengths(keypoints)
    whole = float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else 1.0
    with np.errstate(invalid="ignore"):
        strange = np.abs(np.log(ratios / whole)) > np.log(LARGEST_DEVIATION)
    widths = np.array([part in _WIDTHS for part in PARTS])  # joint centres lie closer than Drillis' breadths
    ratios = np.where(np.isfinite(ratios) & (~strange | widths), ratios, whole)
    ratio = dict(zip(PARTS, ratios.tolist(), strict=True))
    scale = np.stack([_segment_scale(name, ratio, whole) for name in keypoints.skeleton.segment_names])
    skeleton, markers = keypoints.skeleton, keypoints.markers
    carriers = np.where(skeleton.parents < 0, 0, skeleton.parents)
    sized_skeleton = replace(
        skeleton,
        offsets=skeleton.offsets * scale[carriers],
        tips=skeleton.tips * scale,
        contacts=tuple((s, point * scale[s]) for s, point in skeleton.contacts),
        stature_m=None,
    )
    return sized_skeleton, replace(markers, positions=markers.positions * scale[markers.segments])


def _segment_scale(segment: str, ratio: dict[str, float], whole: float) -> FloatArray:
    """Return (3,) by which a segment, with all that hangs on it, is longer than the standard along its
    axes."""
    part = segment.removeprefix("left_").removeprefix("right_")
    if segment == "pelvis":
        return np.array([ratio["trunk"], ratio["trunk"], ratio["hips"]])
    if part in _TRUNK or part == "shoulder_girdle":
        return np.array([ratio["trunk"], ratio["trunk"], ratio["shoulders"]])
    name = {"toes": "foot", "neck": "trunk"}.get(part, part)
    return np.full(3, ratio.get(name, whole))
