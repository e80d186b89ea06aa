"""Calibrations of cameras as other programs write them: Qualisys, TOML (Pose2Sim, anipose), OpenCV.

All give ``Camera`` in the axes of their own world, m; ``cameras_file`` turns the world upright.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import ParseError, fromstring

from gateway.body.camera import Camera, checked
from gateway.errors import SettingsError
from gateway.frames import FloatArray
from gateway.geometry.rotation_matrix import from_rotation_vector

_QUALISYS_SUBPIXELS = 64.0
"""Qualisys counts picture lengths in 64ths of a pixel (its distortion coefficients are plain numbers)."""
_BACKWARD_TO_FORWARD = np.diag([1.0, -1.0, -1.0])
"""Qualisys' camera axes are x right, y up, z out of the lens backwards."""
_TOML_UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}


def import_cameras(path: Path, unit: str = "m") -> tuple[Camera, ...]:
    """Read the cameras of a file by another program, recognised by what is in it, or of a folder with a file
    of OpenCV's for each camera. Raises ``SettingsError``.

    unit: of lengths in TOML and OpenCV files, which do not name theirs: m, cm or mm.
    """
    if unit not in _TOML_UNITS:
        raise SettingsError(f"unit '{unit}': one of {', '.join(_TOML_UNITS)} is wanted")
    metres = _TOML_UNITS[unit]
    if path.is_dir():
        cameras = _read_folder(path, metres)
    elif is_opencv(path):
        cameras = _read_opencv(path, metres)
    elif _text(path).startswith("<") or ".qca" in path.name.lower():
        cameras = _read_qualisys(path)
    elif path.suffix.lower() == ".toml":
        cameras = _read_toml(path, metres)
    else:
        raise SettingsError(
            f"{path}: is no calibration of cameras: neither of Qualisys (.qca.txt), nor in TOML (Pose2Sim, "
            "anipose), nor in YAML or XML of OpenCV"
        )
    if not cameras:
        raise SettingsError(f"{path}: holds no camera")

    for camera in cameras:
        checked(camera, str(path))
    return cameras


def is_opencv(path: Path) -> bool:
    """Return whether a file is OpenCV's YAML or XML, by its name or its beginning."""
    beginning = _text(path)[:200]
    return path.suffix.lower() == ".yml" or beginning.startswith("%YAML") or "<opencv_storage" in beginning


def _read_folder(folder: Path, metres: float) -> tuple[Camera, ...]:
    """Read a folder of files of OpenCV's: one a camera, or one for all and one that completes it."""
    files = sorted(each for each in folder.iterdir() if each.suffix.lower() in (".yml", ".yaml", ".xml"))
    files = [each for each in files if is_opencv(each)]
    if not files:
        raise SettingsError(f"{folder}: has no file of OpenCV's (.yml, .yaml or .xml)")
    whole = next((each for each in files if each.stem == "intri"), None)
    if whole is not None:
        return _read_opencv(whole, metres)
    return tuple(camera for each in files for camera in _read_opencv(each, metres))


def _read_qualisys(path: Path) -> tuple[Camera, ...]:
    """Read a Qualisys calibration; its lengths are in mm.

    The transform's rows are the camera's axes in the world, and its place is in world axes.
    """
    try:
        root = fromstring(_text(path))
    except (ParseError, DefusedXmlException) as error:
        raise SettingsError(f"{path}: is no Qualisys calibration: {error}") from error
    return tuple(_qualisys_camera(element, path) for element in root.iterfind("cameras/camera"))


def _qualisys_camera(element: Element, path: Path) -> Camera:
    name = element.get("serial", "?")
    field = _fields_of(element, f"{path}: camera '{name}'")
    view, lens, place = field("fov_video_max"), field("intrinsic"), field("transform")
    left, top = view("left"), view("top")
    # Qualisys counts lengths in fractions of a pixel, from the sensor's corner and not the picture's.
    length = {key: lens(key) / _QUALISYS_SUBPIXELS for key in _QUALISYS_LENGTHS}
    axes = np.array([[place(f"r{row}{column}") for column in (1, 2, 3)] for row in (1, 2, 3)])
    rotation = _BACKWARD_TO_FORWARD @ axes
    position = 1e-3 * np.array([place(axis) for axis in "xyz"])
    return Camera(
        name=name,
        width=int(view("right") - left) + 1,
        height=int(view("bottom") - top) + 1,
        matrix=np.array(
            [
                [length["focalLengthU"], 0.0, length["centerPointU"] - left],
                [0.0, length["focalLengthV"], length["centerPointV"] - top],
                [0.0, 0.0, 1.0],
            ]
        ),
        distortion=np.array([lens(key) for key in _QUALISYS_DISTORTION]),
        rotation=rotation,
        translation=-rotation @ position,
    )


_QUALISYS_LENGTHS = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
_QUALISYS_DISTORTION = (
    "radialDistortion1",
    "radialDistortion2",
    "tangentalDistortion1",
    "tangentalDistortion2",
    "radialDistortion3",
)


def _fields_of(element: Element, where: str) -> Callable[[str], Callable[[str], float]]:
    def field(tag: str) -> Callable[[str], float]:
        found = element.find(tag)
        if found is None:
            raise SettingsError(f"{where} has no <{tag}>")

        def number(key: str) -> float:
            text = found.get(key, "")
            try:
                return float(text)
            except ValueError:
                raise SettingsError(f"{where}: <{tag} {key}> is '{text}', not a number") from None

        return number

    return field


def _read_toml(path: Path, metres: float) -> tuple[Camera, ...]:
    """Read a TOML calibration: a table per camera, at the top or below ``cameras``.

    ``metadata`` of anipose and Pose2Sim is skipped, and so are cameras that Caliscope was told to ignore.
    """
    try:
        content = tomllib.loads(_text(path))
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{path}: is not TOML: {error}") from error
    # anipose and Pose2Sim have their tables at the top, Caliscope below one name.
    below = content.get("cameras")
    if isinstance(below, dict):
        content = {f"cam_{key}" if key.isdigit() else key: table for key, table in below.items()}
    tables = {key: table for key, table in content.items() if isinstance(table, dict) and "matrix" in table}
    return tuple(
        _toml_camera(key, table, metres, f"{path}: [{key}]")
        for key, table in tables.items()
        if not table.get("ignore")
    )


def _toml_camera(key: str, table: Mapping[str, Any], metres: float, where: str) -> Camera:
    if table.get("fisheye"):
        raise SettingsError(f"{where} is a fisheye camera: undistort its pictures first")
    width, height = _numbers(table, "size", (2,), where)
    # A rotation vector in some programs, a matrix in others: the count of numbers decides.
    turn = _numbers(table, "rotation", None, where)
    if turn.size not in (3, 9):
        raise SettingsError(
            f"{where}: 'rotation' has {turn.size} numbers: a rotation vector or a matrix is wanted"
        )
    return Camera(
        name=str(table.get("name", key)),
        width=int(width),
        height=int(height),
        matrix=_numbers(table, "matrix", (3, 3), where),
        distortion=five_coefficients(_numbers(table, "distortions", None, where), where),
        rotation=turn.reshape(3, 3) if turn.size == 9 else from_rotation_vector(turn),
        translation=metres * _numbers(table, "translation", (3,), where),
    )


def _numbers(table: Mapping[str, Any], key: str, shape: Sequence[int] | None, where: str) -> FloatArray:
    try:
        values = np.array(table[key], dtype=np.float64)
    except KeyError:
        raise SettingsError(f"{where} has no '{key}'") from None
    except (TypeError, ValueError):
        raise SettingsError(f"{where}: '{key}' is {str(table[key])[:60]}, not numbers") from None
    if shape is None:
        return values.ravel()
    if values.size != np.prod(shape):
        raise SettingsError(f"{where}: '{key}' has {values.size} numbers, not {'×'.join(map(str, shape))}")
    return values.reshape(shape)


def five_coefficients(given: FloatArray, where: str) -> FloatArray:
    """Return k1, k2, p1, p2, k3 (5,) of those given (n,); those that a file lacks are zero.

    Raises ``SettingsError`` for the rational and thin-prism models.
    """
    if len(given) > 5 and np.any(given[5:]):
        raise SettingsError(
            f"{where}: {len(given)} distortion coefficients; the model has five (k1, k2, p1, p2, k3): "
            "calibrate without the rational and thin-prism models"
        )
    coefficients = np.zeros(5)
    coefficients[: min(len(given), 5)] = given[:5]
    return coefficients


def _read_opencv(path: Path, metres: float) -> tuple[Camera, ...]:
    from gateway.calibration.opencv_storage import read_opencv  # noqa: PLC0415 - OpenCV is an extra

    return tuple(
        Camera(
            name=entry.name,
            width=entry.width,
            height=entry.height,
            matrix=entry.matrix,
            distortion=five_coefficients(entry.distortion, f"{path}: camera '{entry.name}'"),
            rotation=entry.rotation if entry.rotation.size == 9 else from_rotation_vector(entry.rotation),
            translation=metres * entry.translation,
        )
        for entry in read_opencv(path)
    )


def _text(path: Path) -> str:
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read: {error.strerror}") from error
    return re.sub(r"^\s*", "", text)
