"""The full-body model of Rajagopal et al. (2016, IEEE Trans. Biomed. Eng. 63(10): 2068–2079): its names,
signs and axes, as far as a motion needs them."""

from __future__ import annotations

from gateway.frames import Vector3

SIDES = (("left", "l", -1.0), ("right", "r", 1.0))
"""Ours, theirs, and which way z points away from the body."""


def _both(joint: str, angle: str, coordinate: str) -> dict[str, tuple[str, float]]:
    return {f"{side}_{joint}_{angle}": (f"{coordinate}_{letter}", 1.0) for side, letter, _ in SIDES}


COORDINATES: dict[str, tuple[str, float]] = {
    **_both("hip", "flexion", "hip_flexion"),
    **_both("hip", "adduction", "hip_adduction"),
    **_both("hip", "internal_rotation", "hip_rotation"),
    **_both("knee", "flexion", "knee_angle"),
    **_both("wrist", "flexion", "wrist_flex"),
    **_both("wrist", "ulnar_deviation", "wrist_dev"),
    "spine_flexion": ("lumbar_extension", -1.0),
    "spine_right_bending": ("lumbar_bending", 1.0),
    "spine_left_rotation": ("lumbar_rotation", 1.0),
}
"""Our angles that are theirs, to (theirs, factor)."""

BODIES: dict[str, str] = {
    "thorax": "torso",
    **{
        f"{side}_{ours}": f"{theirs}_{letter}"
        for side, letter, _ in SIDES
        for ours, theirs in {
            "thigh": "femur", "shank": "tibia", "foot": "calcn", "upper_arm": "humerus", "forearm": "ulna",
            "hand": "hand",
        }.items()
    },
}  # fmt: skip
"""Our segments to their bodies; others keep our names."""

HIP_IN_PELVIS: Vector3 = (-0.056276, -0.07849, 0.07726)
"""Right hip from the pelvis' origin, between the anterior spines, m."""
LEG_M = 0.409 + 0.400
"""From hip over knee to ankle, of both segments together."""
ELBOW_IN_HUMERUS: Vector3 = (0.013144, -0.286273, -0.009595)
"""Right elbow from the shoulder, m."""
WRIST_IN_ULNA: Vector3 = (-0.015524, -0.248848, 0.039693)
"""Right wrist from the elbow in supination, m."""
ELBOW_AXIS: Vector3 = (0.226047, 0.022269, 0.973862)
PRONATION_AXIS: Vector3 = (0.056398, 0.998406, 0.001952)
ANKLE_AXIS: Vector3 = (-0.105014, -0.174022, 0.979126)
SUBTALAR_AXIS: Vector3 = (0.787180, 0.604747, -0.120949)
"""Of the right side; x and y change their signs on the left."""
