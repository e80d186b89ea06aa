"""A recording for Foxglove: see ``gateway.contract.foxglove_messages``."""

from __future__ import annotations

import json
from pathlib import Path

from gateway.contract.foxglove_messages import ANGLES, SCENE, TRANSFORMS, FoxgloveEncoder
from gateway.recording.exporters.message_file import MessageFile, poses_of
from gateway.recording.exporters.take import Take

_SCENE_EVERY_NS = 5_000_000_000
"""Bones are repeated, so that a part of the file shows them too."""


def write(take: Take, path: Path, units_per_m: float) -> None:
    """Write a take as MCAP for Foxglove: metres, z up. Raises ``GatewayError`` without the extra
    ``foxglove``, ``OSError``."""
    encoder = FoxgloveEncoder(take.skeleton)
    with MessageFile(path, "") as file:
        transforms = file.channel(TRANSFORMS, encoder.schema("FrameTransforms"), "protobuf")
        scene = file.channel(SCENE, encoder.schema("SceneUpdate"), "protobuf")
        angles = None
        if take.skeleton.joints:
            schema = ("mocap.JointAngles", "jsonschema", json.dumps(encoder.angles_schema()).encode())
            angles = file.channel(ANGLES, schema, "json")
        scene_due_ns = take.begun_ns
        for time_ns, q_wb, p_w in poses_of(take):
            # The scene does not change, but a player that begins in the middle needs it soon.
            if time_ns >= scene_due_ns:
                file.add(scene, time_ns, encoder.scene(time_ns).encode())
                scene_due_ns = time_ns + _SCENE_EVERY_NS
            file.add(transforms, time_ns, encoder.transforms(time_ns, q_wb, p_w).encode())
            if angles is not None:
                file.add(angles, time_ns, json.dumps(encoder.angles(q_wb)).encode())
