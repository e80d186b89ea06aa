"""Messages of Foxglove: transforms of the segments, their bones as a scene, joint angles for plots.

By the library of Foxglove (extra ``foxglove``). Bones are fixed to the frames of their segments, so that they
move with the transforms.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gateway.body.joint_angles import JointAngles
from gateway.body.skeleton import Skeleton
from gateway.contract.ros_messages import BodyTransforms
from gateway.frames import FloatArray
from gateway.geometry import quaternion
from gateway.support.extras import require_package

TRANSFORMS, SCENE, ANGLES = "/tf", "/body", "/joint_angles"
_BONE_RADIUS, _JOINT_RADIUS = 0.02, 0.03
"""m, of a person; thinner where a segment is shorter."""
_COLOUR = (0.35, 0.6, 0.85, 1.0)


def foxglove_messages() -> Any:
    """Return the library's messages. Raises ``GatewayError`` without the extra ``foxglove``."""
    require_package("foxglove")
    from foxglove import messages  # noqa: PLC0415 - an extra

    return messages


class FoxgloveEncoder:
    """What Foxglove shows of a body."""

    def __init__(self, skeleton: Skeleton) -> None:
        """Prepare to encode a skeleton. Raises ``GatewayError`` without the extra ``foxglove``."""
        self._library = foxglove_messages()
        self._skeleton = skeleton
        self._transforms = BodyTransforms(skeleton)
        self._joints = JointAngles(skeleton)

    def schema(self, name: str) -> tuple[str, str, bytes]:
        """Return name, encoding and data of a message's schema."""
        schema = getattr(self._library, name).get_schema()
        return schema.name, schema.encoding, schema.data

    def angles_schema(self) -> dict[str, Any]:
        """Return the JSON Schema of ``angles``: one type a property, or Foxglove refuses it."""
        number = {"type": "number", "description": "degrees, growing in the movement it names"}
        joints = {
            joint.name: {"type": "object", "properties": {angle.name: number for angle in joint.angles}}
            for joint in self._skeleton.joints
        }
        return {"type": "object", "properties": joints}

    def transforms(self, time_ns: int, q_wb: FloatArray, p_w: FloatArray) -> Any:
        """Return the ``FrameTransforms`` of a pose; segments that are not known are left out."""
        library, stamp = self._library, self._stamp(time_ns)
        known, places, turns = self._transforms.of(q_wb, p_w)
        names = [
            name for name, is_known in zip(self._transforms.names, known.tolist(), strict=True) if is_known
        ]
        made = [
            library.FrameTransform(
                timestamp=stamp,
                parent_frame_id=parent,
                child_frame_id=child,
                translation=library.Vector3(x=x, y=y, z=z),
                rotation=library.Quaternion(x=qx, y=qy, z=qz, w=qw),
            )
            for (parent, child), (x, y, z), (qw, qx, qy, qz) in zip(
                names, places.tolist(), turns.tolist(), strict=True
            )
        ]
        return library.FrameTransforms(transforms=made)

    def scene(self, time_ns: int) -> Any:
        """Return the ``SceneUpdate`` with a bone for every segment."""
        entities = [
            self._bone(time_ns, name, quaternion.rotate(self._skeleton.neutral, tip))
            for name, tip in zip(self._skeleton.segment_names, self._skeleton.tips, strict=True)
        ]
        return self._library.SceneUpdate(deletions=[], entities=entities)

    def angles(self, q_wb: FloatArray) -> dict[str, dict[str, float]]:
        """Return all joint angles that are known, by joint and movement, degrees."""
        found = np.degrees(self._joints.update(np.ascontiguousarray(q_wb)).angles).tolist()
        return {
            joint.name: {
                angle.name: value
                for angle, value in zip(joint.angles, row, strict=False)
                if not math.isnan(value)
            }
            for joint, row in zip(self._joints.joints, found, strict=True)
        }

    def _bone(self, time_ns: int, name: str, tip: FloatArray) -> Any:
        """Return a cylinder from the joint to the tip, and a ball at the joint, in the segment's frame."""
        library = self._library
        length = float(np.linalg.norm(tip))
        colour = library.Color(r=_COLOUR[0], g=_COLOUR[1], b=_COLOUR[2], a=_COLOUR[3])
        # Thinner bones for short segments, or a finger's joints would cover its bones.
        ball = 2 * min(_JOINT_RADIUS, max(length, 0.01) / 3)
        spheres = [
            library.SpherePrimitive(
                pose=self._pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])),
                size=library.Vector3(x=ball, y=ball, z=ball),
                color=colour,
            )
        ]
        cylinders = []
        if length > 0.0:
            wide = 2 * min(_BONE_RADIUS, length / 5)
            cylinders.append(
                library.CylinderPrimitive(
                    pose=self._pose(tip / 2, _from_z(tip / length)),
                    size=library.Vector3(x=wide, y=wide, z=length),
                    bottom_scale=1.0,
                    top_scale=0.6,
                    color=colour,
                )
            )
        return library.SceneEntity(
            timestamp=self._stamp(time_ns),
            frame_id=name,
            id=name,
            frame_locked=True,
            spheres=spheres,
            cylinders=cylinders,
        )

    def _pose(self, place: FloatArray, turn: FloatArray) -> Any:
        library = self._library
        x, y, z = place.tolist()
        qw, qx, qy, qz = turn.tolist()
        return library.Pose(
            position=library.Vector3(x=x, y=y, z=z), orientation=library.Quaternion(x=qx, y=qy, z=qz, w=qw)
        )

    def _stamp(self, time_ns: int) -> Any:
        return self._library.Timestamp(*divmod(time_ns, 1_000_000_000))


def _from_z(direction: FloatArray) -> FloatArray:
    """Return (4,) the shortest rotation that takes z to a unit vector."""
    x, y, z = direction.tolist()
    if z < -1 + 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    turn = np.array([1.0 + z, -y, x, 0.0])
    unit: FloatArray = turn / np.linalg.norm(turn)
    return unit
