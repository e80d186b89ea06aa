"""A skeleton frame as the bytes of a pose message.

Runs for every published frame, so it goes round the ``PoseMessage`` model: whole arrays are rounded
and turned into lists at once, and what seldom changes (the status of the segments) is kept.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
import orjson
import ormsgpack

from gateway.body.joint_angles import JointAngles
from gateway.contract.messages import STATUS_NAMES
from gateway.frames import FloatArray, SkeletonFrame, StatusArray
from gateway.outputs.settings import PoseMap

_ATTRIBUTES: dict[PoseMap, str] = {
    PoseMap.POSITION: "p_w",
    PoseMap.ACCELERATION: "joint_acceleration",
    PoseMap.ANGULAR_RATE: "angular_rate",
    PoseMap.SIGMA: "sigma",
}
_ANGLE_DECIMALS = 3
_WARNINGS = ("near_gimbal_lock", "beyond_limits")

Plain = dict[str, Any]
"""JSON values."""


def as_json(message: Plain) -> bytes:
    """A message as JSON."""
    return orjson.dumps(message)


def as_msgpack(message: Plain) -> bytes:
    """The same fields as MessagePack."""
    return ormsgpack.packb(message)


def segment_messages(pose: Plain) -> Iterator[tuple[str, Plain]]:
    """The fields of a ``SegmentMessage`` for every segment of a pose, by name."""
    head = {key: pose[key] for key in ("t_ns", "seq", "frame", "order")}
    maps: list[str] = [name.value for name in _ATTRIBUTES if name.value in pose]
    for name, orientation in pose["segments"].items():
        rest = {key: pose[key][name] for key in maps}
        yield name, {**head, "orientation": orientation, "status": pose["status"][name], **rest}


class PoseEncoder:
    """Encodes the frames of one skeleton.

    segment_names: in the order of the rows of the frames.
    decimals: numbers are rounded to so many; None: full precision.
    include: optional maps beside the orientations.
    joint_angles: of the same skeleton, for the map of that name; the angles are continuous over the frames
    that are encoded. Without it there are none.
    """

    def __init__(
        self,
        segment_names: tuple[str, ...],
        decimals: int | None = 6,
        include: Collection[PoseMap] = (),
        joint_angles: JointAngles | None = None,
    ) -> None:
        self._names = segment_names
        self._decimals = decimals
        self._maps = tuple((name.value, _ATTRIBUTES[name]) for name in _ATTRIBUTES if name in include)
        self._joint_angles = joint_angles if PoseMap.JOINT_ANGLES in include else None
        self._status_key = b""
        self._status: dict[str, str] = {}

    def encode(self, frame: SkeletonFrame) -> bytes:
        """JSON bytes of a ``PoseMessage``."""
        return as_json(self.message(frame))

    def message(self, frame: SkeletonFrame) -> Plain:
        """The fields of a ``PoseMessage``. Raises ``ValueError`` for a frame of another skeleton."""
        message: Plain = {
            "t_ns": frame.time_ns,
            "seq": frame.sequence,
            "frame": "ENU",
            "order": "wxyz",
            "root": self._names[frame.root],
            "segments": dict(zip(self._names, self._rows(frame.q_wb), strict=True)),
            "status": self._status_names(frame.status),
        }
        for key, attribute in self._maps:
            values = self._rows(getattr(frame, attribute))
            message[key] = dict(zip(self._names, values, strict=True))
        if self._joint_angles is not None:
            message |= self._joints(self._joint_angles, frame.q_wb)
        return message

    def _rows(self, values: FloatArray) -> list[object]:
        """Rows as JSON values; a row that is not finite throughout is None."""
        # Adding zero makes -0.0 a plain 0.0.
        rounded = values if self._decimals is None else np.round(values, self._decimals) + 0.0
        rows: list[object] = rounded.tolist()
        is_finite = np.isfinite(rounded)
        if is_finite.all():
            return rows
        is_defined = np.logical_and.reduce(is_finite.reshape(len(rows), -1), axis=1)
        return [row if defined else None for row, defined in zip(rows, is_defined, strict=True)]

    def _joints(self, joint_angles: JointAngles, q_wb: FloatArray) -> dict[str, object]:
        """Angles in degrees by joint and name, and the joints whose angles need care."""
        found = joint_angles.update(q_wb)
        rows = np.degrees(found.angles)
        rounded = (
            rows if self._decimals is None else np.round(rows, min(self._decimals, _ANGLE_DECIMALS)) + 0.0
        )
        joints = joint_angles.joints
        return {
            "joint_angles": {
                joint.name: None
                if np.isnan(row[0])
                else dict(zip((angle.name for angle in joint.angles), row.tolist(), strict=False))
                for joint, row in zip(joints, rounded, strict=True)
            },
            "joint_warnings": {
                joint.name: [word for word, applies in zip(_WARNINGS, flags, strict=True) if applies]
                for joint, *flags in zip(joints, found.near_gimbal, found.beyond_limits, strict=True)
                if any(flags)
            },
        }

    def _status_names(self, status: StatusArray) -> dict[str, str]:
        key = status.tobytes()
        if key != self._status_key:
            names = (STATUS_NAMES[value] for value in key)
            self._status_key, self._status = key, dict(zip(self._names, names, strict=True))
        return self._status
