"""C3D: the points of a trial, from any of the format's byte orders, as integers or as floats."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devices.marker_files.c3d_parameters import BLOCK, MIPS, Parameter, floats, read_parameters
from devices.marker_files.naming import without_prefixes
from devices.marker_files.trial import (
    METRES,
    FloatArray,
    MarkerTrial,
    assumed_metres,
    joined_pieces,
    metres_of,
    seen_points,
)
from devices.vendor_formats.sheets import FormatError

MAGIC = 0x50
"""Second byte of every C3D file."""
_LABEL_LISTS = 64
_NOT_IN_NAMES = re.compile(r"[\s_]+")
"""Programs write "MarkerDiameter", "Marker Diameter" and "Marker_Diameter"."""


@dataclass(frozen=True)
class C3DLayout:
    """Where the points lie, and how."""

    n_points: int
    analog_per_frame: int
    """Analog values of a frame: channels by samples."""
    n_frames: int
    scale: float
    """Negative: floats; else what integers are multiplied with."""
    start: int
    """Byte of the first frame."""
    processor: int
    first: int = 1
    """Number of the first frame; another than 1 where the trial was cut."""

    @property
    def value_bytes(self) -> int:
        """Bytes of one number: 4 of a float, 2 of an integer."""
        return 4 if self.scale < 0 else 2

    @property
    def frame_bytes(self) -> int:
        """Bytes of one frame, points and analog samples."""
        return (4 * self.n_points + self.analog_per_frame) * self.value_bytes


@dataclass(frozen=True)
class C3DFile:
    """A file taken apart, before its values are given a meaning."""

    path: Path
    content: bytes
    processor: int
    parameters: dict[str, Parameter]
    layout: C3DLayout

    def rows(self) -> FloatArray:
        """Return the values of all frames (F, 4 points + analog values) as stored.

        Raises ``FormatError`` without any.
        """
        return _rows(self.content, self.layout, self.path)

    def number(self, name: str, default: float) -> float:
        """Return the first value of a parameter ``GROUP:NAME``."""
        return _number(self.parameters, name, default)

    @property
    def rate_hz(self) -> float:
        """Frames a second. Raises ``FormatError``."""
        return _rate(self.content, self.parameters, self.processor, self.path)

    @property
    def notes(self) -> tuple[str, ...]:
        """What is odd about the file, and was got over."""
        whole = _whole_frames(self.content, self.layout)
        if whole == self.layout.n_frames:
            return ()
        return (
            f"{self.path}: cut off: {whole} whole frames of the {self.layout.n_frames} that its header has, "
            "and these are taken",
        )

    @property
    def begins_s(self) -> float:
        """Time of the first frame, of which number 1 is at 0 s. Raises ``FormatError`` as ``rate_hz``."""
        return max(0, self.layout.first - 1) / self.rate_hz


def read_c3d(path: Path) -> MarkerTrial:
    """Read all points of a file. Raises ``FormatError`` with what was found, and where in the file.

    A point is missing where its residual is negative, and where all its coordinates are exactly zero, as
    some systems write it.
    """
    file = open_c3d(path)
    points = _points(file.rows(), file.layout)
    factor, unit_notes = metres_per_unit(file.parameters, path), tuple[str, ...]()
    if not _unit(file.parameters):
        factor, unit_notes = assumed_metres(points, path)
    own = _labels(file.parameters, file.layout.n_points)
    labels, positions, label_notes = joined_pieces(own, seen_points(points * factor), path)
    return MarkerTrial(
        name=path.stem,
        labels=labels,
        rate_hz=file.rate_hz,
        positions=positions,
        parameters=_scalars(file.parameters),
        metres_per_unit=factor,
        begins_s=file.begins_s,
        notes=(*file.notes, *unit_notes, *label_notes),
    )


def open_c3d(path: Path) -> C3DFile:
    """Return the header and parameters read. Raises ``FormatError`` with what was found, and where in the
    file."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    if len(content) < BLOCK:
        raise FormatError(
            f"{path}: {len(content)} bytes, which is less than the header of a C3D file (512): "
            "copy or export it again"
        )
    if content[1] != MAGIC:
        raise FormatError(
            f"{path}: not a C3D file: byte 1 is {content[1]:#04x} and not 0x50: export the trial again"
        )
    processor, parameters = read_parameters(content, content[0], str(path))
    return C3DFile(path, content, processor, parameters, _layout(content, processor, parameters, path))


def _layout(content: bytes, processor: int, parameters: dict[str, Parameter], path: Path) -> C3DLayout:
    words = np.frombuffer(content[:BLOCK], ">u2" if processor == MIPS else "<u2")
    header_scale = floats(content[12:16], processor)[0]
    scale = _number(parameters, "POINT:SCALE", float(header_scale))
    first, last = int(words[3]), int(words[4])
    n_frames = last - first + 1
    actual = _actual_fields(parameters)
    actual_count = actual[1] - actual[0] + 1
    if last == 0xFFFF or n_frames <= 0:  # more frames than the header can count
        n_frames = int(_number(parameters, "POINT:FRAMES", n_frames))
        n_frames = int(_number(parameters, "POINT:LONG_FRAMES", max(0, actual_count) or n_frames))
    if actual_count == n_frames:
        first = actual[0]
    n_points = int(_number(parameters, "POINT:USED", float(words[1])))
    start = int(_number(parameters, "POINT:DATA_START", float(words[8])))
    if n_points <= 0 or n_frames <= 0:
        raise FormatError(
            f"{path}: {n_points} points in {n_frames} frames: no marker trajectories: export it with them"
        )
    if scale == 0 or not np.isfinite(scale) or start < 1:
        raise FormatError(f"{path}: POINT:SCALE {scale:g}, POINT:DATA_START {start}: the file is damaged")
    return C3DLayout(n_points, int(words[2]), n_frames, scale, (start - 1) * BLOCK, processor, first)


def _actual_fields(parameters: dict[str, Parameter]) -> tuple[int, int]:
    """Return the numbers of first and last frame in Vicon's parameters, 32 bits in two words; 1 and 0 if they
    are not there."""
    # The header's own numbers have 16 bits, which a long session exceeds.
    first, last = (
        parameters[name].numbers() if name in parameters else np.zeros(0)
        for name in ("TRIAL:ACTUAL_START_FIELD", "TRIAL:ACTUAL_END_FIELD")
    )
    if len(first) != 2 or len(last) != 2:
        return 1, 0
    return int(first[0] + 65536 * first[1]), int(last[0] + 65536 * last[1])


def _rows(content: bytes, layout: C3DLayout, path: Path) -> FloatArray:
    """Return the values of all frames (F, 4 points + analog values) as stored."""
    n_frames = _whole_frames(content, layout)
    end = layout.start + n_frames * layout.frame_bytes
    if n_frames == 0:
        raise FormatError(
            f"{path}: cut off: its frames begin at byte {layout.start}, it has {len(content)} bytes and no "
            "whole frame"
        )
    data = content[layout.start : end]
    # A negative scale says that points are stored as floating-point numbers.
    if layout.scale < 0:
        values = floats(data, layout.processor)
    else:
        values = np.frombuffer(data, ">i2" if layout.processor == MIPS else "<i2").astype(np.float64)
    return values.reshape(n_frames, -1)


def _whole_frames(content: bytes, layout: C3DLayout) -> int:
    """Return how many whole frames are there, of those that the header announces."""
    return min(layout.n_frames, max(0, len(content) - layout.start) // layout.frame_bytes)


def _points(rows: FloatArray, layout: C3DLayout) -> FloatArray:
    """Return the points (F, M, 3) in the file's unit; NaN where the residual is negative."""
    points = rows[:, : 4 * layout.n_points].reshape(len(rows), layout.n_points, 4)
    places: FloatArray = points[:, :, :3] * (1.0 if layout.scale < 0 else layout.scale)
    places[points[:, :, 3] < 0] = np.nan
    return places


def _rate(content: bytes, parameters: dict[str, Parameter], processor: int, path: Path) -> float:
    in_header = float(floats(content[20:24], processor)[0])
    rate = _number(parameters, "POINT:RATE", in_header) or in_header
    if not 0 < rate < 1e5:
        raise FormatError(f"{path}: POINT:RATE is {rate:g}: a number of frames a second is wanted")
    return rate


def metres_per_unit(parameters: dict[str, Parameter], path: Path) -> float:
    """Return metres per unit of the file's lengths. Raises ``FormatError`` for an unknown unit."""
    # Most systems write millimetres, also those that do not say so.
    unit = _unit(parameters)
    metres = metres_of(unit) if unit else METRES["mm"]
    if metres is None:
        raise FormatError(f"{path}: POINT:UNITS is '{unit}': one of {', '.join(METRES)} is wanted")
    return metres


def _unit(parameters: dict[str, Parameter]) -> str:
    """Return the unit that a file tells for its lengths; empty: none."""
    texts = parameters["POINT:UNITS"].texts() if "POINT:UNITS" in parameters else []
    return texts[0] if texts else ""


def _labels(parameters: dict[str, Parameter], n_points: int) -> tuple[str, ...]:
    """Return the labels of all points; lists hold 255 at most, longer ones go on in LABELS2, LABELS3, …"""
    labels: list[str] = []
    for number in ["", *range(2, _LABEL_LISTS)]:
        parameter = parameters.get(f"POINT:LABELS{number}")
        if parameter is None:
            break
        labels += parameter.texts()
    return without_prefixes([*labels[:n_points], *[""] * (n_points - len(labels))])


def _scalars(parameters: dict[str, Parameter]) -> dict[str, float]:
    """Return single numbers of the groups that processing programs write measurements to."""
    found = {}
    for name, parameter in parameters.items():
        group, _, key = name.partition(":")
        if group in {"PROCESSING", "SUBJECT", "SUBJECTS"} and parameter.kind == 4:
            numbers = parameter.numbers()
            if len(numbers) == 1 and np.isfinite(numbers[0]):
                found[key] = float(numbers[0])
                found.setdefault(_NOT_IN_NAMES.sub("", key), float(numbers[0]))
    return found


def _number(parameters: dict[str, Parameter], name: str, default: float) -> float:
    numbers = parameters[name].numbers() if name in parameters else np.zeros(0)
    return float(numbers[0]) if len(numbers) and np.isfinite(numbers[0]) else default
