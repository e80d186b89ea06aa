"""MVNX: what Xsens MVN exports, XML. Orientations of segments, and the path of the first of them.

Segments have axes x forward, y left, z up in the neutral posture, in a world north-west-up (x is where the
person looked at calibration). The file is read piece by piece, by a parser that refuses entities.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import iterparse

from devices.deferred import Rotation
from devices.recorded_tracks import FusedTrack, LocalTrack, RecordedTracks
from devices.vendor_formats.gaps import checked_rate, spread
from devices.vendor_formats.sheets import FloatArray, FormatError, refuse_device
from devices.vendor_formats.tracks import NORTH_WEST_UP_DEG, refuse_repeats, turned
from firmware_protocol.samples import POSITION

PATH_DEVICE = 60
"""Module id under which the path of the first segment is sent, as of a local measuring device."""
_PATH_SIGMA_M = 0.01
_LARGEST = 4e12  # ms since 1970: the year 2096


@dataclass
class _Found:
    """What was gathered so far."""

    rate_hz: float = 0.0
    begun_ms: int = 0
    labels: list[str] = field(default_factory=list)
    index: list[int] = field(default_factory=list)
    orientations: list[FloatArray] = field(default_factory=list)
    positions: list[FloatArray] = field(default_factory=list)


def read_mvnx(path: Path, *, partial: bool = False) -> RecordedTracks:
    """Read a module for every segment, numbered from 0 in the file's order. Raises ``FormatError``."""
    found, note = _Found(), None
    try:
        for element in _elements(path):
            _take(element, found, path)
    except (ParseError, DefusedXmlException) as error:
        where = getattr(error, "position", None)
        place = f", line {where[0]}, column {where[1] + 1}" if where else ""
        # A long session that was cut off is still worth reading up to there.
        note = f"{path}{place}: not XML from there on, as a file is that was cut off ({error})"
        if not partial:
            raise FormatError(f"{note}; --partial imports the frames before it") from error
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    if len(found.orientations) < 2:
        raise FormatError(
            f"{path}: {len(found.orientations)} frames have an <orientation>: export it from MVN with them"
        )
    return _recording(path, found, note)


def _recording(path: Path, found: _Found, note: str | None) -> RecordedTracks:
    refuse_repeats(found.labels)
    index = np.array(found.index, dtype=np.int64)
    # Missing frames are gaps, but frames out of order are no recording.
    if (np.diff(index) <= 0).any():
        raise FormatError(f"{path}: the indices of its frames do not grow")
    times, values = spread(index, (index - index[0]) / found.rate_hz, np.array(found.orientations), path)
    if not np.isfinite(values).all(axis=1).any():
        raise FormatError(f"{path}: no orientation in it is a number")
    fused = tuple(
        FusedTrack(module, label, times, turned(values[:, 4 * module : 4 * module + 4]))
        for module, label in enumerate(found.labels)
    )

    local: tuple[LocalTrack, ...] = ()
    if len(found.positions) == len(index):
        _, way = spread(index, times[index - index[0]], np.array(found.positions), path)
        way = way @ Rotation.from_euler("z", NORTH_WEST_UP_DEG, degrees=True).as_matrix().T
        local = (LocalTrack(PATH_DEVICE, found.labels[0], times, POSITION, way, _PATH_SIGMA_M),)
    notes = () if note is None else (note,)
    begun_ns = found.begun_ms * 10**6
    return RecordedTracks(
        "mvnx", found.rate_hz, (), local=local, fused=fused, begun_utc_ns=begun_ns, notes=notes
    )


def _elements(path: Path) -> Iterator[Element]:
    """Yield elements as they end, names without namespace."""
    refuse_device(path)
    root: Element | None = None
    for event, element in iterparse(path, events=("start", "end"), forbid_dtd=True):
        element.tag = element.tag.rpartition("}")[2]
        if event == "start":
            root = element if root is None else root
            if element.tag == "subject":
                yield element
        elif element.tag in {"segment", "frame"}:
            yield element
            if element.tag == "frame":
                # A long recording has millions of elements: without this all of them would stay in memory.
                element.clear()


def _take(element: Element, found: _Found, path: Path) -> None:
    if element.tag == "subject":
        found.rate_hz = checked_rate(_number(element, "frameRate", path), path)
        has_date = bool(element.get("recDateMSecsSinceEpoch"))
        found.begun_ms = int(_number(element, "recDateMSecsSinceEpoch", path)) if has_date else 0
    elif element.tag == "segment" and element.get("label"):
        found.labels.append(str(element.get("label")))
    elif element.tag == "frame" and element.get("type", "normal") == "normal":
        _take_frame(element, found, path)


def _take_frame(frame: Element, found: _Found, path: Path) -> None:
    name = f"frame {frame.get('index', len(found.index))}"
    orientation = frame.findtext("orientation")
    if orientation is None:
        return
    if not found.rate_hz or not found.labels:
        raise FormatError(f"{path}: {name} comes before <subject frameRate> and <segments>")
    found.index.append(int(_number(frame, "index", path)) if frame.get("index") else len(found.index))
    found.orientations.append(_vector(orientation, 4 * len(found.labels), path, f"{name}, <orientation>"))
    position = frame.findtext("position")
    if position is not None:
        whole = _vector(position, 3 * len(found.labels), path, f"{name}, <position>")
        # Of the root alone: the other places follow from the body.
        found.positions.append(whole[:3])


def _vector(text: str, length: int, path: Path, where: str) -> FloatArray:
    try:
        values: FloatArray = np.array(text.split(), dtype=np.float64)
    except ValueError as error:
        raise FormatError(f"{path}: {where}: {error}") from None
    if len(values) != length:
        raise FormatError(f"{path}: {where}: {length} numbers are wanted, there are {len(values)}")
    return values


def _number(element: Any, name: str, path: Path) -> float:
    text = element.get(name)
    try:
        value = float(text)
    except (TypeError, ValueError):
        value = -1.0
    if not 0 <= value < _LARGEST:
        raise FormatError(f"{path}: <{element.tag} {name}> is {text!r}; a number is wanted")
    return value
