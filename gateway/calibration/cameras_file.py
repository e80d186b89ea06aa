"""The file of calibrated cameras: what ``calibrate cameras`` writes and ``video`` reads.

up: z                        # axis of the world that points up
cameras:
  - name: cam01
    size: [1088, 1920]       # pixels, width and height
    matrix: [[1681, 0, 533], [0, 1681, 948], [0, 0, 1]]
    distortion: [-0.046, 0.14, 0.0006, 0.0007, 0]      # k1, k2, p1, p2, k3 of OpenCV
    rotation: [[…], […], […]]                          # world axes to camera axes (x right, y down)
    translation: [0.4, 0.1, 3.2]                       # m, the world's origin in camera axes
    reprojection_px: 0.31                              # RMS of the calibration, if known
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field

from gateway.body.camera import Camera, CameraEntry, entry_of
from gateway.calibration.cameras_import import import_cameras, is_opencv
from gateway.errors import SettingsError
from gateway.frames import FloatArray
from gateway.support.settings_files import load_settings

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
_NEAREST_M, _FARTHEST_M = 0.02, 500.0
AXES: tuple[Axis, ...] = ("x", "y", "z", "-x", "-y", "-z")


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CamerasFile(_Strict):
    """All cameras of one world."""

    up: Axis = "z"
    cameras: list[CameraEntry] = Field(min_length=1)


def load_cameras(path: Path, up: Axis | None = None, unit: str = "m") -> tuple[Camera, ...]:
    """Load cameras in a world whose Z points up, of our file or another program's (``import_cameras``).

    up: axis of the file's world that points up; None: as our file says, z for others. Raises
    ``SettingsError``, also for two cameras of one name.
    """
    if path.suffix.lower() == ".yaml" and not is_opencv(path):
        content = load_settings(path, CamerasFile)
        cameras = tuple(entry.camera(str(path)) for entry in content.cameras)
        up = up or content.up
    else:
        cameras = import_cameras(path, unit)
    names = [camera.name for camera in cameras]
    for name in names:
        if names.count(name) > 1:
            raise SettingsError(f"{path}: two cameras are named '{name}'")
    # Lengths are checked before anything is made of them: they decide whether rays meet.
    _refuse_wrong_unit(cameras, path)
    return upright(cameras, up or "z")


def _refuse_wrong_unit(cameras: Sequence[Camera], path: Path) -> None:
    """Raise ``SettingsError`` if cameras stand kilometres or millimetres apart: the unit must be wrong."""
    places = np.array([camera.position for camera in cameras])
    apart = float(np.linalg.norm(np.ptp(places, axis=0)))
    if len(cameras) > 1 and not _NEAREST_M < apart < _FARTHEST_M:
        raise SettingsError(
            f"{path}: its cameras stand within {apart:.3g} m: the lengths are of another unit (--unit mm or "
            "--unit cm when importing; a .yaml file has metres)"
        )


def axis_of(text: str) -> Axis:
    """Return the axis that ``--up`` names. Raises ``SettingsError``."""
    for axis in AXES:
        if axis == text:
            return axis
    raise SettingsError(f"--up {text}: one of {', '.join(AXES)} is wanted")


def upright(cameras: Iterable[Camera], up: Axis) -> tuple[Camera, ...]:
    """Return the cameras in a world turned so that its axis ``up`` becomes Z."""
    turn = _TURNS[up]  # given world axes to upright ones
    return tuple(replace(camera, rotation=camera.rotation @ turn.T) for camera in cameras)


def _cyclic(shift: int, sign: float) -> FloatArray:
    """Return a rotation that takes the axis ``shift`` steps before Z to ±Z."""
    turn = np.roll(np.eye(3), shift, axis=0)
    return turn if sign > 0 else np.diag([1.0, -1.0, -1.0]) @ turn


_TURNS: Mapping[str, FloatArray] = {
    "z": np.eye(3),
    "-z": _cyclic(0, -1.0),
    "y": _cyclic(1, 1.0),
    "-y": _cyclic(1, -1.0),
    "x": _cyclic(2, 1.0),
    "-x": _cyclic(2, -1.0),
}


def cameras_text(cameras: Sequence[Camera], reprojection_px: Sequence[float] | None = None) -> str:
    """Return the text of the file, in a world with Z up, every number in full precision."""
    entries: list[dict[str, Any]] = []
    for index, camera in enumerate(cameras):
        entry = entry_of(camera)
        if reprojection_px is not None:
            entry["reprojection_px"] = round(float(reprojection_px[index]), 4)
        entries.append(entry)
    content = {"up": "z", "cameras": entries}
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
