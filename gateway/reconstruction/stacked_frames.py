"""Many frames in arrays: what methods are given in one call, and what they give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.frames import FloatArray, ImuFrame, IntArray, SkeletonFrame, StatusArray

POSE_ARRAYS = ("q_wb", "angular_rate", "joint_acceleration", "p_w", "sigma", "status")
"""Of a ``SkeletonFrame``."""


class StackedFrames(NamedTuple):
    """T instants of m modules in sensor axes, as in ``ImuFrame``."""

    time_ns: IntArray  # (T,)
    specific_force: FloatArray  # (T, m, 3)
    angular_rate: FloatArray  # (T, m, 3)
    magnetic_field: FloatArray  # (T, m, 3)
    status: StatusArray  # (T, m)
    clipped: StatusArray  # (T, m)


def stacked(frames: Sequence[ImuFrame]) -> StackedFrames:
    """Return copies of what frames hold, in arrays that a kernel may change."""
    n_modules = len(frames[0].status)
    clipped = np.zeros((len(frames), n_modules), np.uint8)
    for t, frame in enumerate(frames):
        if frame.clipped is not None:
            clipped[t] = frame.clipped
    return StackedFrames(
        np.array([frame.time_ns for frame in frames], np.int64),
        _stacked([frame.specific_force for frame in frames], np.float64),
        _stacked([frame.angular_rate for frame in frames], np.float64),
        _stacked([frame.magnetic_field for frame in frames], np.float64),
        _stacked([frame.status for frame in frames], np.uint8),
        clipped,
    )


def _stacked(arrays: list[NDArray[Any]], dtype: type) -> NDArray[Any]:
    """Return the arrays as one, (T, …), copied.

    A read-only or strided array would have the kernel compiled again.
    """
    if len(arrays) == 1:  # three times as fast
        return np.array(arrays[0], dtype, order="C", ndmin=arrays[0].ndim + 1)
    return np.array(arrays, dtype, order="C")


def unstacked(observations: Sequence[ImuFrame], frames: StackedFrames) -> list[ImuFrame]:
    """Return frames with the values that stand in arrays."""
    return [
        replace(one, specific_force=force, angular_rate=rate, magnetic_field=field, status=status)
        for one, force, rate, field, status in zip(observations, *frames[1:5], strict=True)
    ]


class PoseArrays(NamedTuple):
    """T poses of n segments, as in ``SkeletonFrame``, for kernels that change them in place."""

    q_wb: FloatArray  # (T, n, 4)
    angular_rate: FloatArray  # (T, n, 3)
    joint_acceleration: FloatArray  # (T, n, 3)
    p_w: FloatArray  # (T, n, 3)
    sigma: FloatArray  # (T, n)
    status: StatusArray  # (T, n)
    root: IntArray  # (T,)


class Poses(NamedTuple):
    """What a finder has found of T instants, arrays of its own that may be changed in place."""

    sequence: Sequence[int]
    time_ns: Sequence[int]
    q_wb: FloatArray  # (T, n, 4)
    angular_rate: FloatArray  # (T, n, 3)
    joint_acceleration: FloatArray  # (T, n, 3)
    p_w: FloatArray  # (T, n, 3)
    sigma: FloatArray  # (T, n)
    status: StatusArray  # (T, n)
    root: IntArray  # (T,)

    def arrays(self) -> PoseArrays:
        """Return what a kernel can change. Raises ``ValueError`` for arrays that are not in C order."""
        if not all(array.flags.carray for array in self[2:]):
            raise ValueError("poses must lie in arrays of C order, or kernels read other memory")
        return PoseArrays(*self[2:])

    def frames(self) -> list[SkeletonFrame]:
        """Return the poses one by one, as views."""
        return [
            SkeletonFrame(sequence, time_ns, q_wb, rate, acceleration, p_w, sigma, status, root)
            for sequence, time_ns, q_wb, rate, acceleration, p_w, sigma, status, root in zip(
                self.sequence, self.time_ns, *self[2:8], self.root.tolist(), strict=True
            )
        ]


def stacked_poses(poses: Sequence[SkeletonFrame]) -> Poses:
    """Return copies of what poses of modules hold, in arrays."""
    return Poses(
        [pose.sequence for pose in poses],
        [pose.time_ns for pose in poses],
        _stacked([pose.q_wb for pose in poses], np.float64),
        _stacked([pose.angular_rate for pose in poses], np.float64),
        _stacked([pose.joint_acceleration for pose in poses], np.float64),
        _stacked([pose.p_w for pose in poses], np.float64),
        _stacked([pose.sigma for pose in poses], np.float64),
        _stacked([pose.status for pose in poses], np.uint8),
        np.array([pose.root for pose in poses], np.int64),
    )
