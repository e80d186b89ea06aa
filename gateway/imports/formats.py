"""The list of formats, and which one a file has."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from devices.deferred import Deferred
from devices.marker_files import holds_markers
from devices.vendor_formats.sheets import FormatError, refuse_device
from gateway.body.body_file import load_body
from gateway.errors import GatewayError
from gateway.imports.segment_names import BODY
from gateway.support.settings_files import load_settings

if TYPE_CHECKING:
    from devices.recorded_tracks import ModuleTrack, RecordedTracks

_read_movella_dot = Deferred("devices.vendor_formats.movella_dot", "read_movella_dot")
_read_ximu3 = Deferred("devices.vendor_formats.ximu3", "read_ximu3")
_read_xsens_text = Deferred("devices.vendor_formats.xsens_text", "read_xsens_text")

_HEAD_BYTES = 8192


@dataclass(frozen=True)
class ReadOptions:
    """What the files do not tell."""

    rate_hz: float | None = None
    align: str = "stamps"
    partial: bool = False
    columns: Path | None = None
    """Map file of ``csv``."""
    maps: Mapping[str, str] = field(default_factory=dict)
    """Joint to segment, for ``bvh``."""
    body: str | None = None
    """Name or file of the body, for ``bvh``; None: a person."""


@dataclass(frozen=True)
class ImportFormat:
    """How files of a format become a recording."""

    meaning: str
    read: Callable[[Sequence[Path], ReadOptions], RecordedTracks]
    axes: Literal["modules", "mvnx", "segments"] = "modules"
    """What has the orientations: modules that sit somehow on segments, segments in MVN's axes, or in ours."""


def _read_mvnx(paths: Sequence[Path], options: ReadOptions) -> RecordedTracks:
    from devices.vendor_formats.mvnx import read_mvnx  # noqa: PLC0415 - as all readers: the list needs none

    if len(paths) > 1:
        raise GatewayError(f"an MVNX file holds a whole body: import {len(paths)} files one by one")
    return read_mvnx(paths[0], partial=options.partial)


def _read_bvh(paths: Sequence[Path], options: ReadOptions) -> RecordedTracks:
    from devices.vendor_formats.bvh import read_bvh  # noqa: PLC0415

    if len(paths) > 1:
        raise GatewayError(f"a BVH file holds a whole body: import {len(paths)} files one by one")
    body = load_body(options.body or BODY)
    known = {
        name: float(np.linalg.norm(tip)) for name, tip in zip(body.segment_names, body.tips, strict=True)
    }
    if not {"left_thigh", "left_shank"} <= known.keys():
        raise GatewayError(f"--body {options.body}: a BVH file is read for a body with legs")
    leg_m = known["left_thigh"] + known["left_shank"]
    return read_bvh(paths[0], leg_m, options.maps, partial=options.partial)


def _read_csv(paths: Sequence[Path], options: ReadOptions) -> RecordedTracks:
    from devices.vendor_formats.column_map import ColumnMap, read_mapped_csv  # noqa: PLC0415

    if options.columns is None:
        if paths[0].is_dir():
            raise GatewayError(f"{paths[0]} is a folder without files of a known maker: name the files in it")
        raise GatewayError(
            f"{paths[0]} is a CSV file of no known maker: name its columns with --columns MAP.yaml "
            "(docs/guide/imports.md)"
        )
    if len(paths) > 1:
        raise GatewayError("name the files of several modules in the map ('file:'), and import one")
    columns = load_settings(options.columns, ColumnMap)
    return read_mapped_csv(paths[0], columns, options.columns.parent, partial=options.partial)


FORMATS: dict[str, ImportFormat] = {
    "xsens": ImportFormat(
        "MT Manager and MTw text, also for OpenSense: one .txt or .csv a module",
        lambda paths, o: _read_xsens_text(_files_in(paths), o.rate_hz, partial=o.partial),
    ),
    "mvnx": ImportFormat("Xsens MVN: orientations and path of a whole body", _read_mvnx, axes="mvnx"),
    "bvh": ImportFormat("BVH of animation programs: a whole body", _read_bvh, axes="segments"),
    "ximu3": ImportFormat(
        "x-IMU3: a folder a module, or the folder of all",
        lambda paths, o: _read_ximu3(paths, align=o.align, partial=o.partial),
    ),
    "movella-dot": ImportFormat(
        "Movella DOT: one .csv a module",
        lambda paths, o: _read_movella_dot(_files_in(paths), align=o.align, partial=o.partial),
    ),
    "csv": ImportFormat("any CSV, with a map of its columns", _read_csv),
}
"""By name on the command line."""


def read(paths: Sequence[Path], name: str, options: ReadOptions) -> RecordedTracks:
    """Return the recording in files of a format, without stuck magnetometers; a note names them.

    Raises ``FormatError`` and ``GatewayError``.
    """
    recording = FORMATS[name].read(paths, options)
    stuck = [track.name for track in recording.modules if _has_stuck_field(track)]
    if not stuck:
        return recording
    modules = tuple(
        replace(track, magnetic_field=np.full_like(track.magnetic_field, np.nan))
        if track.name in stuck
        else track
        for track in recording.modules
    )
    note = f"the magnetometer of {', '.join(stuck)} gives one reading throughout: it is left out"
    return replace(recording, modules=modules, notes=(*recording.notes, note))


def _has_stuck_field(track: ModuleTrack) -> bool:
    """Return whether a magnetometer repeats one reading while its module turns. At rest any may."""
    from gateway.reconstruction.module_faults import gives_one_field  # noqa: PLC0415

    dt = np.diff(track.times, prepend=track.times[:1])
    return gives_one_field(track.magnetic_field, track.angular_rate, dt)


def detected(paths: Sequence[Path], options: ReadOptions) -> str:
    """Return the name of the format that files have, by what is in the first of them. Raises
    ``FormatError``."""
    if options.columns is not None:
        return "csv"
    path = paths[0]
    if path.is_dir():
        from devices.vendor_formats.ximu3 import folders_of  # noqa: PLC0415

        if folders_of(path):
            return "ximu3"
        path = _files_in(paths)[0]
    try:
        refuse_device(path)
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error.strerror}") from error
    if not head.strip():
        raise FormatError(f"{path} is empty: export or copy it again")
    for name, marks in _MARKS.items():
        if any(mark in head for mark in marks):
            return name
    if holds_markers(head):
        raise FormatError(
            f"{path} holds markers: `mocap-gateway optical fit` makes a body of them, `optical solve` a "
            "recording"
        )
    if b"DataType=Quaternion" in head:
        raise FormatError(
            f"{path} holds orientations as OpenSense has them: import the files of the modules themselves"
        )
    if b"\0" not in head and any(delimiter in head for delimiter in b"\t;,"):
        return "csv"
    raise FormatError(
        f"{path} has no format that is known (it begins with {head[:24]!r}): name one with --format, of "
        f"{', '.join(FORMATS)}, or let the program that made it export text or CSV"
    )


_MARKS = {
    "mvnx": (b"<mvnx",),
    "bvh": (b"HIERARCHY",),
    "movella-dot": (b"Movella", b"SyncStatus:", b"DeviceTag:"),
    "xsens": (b"PacketCounter", b"Counter\tAcc_X"),
}
"""In this order: a Movella DOT file has a packet counter too."""


def _files_in(paths: Sequence[Path]) -> list[Path]:
    """Return the files themselves; of a folder, those with numbers in them."""
    files = []
    for path in paths:
        tables = sorted(each for each in path.glob("*") if each.suffix.lower() in {".txt", ".csv"})
        within = [each for each in tables if each.stem.lower() not in {"license", "readme"}]
        if path.is_dir() and not within:
            folders = sorted(each.name for each in path.glob("*/") if each.is_dir())
            instead = f": name one of the folders in it ({', '.join(folders[:5])})" if folders else ""
            raise FormatError(f"{path} has no .txt or .csv file of modules in it{instead}")
        files += within if path.is_dir() else [path]
    return files
