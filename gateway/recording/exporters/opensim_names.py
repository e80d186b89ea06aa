"""Our joint angles as coordinates of the full-body model of Rajagopal et al. (2016), with its signs."""

from __future__ import annotations


def _sides(joint: str, angle: str, coordinate: str) -> dict[str, tuple[str, float]]:
    return {
        f"{side}_{joint}_{angle}": (f"{coordinate}_{letter}", 1.0)
        for side, letter in (("left", "l"), ("right", "r"))
    }


COORDINATES: dict[str, tuple[str, float]] = {
    **_sides("hip", "flexion", "hip_flexion"),
    **_sides("hip", "adduction", "hip_adduction"),
    **_sides("hip", "internal_rotation", "hip_rotation"),
    **_sides("knee", "flexion", "knee_angle"),
    **_sides("ankle", "dorsiflexion", "ankle_angle"),
    **_sides("elbow", "flexion", "elbow_flex"),
    **_sides("elbow", "pronation", "pro_sup"),
    "spine_flexion": ("lumbar_extension", -1.0),
    "spine_right_bending": ("lumbar_bending", 1.0),
    "spine_left_rotation": ("lumbar_rotation", 1.0),
}
"""Ours to (theirs, factor). Angles without a counterpart keep their names; OpenSim passes them over."""
