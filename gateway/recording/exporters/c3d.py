"""C3D: joint centres and tips as points, segment rotations, joint angles; by the library ezc3d."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import numpy as np

from gateway.frames import FloatArray
from gateway.recording.exporters.take import Take, markers_of, rotation
from gateway.support.extras import require_package

_BLOCK_BYTES = 512
_POINT_BYTES = 4 * 4
"""x, y, z and the residual."""
_ROTATION_BYTES = 17 * 4
"""A 4 × 4 matrix and how reliable it is."""
_UNITS = {1.0: "m", 100.0: "cm", 1000.0: "mm"}
_MOST_IN_HEADER = 2**16 - 1
_WORDS = 2
"""Type of parameters that are integers of 16 bits."""


def write(take: Take, path: Path, units_per_m: float) -> None:
    """Write a take as C3D. Raises ``GatewayError`` without the extra ``export``, ``OSError``.

    Points are ``<segment>``, ``<segment>_tip``, one a joint in degrees (listed in POINT:ANGLES), and the
    markers that the poses were made from, with their distances from the body as residuals (negative: not
    seen). The segments' 4 × 4 matrices stand under ROTATION.
    """
    require_package("ezc3d")
    import ezc3d  # noqa: PLC0415 - an extra

    segments, joints = take.skeleton.segment_names, [joint.name for joint in take.skeleton.joints]
    angle_labels = [f"{name}_angles" for name in joints]
    places = np.concatenate([take.p_w, take.tips_w], axis=1) * units_per_m
    angles = np.nan_to_num(np.degrees(take.joint_angles)).reshape(len(places), len(joints), 3)
    points, residuals = np.concatenate([places, angles], axis=1), np.zeros((len(places), 0))
    labels = [*segments, *(f"{name}_tip" for name in segments), *angle_labels]
    if (markers := markers_of(take)) is not None:
        labels += markers.labels
        points = np.concatenate([points, np.nan_to_num(markers.positions * units_per_m)], axis=1)
        residuals = np.where(np.isnan(markers.residuals), -1.0, markers.residuals * units_per_m)
    file = ezc3d.c3d()
    file.add_parameter("POINT", "LABELS", labels)
    file.add_parameter("POINT", "ANGLES", angle_labels)
    file.add_parameter("POINT", "UNITS", [_UNITS.get(units_per_m, "mm")])
    file.add_parameter("POINT", "RATE", [take.rate_hz])
    file.add_parameter("ANALOG", "RATE", [take.rate_hz])
    file.add_parameter("ROTATION", "LABELS", list(segments))
    file.add_parameter("ROTATION", "RATE", [take.rate_hz])
    _number_frames(file, take)
    file["data"]["points"] = _homogeneous(points)
    known = np.zeros((len(points), points.shape[1] - residuals.shape[1]))
    file["data"]["meta_points"]["residuals"] = np.concatenate([known, residuals], axis=1).T[None]
    file["data"]["rotations"] = _matrices(take, units_per_m)
    file["data"]["analogs"] = np.zeros((1, 0, len(points)))
    file.write(str(path))
    _refuse_a_part(path, len(points) * (points.shape[1] * _POINT_BYTES + len(segments) * _ROTATION_BYTES))


def _refuse_a_part(path: Path, data_bytes: int) -> None:
    """Raise ``OSError`` for a file without all its data: the library says nothing of a disk that is full."""
    with path.open("rb") as file:
        first_block = int.from_bytes(file.read(18)[16:], "little")
    if path.stat().st_size < max(first_block - 1, 0) * _BLOCK_BYTES + data_bytes:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def _number_frames(file: Any, take: Take) -> None:
    """Number the frames, the one at 0 s as 1.

    The header's numbers have 16 bits: later frames are counted from 1 there, and their numbers of 32 bits
    stand in two words each under TRIAL, as Vicon writes them.
    """
    first = max(1, 1 + round(take.begins_s * take.rate_hz))
    last = first + len(take.q_wb) - 1
    if last < _MOST_IN_HEADER:
        file["header"]["points"]["first_frame"] = first - 1  # the library counts from zero
        return
    for name, number in (("ACTUAL_START_FIELD", first), ("ACTUAL_END_FIELD", last)):
        file.add_parameter("TRIAL", name, [0, 0])
        words = np.array(divmod(number, 2**16))[::-1]
        file["parameters"]["TRIAL"][name].update(type=_WORDS, value=words)


def _homogeneous(points: FloatArray) -> FloatArray:
    """Return points (F, N, 3) in the library's layout (4, N, F)."""
    ones = np.ones((*points.shape[:2], 1))
    return np.concatenate([points, ones], axis=2).transpose(2, 1, 0)


def _matrices(take: Take, units_per_m: float) -> FloatArray:
    """Return rotation and place of the proximal joint of every segment, (4, 4, S, F)."""
    frames, segments = take.q_wb.shape[:2]
    pose = np.zeros((frames, segments, 4, 4))
    pose[..., :3, :3] = rotation(take.q_wb).as_matrix().reshape(frames, segments, 3, 3)
    pose[..., :3, 3] = take.p_w * units_per_m
    pose[..., 3, 3] = 1.0
    return pose.transpose(2, 3, 1, 0)
