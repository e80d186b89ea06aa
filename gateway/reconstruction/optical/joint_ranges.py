"""What the joints of a person did while calibrating: limits and freedom of the fitted body.

Rules for axes are not perfect: a wand marker that sits askew makes a knee appear to adduct by 30°. A body
whose joints may not do what its own calibration shows would pull against its markers ever after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gateway.body.joints import Angle, Joint
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray
from gateway.reconstruction.optical.kernels import cardan
from gateway.reconstruction.optical.pose_solver import FIXED_SIGMA, BodyModel, Pose

MARGIN = np.radians(10.0)
"""Beyond what the calibration shows."""
_HARDLY = np.radians(15.0)
_BACKWARDS = np.radians(35.0)
_FEWEST_POSES = 5
_TURNED_ABOUT = np.radians(150.0)
"""From the neutral posture: farther than hips and ankles go, nearer than those of a mirror's world."""
_OUTLIERS = 2.0
"""Percent of the frames at either end that do not count."""


def shown_joints(
    skeleton: Skeleton, model: BodyModel, poses: Sequence[Pose], bending: Sequence[int] = ()
) -> tuple[Joint, ...]:
    """Return the skeleton's joints with limits wide enough for the poses; angles that leave their neutral
    place by more than ``FIXED_SIGMA`` count as free from now on.

    bending: segments whose joints bend in one plane: angles that those do not have stay held.
    """
    rows = {int(distal): row for row, distal in enumerate(model.distals)}
    joints = []
    for joint in skeleton.joints:
        row = rows.get(joint.distal)
        if row is None or joint.proximal != skeleton.parents[joint.distal] or len(joint.angles) != 3:
            joints.append(joint)
            continue
        if len(set(joint.sequence)) != 3:
            joints.append(joint)
            continue
        joints.append(_widened(joint, _angles(model, row, poses), only_free=joint.distal in bending))
    return tuple(joints)


def impossible_joints(
    skeleton: Skeleton, model: BodyModel, poses: Sequence[Pose]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the joints that are backwards, left and right: left and right are exchanged, or the world is a
    mirror's. They bend only to the side to which they hardly can; where none does, their segments are turned
    about against one another. Where nothing is backwards, return also those turned about on one side."""
    about = _turned_about(skeleton, poses)
    backwards = _on_both_sides(_bent_backwards(skeleton, model, poses)) or _on_both_sides(about)
    return backwards, () if backwards else tuple(about)


def _bent_backwards(skeleton: Skeleton, model: BodyModel, poses: Sequence[Pose]) -> list[str]:
    """Return the joints that by the body file hardly bend to one side, and in the poses bend to that side
    only."""
    rows = {int(distal): row for row, distal in enumerate(model.distals)}
    found = []
    for joint in skeleton.joints:
        row = rows.get(joint.distal)
        if (
            row is None
            or not joint.angles
            or -joint.angles[0].limits[0] > _HARDLY < joint.angles[0].limits[1]
        ):
            continue
        shown = _angles(model, row, poses)[:, 0]
        if len(shown) < _FEWEST_POSES:
            continue
        low, high = np.percentile(shown, [_OUTLIERS, 100.0 - _OUTLIERS])
        is_forward = -joint.angles[0].limits[0] <= _HARDLY
        bent, other = (-low, high) if is_forward else (high, -low)
        if bent > _BACKWARDS and other < _HARDLY:
            found.append(joint.name)
    return found


def _on_both_sides(names: Sequence[str]) -> tuple[str, ...]:
    both = {name.replace("left_", "right_") for name in names if name.startswith("left_")}
    return tuple(name for name in names if name.replace("left_", "right_") in both.intersection(names))


def _turned_about(skeleton: Skeleton, poses: Sequence[Pose]) -> list[str]:
    """Return the joints that by the body file stay within ``_TURNED_ABOUT``, and in most poses do not."""
    R = np.stack([pose.R for pose in poses])
    found = []
    for joint in skeleton.joints:
        if np.abs([angle.limits for angle in joint.angles]).max(initial=0.0) >= _TURNED_ABOUT:
            continue
        trace = np.einsum("kij,kij->k", R[:, joint.proximal], R[:, joint.distal])
        if np.median(trace) < 1.0 + 2.0 * np.cos(_TURNED_ABOUT):
            found.append(joint.name)
    return found


def _angles(model: BodyModel, row: int, poses: Sequence[Pose]) -> FloatArray:
    """Return (K, 3) rad, each growing with its named movement; without poses near the singularity."""
    distal = model.distals[row]
    found = [cardan(pose.R[model.parents[distal]], pose.R[distal], model.axes[row]) for pose in poses]
    regular = [angles * model.signs[row] for angles, _, is_regular in found if is_regular]
    return np.array(regular).reshape(-1, 3)


def _widened(joint: Joint, shown: FloatArray, *, only_free: bool) -> Joint:
    if not len(shown):
        return joint
    if only_free:
        held = np.array([angle.name not in joint.free for angle in joint.angles])
        shown = np.where(held, 0.0, shown)
    low, high = np.percentile(shown, [_OUTLIERS, 100.0 - _OUTLIERS], axis=0)
    angles = tuple(_wider(angle, low[k], high[k]) for k, angle in enumerate(joint.angles))
    moving = {
        angle.name for k, angle in enumerate(joint.angles) if max(abs(low[k]), abs(high[k])) > FIXED_SIGMA
    }
    free = tuple(angle.name for angle in joint.angles if angle.name in {*joint.free, *moving})
    return replace(joint, angles=angles, free=free)


def _wider(angle: Angle, low: float, high: float) -> Angle:
    limits = min(angle.limits[0], float(low - MARGIN)), max(angle.limits[1], float(high + MARGIN))
    return replace(angle, limits=limits)
