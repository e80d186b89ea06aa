"""Cameras as a local device of somebody with modules: the entry of a rig file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import Field

from gateway.body.skeleton import CameraPosition, WornSuit
from gateway.errors import SettingsError
from gateway.support.settings_files import Strict


class PositionCameras(Strict):
    """Cameras that locate the wearer of the modules."""

    subject: str = Field(description="file of `video solve --fit-subject`: the person and the cameras")
    device: int = Field(ge=0, le=63, description="id of the local device of kind position")
    sigma_mm: float = Field(default=20, gt=0, le=1000, description="standard deviation of each coordinate")
    latency_ms: float = Field(
        default=0, ge=0, le=5000, description="from a picture to the arrival of its heat maps, at the least"
    )
    turn_deg: float = Field(
        default=0,
        ge=-360,
        le=360,
        description="from east to the X axis of the cameras' world, counter-clockwise seen from above",
    )

    def worn(self, person: WornSuit, positions: Sequence[int | None], path: Path) -> CameraPosition:
        """Return the cameras as the suit has them.

        person: that the subject's file describes; positions: ids of the rig's local devices of kind position.
        Raises ``SettingsError``, which names ``path``, where there is no such device, or the file names no
        cameras.
        """
        if self.device not in positions:
            raise SettingsError(
                f"{path}: cameras: no local device of kind 'position' has the id {self.device}: add one, "
                f"such as {{kind: position, device: {self.device}, segment: pelvis}}"
            )
        if person.video is None:
            raise SettingsError(
                f"{path}: cameras: '{self.subject}' names no cameras: one that does is written "
                "by `mocap-gateway video solve --fit-subject`"
            )
        return CameraPosition(
            person,
            self.device,
            self.sigma_mm * 1e-3,
            round(self.latency_ms * 1e6),
            float(np.radians(self.turn_deg)),
        )
