"""Cameras in OpenCV's own YAML and XML files.

Two layouts are known: one camera a file, as OpenCV's calibration samples write it (``camera_matrix``,
``distortion_coefficients``, ``image_width``), named after the file, with ``R``/``T`` or ``rvec``/``tvec``;
and all cameras in one file under ``names``, with ``K_name``, ``dist_name``, ``R_name`` or ``Rot_name``,
``T_name``, ``H_name``, ``W_name``, whose inner and outer halves may be ``intri.yml`` and ``extri.yml``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gateway.errors import SettingsError
from gateway.frames import FloatArray

_MATRIX = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "K", "M")
_DISTORTION = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist", "D")
_WIDTH = ("image_width", "image_Width", "width", "W")
_HEIGHT = ("image_height", "image_Height", "height", "H")
_ROTATION = ("Rot", "R", "rvec", "rotation")
_TRANSLATION = ("T", "tvec", "t", "translation")
_HALVES = {"intri.yml": "extri.yml", "extri.yml": "intri.yml"}


@dataclass(frozen=True)
class StoredCamera:
    """As it stands in the file."""

    name: str
    width: int
    height: int
    matrix: FloatArray  # (3, 3)
    distortion: FloatArray  # (n,) in OpenCV's order
    rotation: FloatArray  # (3, 3), or (3,) as a rotation vector; world to camera
    translation: FloatArray  # (3,) in the file's unit


def read_opencv(path: Path) -> tuple[StoredCamera, ...]:
    """Return all cameras of a file. Raises ``SettingsError`` naming what is missing."""
    storages = [_opened(path)]
    other = path.with_name(_HALVES.get(path.name, path.name))
    if other != path and other.is_file():
        storages.append(_opened(other))
    names = next((node for node in _nodes(storages, ["names"])), None)
    if names is None:
        return (_stored(storages, path.stem, "", path),)
    listed = [names.at(index).string() for index in range(names.size())]
    return tuple(_stored(storages, name, f"_{name}", path) for name in listed)


def _opened(path: Path) -> cv2.FileStorage:
    if not path.is_file():
        raise SettingsError(f"{path}: no such file")
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError):
        raise SettingsError(f"{path}: is no file of OpenCV's (YAML or XML)") from None
    if not storage.isOpened():
        raise SettingsError(f"{path}: is no file of OpenCV's (YAML or XML)")
    return storage


def _nodes(storages: Iterable[cv2.FileStorage], keys: Iterable[str]) -> Iterable[cv2.FileNode]:
    for key in keys:
        for storage in storages:
            node = storage.getNode(key)
            if not node.empty():
                yield node


def _stored(storages: list[cv2.FileStorage], name: str, ending: str, path: Path) -> StoredCamera:
    def array(keys: tuple[str, ...], sizes: tuple[int, ...] | None) -> FloatArray:
        wanted = [f"{key}{ending}" for key in keys]
        node = next(iter(_nodes(storages, wanted)), None)
        values = None if node is None else node.mat()
        if values is None:
            other = _HALVES.get(path.name)
            beside = f" (nor has {other} beside it)" if other else ""
            raise SettingsError(f"{path}: camera '{name}' has no matrix {' or '.join(wanted)}{beside}")
        if sizes is not None and values.size not in sizes:
            raise SettingsError(f"{path}: {wanted[0]} of camera '{name}' has {values.size} numbers")
        return np.asarray(values, dtype=np.float64)

    def number(keys: tuple[str, ...]) -> int:
        wanted = [f"{key}{ending}" for key in keys]
        node = next(iter(_nodes(storages, wanted)), None)
        if node is None or not (node.isInt() or node.isReal()):
            raise SettingsError(
                f"{path}: camera '{name}' has no picture size ({' or '.join(wanted)}): add a line such as "
                f"{wanted[-1]}: 1080, in pixels"
            )
        return int(node.real())

    rotation = array(_ROTATION, (3, 9))
    return StoredCamera(
        name=name,
        width=number(_WIDTH),
        height=number(_HEIGHT),
        matrix=array(_MATRIX, (9,)).reshape(3, 3),
        distortion=array(_DISTORTION, None).ravel(),
        rotation=rotation.reshape(3, 3) if rotation.size == 9 else rotation.ravel(),
        translation=array(_TRANSLATION, (3,)).ravel(),
    )
