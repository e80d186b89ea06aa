"""Moments at joints laid along the axes of the joints' angles.

A moment's share in an angle is its component along the axis that the angle turns about: for Cardan angles the
first axis in the proximal segment, the third in the distal one, and the floating one across both. That is the
generalised force of the angle (its work by the angle's rate).
"""

from __future__ import annotations

import numpy as np

from devices.deferred import Rotation
from gateway.analysis.smooth_motion import matrices
from gateway.body.joints import WORLD, Decomposition, Joint
from gateway.body.skeleton import Skeleton
from gateway.frames import FloatArray


def angle_axes(skeleton: Skeleton, angles: FloatArray, rotation_wb: FloatArray) -> FloatArray:
    """Return (F, J, 3, 3) unit world axis of each joint's each angle; NaN beyond a joint's last angle.

    angles: (F, J, 3) rad. rotation_wb: (F, S, 3, 3).
    """
    axes = np.full((*angles.shape, 3), np.nan)
    neutral = matrices(skeleton.neutral[None])[0]
    for j, joint in enumerate(skeleton.joints):
        is_on_world = joint.proximal == WORLD
        proximal = neutral[None] if is_on_world else rotation_wb[:, joint.proximal]
        for k, axis in enumerate(_axes_in_proximal(joint, angles[:, j])):
            axes[:, j, k] = np.einsum("fij,fj->fi", np.broadcast_to(proximal, (len(angles), 3, 3)), axis)
    return axes


def joint_torques(skeleton: Skeleton, axes: FloatArray, moment: FloatArray) -> FloatArray:
    """Return (F, J, 3) N m, each driving its angle in the sense of its name; NaN beyond a joint's last angle.

    axes: of ``angle_axes``. moment: (F, S, 3) N m, world, on each segment at its proximal joint.
    """
    distal = [joint.distal for joint in skeleton.joints]
    torques: FloatArray = np.einsum("fjki,fji->fjk", axes, moment[:, distal])
    return torques


def _axes_in_proximal(joint: Joint, angles: FloatArray) -> list[FloatArray]:
    """Return for each angle its axis (F, 3) in the proximal segment's axes. angles: (F, 3) rad."""
    named = [np.array(angle.axis, dtype=np.float64) for angle in joint.angles]
    if joint.decomposition is Decomposition.SWING_TWIST:  # the swing's two axes stay; the twist's goes along
        swing = angles[:, :1] * named[0] + angles[:, 1:2] * named[1]
        return [np.tile(named[0], (len(angles), 1)), np.tile(named[1], (len(angles), 1)),
                _turned(swing, named[2])]  # fmt: skip
    found, before = [], np.tile(np.eye(3), (len(angles), 1, 1))
    for k, axis in enumerate(named):
        found.append(np.einsum("fij,j->fi", before, axis))
        before = before @ _rotations(angles[:, k : k + 1] * axis)
    return found


def _turned(vectors: FloatArray, axis: FloatArray) -> FloatArray:
    turned: FloatArray = np.einsum("fij,j->fi", _rotations(vectors), axis)
    return turned


def _rotations(vectors: FloatArray) -> FloatArray:
    """Return (F, 3, 3) of rotation vectors (F, 3), rad."""
    turned: FloatArray = Rotation.from_rotvec(vectors).as_matrix()
    return turned
