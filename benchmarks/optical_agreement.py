"""Joint centres and angles against those that Plug-in-Gait wrote into the files: of our rules, and of bodies.

Plug-in-Gait gives every frame a skeleton of its own: its bones change their length as skin moves. A body
whose bones do not cannot meet such centres, so how far they change stands beside.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.figures import table
from devices.marker_files import MarkerTrial
from gateway.body.joint_angles import joint_angles
from gateway.body.skeleton import Skeleton
from gateway.emulation.optical_truth import CENTRES
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.reconstruction.optical.fitting import sighted
from gateway.reconstruction.optical.landmarks import measurements, to_world, vertical_axis
from gateway.reconstruction.optical.marker_set import MarkerSet

ANGLES = {
    (f"{side}_{joint}", name): (f"{side[0].upper()}{label}Angles", column)
    for side in ("left", "right")
    for joint, label, names in (
        ("hip", "Hip", ("flexion", "adduction", "internal_rotation")),
        ("knee", "Knee", ("flexion", "adduction")),
        ("ankle", "Ankle", ("dorsiflexion",)),
        ("elbow", "Elbow", ("flexion",)),
    )
    for column, name in enumerate(names)
}
BONES = {
    "left knee": ("LFEP", "LFEO"), "right knee": ("RFEP", "RFEO"),
    "left ankle": ("LFEO", "LTIO"), "right ankle": ("RFEO", "RTIO"),
    "left elbow": ("LCLO", "LHUO"), "right elbow": ("RCLO", "RHUO"),
    "left wrist": ("LHUO", "LRAO"), "right wrist": ("RHUO", "RRAO"),
}  # fmt: skip
"""Bone that ends in the joint, by the file's own centres."""
RULES = "rules, frame by frame"


class Agreement:
    """Tables, filled trial by trial."""

    def __init__(self) -> None:
        self._centres: list[list[str]] = []
        self._angles: dict[tuple[str, str, str], dict[str, str]] = {}
        self._methods: list[str] = []

    def add_rules(
        self,
        name: str,
        marker_set: MarkerSet,
        training: list[MarkerTrial],
        held: MarkerTrial,
        lengths: Mapping[str, float],
    ) -> None:
        """What the rules of the marker set say of every frame, without a body; and the file's own bones."""
        vertical = vertical_axis(marker_set, training[0])
        places = sighted(marker_set, held, vertical, measurements(marker_set, training, lengths)).places
        q_wb = np.array([[quaternion.from_matrix(R) for R in axes] for axes in places.axes])
        spread = []
        for joint in CENTRES:
            ends = BONES.get(joint)
            spread.append("–" if ends is None else f"± {1e3 * _length_spread(held, ends):.1f}")
        self._centres.append([name, "the file's bone up to it, standard deviation", *spread])
        self.add(name, RULES, marker_set.body, q_wb, places.origins, held)

    def add(
        self,
        name: str,
        method: str,
        skeleton: Skeleton,
        q_wb: FloatArray,
        p_w: FloatArray,
        held: MarkerTrial,
    ) -> None:
        """Poses of the held-out frames: q_wb (F, S, 4), p_w (F, S, 3) m, Z up as in these files."""
        if method not in self._methods:
            self._methods.append(method)
        self._centres.append([name, method, *_centres(skeleton, p_w, held)])
        for (joint, angle), cell in _angles(skeleton, q_wb, held).items():
            self._angles.setdefault((name, joint, angle), {})[method] = cell

    def tables(self) -> list[str]:
        """Of centres and of angles."""
        angle_rows = [
            [*key, *(cells.get(method, "–") for method in self._methods)]
            for key, cells in self._angles.items()
        ]
        return [
            "## Joint centres against the file's Plug-in-Gait, RMSE in mm\n\n"
            + table(["trial", "method", *CENTRES], self._centres),
            "## Joint angles against the file's Plug-in-Gait, degrees: RMSE / without its mean\n\n"
            + table(["trial", "joint", "angle", *self._methods], angle_rows),
        ]


def _length_spread(held: MarkerTrial, ends: tuple[str, str]) -> float:
    points = to_world(held.columns(ends), "z")
    return float(np.nanstd(np.linalg.norm(points[:, 0] - points[:, 1], axis=1)))


def _centres(skeleton: Skeleton, p_w: FloatArray, held: MarkerTrial) -> list[str]:
    cells = []
    for segment, label in CENTRES.values():
        truth = to_world(held.columns((label,)), "z")[:, 0]
        apart = np.linalg.norm(p_w[:, skeleton.index(segment)] - truth, axis=1)
        cells.append(f"{1e3 * float(np.sqrt(np.nanmean(apart**2))):.1f}")
    return cells


def _angles(skeleton: Skeleton, q_wb: FloatArray, held: MarkerTrial) -> dict[tuple[str, str], str]:
    ours = np.degrees(joint_angles(skeleton, q_wb))
    joints = {joint.name: j for j, joint in enumerate(skeleton.joints)}
    cells = {}
    for (joint, angle), (label, column) in ANGLES.items():
        names = [each.name for each in skeleton.joints[joints[joint]].angles]
        theirs = held.columns((label,))[:, 0, column] / held.metres_per_unit
        apart = (ours[:, joints[joint], names.index(angle)] - theirs + 180.0) % 360.0 - 180.0
        spread = apart - np.nanmean(apart)
        cells[joint, angle] = f"{np.sqrt(np.nanmean(apart**2)):.1f} / {np.sqrt(np.nanmean(spread**2)):.1f}"
    return cells
