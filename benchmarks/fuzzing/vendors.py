"""Checks of importers. What is read must be what the gateway can take: instants that grow, rates above 0."""

from __future__ import annotations

import shutil

import numpy as np

from benchmarks.fuzzing.files import SCRATCH, in_a_file, refused_or_read
from devices.marker_files import MarkerTrial, read_c3d, read_trc
from devices.recorded_tracks import RecordedTracks
from devices.vendor_formats.column_map import ColumnMap, read_mapped_csv
from devices.vendor_formats.movella_dot import read_movella_dot
from devices.vendor_formats.mvnx import read_mvnx
from devices.vendor_formats.ximu3 import read_ximu3
from devices.vendor_formats.xsens_text import read_xsens_text
from gateway.support.settings_files import load_settings

PARTS = b"\n=====\n"
"""Between the files of one input."""


def import_xsens(data: bytes) -> None:
    """One module's file, whole and as far as it goes."""
    path = in_a_file("MT_0001.txt", data)
    refused_or_read(lambda: _sound(read_xsens_text([path])))
    refused_or_read(lambda: _sound(read_xsens_text([path], rate_hz=100.0, partial=True)))


def import_movella_dot(data: bytes) -> None:
    """One or two modules' files."""
    paths = [in_a_file(f"dot_{n}.csv", part) for n, part in enumerate(data.split(PARTS)[:2])]
    refused_or_read(lambda: _sound(read_movella_dot(paths)))
    refused_or_read(lambda: _sound(read_movella_dot(paths, align="start", partial=True)))


def import_mvnx(data: bytes) -> None:
    """One file."""
    path = in_a_file("body.mvnx", data)
    refused_or_read(lambda: _sound(read_mvnx(path)))
    refused_or_read(lambda: _sound(read_mvnx(path, partial=True)))


def import_ximu3(data: bytes) -> None:
    """A folder with the files of one module."""
    folder = SCRATCH / "Left Foot 65577A49"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    names = ("Inertial.csv", "Magnetometer.csv", "Quaternion.csv", "Command.json")
    for name, part in zip(names, data.split(PARTS), strict=False):
        (folder / name).write_bytes(part)
    refused_or_read(lambda: _sound(read_ximu3([folder])))
    refused_or_read(lambda: _sound(read_ximu3([folder], align="start", partial=True)))


def import_csv(data: bytes) -> None:
    """A map, and the file that it is about."""
    columns, _, table = data.partition(PARTS)
    path, map_path = in_a_file("any.csv", table), in_a_file("map.yaml", columns)

    def read(partial: bool) -> None:
        # a file of the map's own naming would lead out of this folder
        wanted = load_settings(map_path, ColumnMap)
        if all(module.file is None for module in wanted.modules):
            _sound(read_mapped_csv(path, wanted, SCRATCH, partial=partial))

    for partial in (False, True):
        refused_or_read(lambda partial=partial: read(partial))  # type: ignore[misc]


def import_c3d(data: bytes) -> None:
    """One file."""
    path = in_a_file("trial.c3d", data)
    refused_or_read(lambda: _marked(read_c3d(path)))


def import_trc(data: bytes) -> None:
    """One file."""
    path = in_a_file("trial.trc", data)
    refused_or_read(lambda: _marked(read_trc(path)))


def _marked(trial: MarkerTrial) -> None:
    assert np.isfinite(trial.rate_hz), trial.rate_hz
    assert trial.rate_hz > 0, trial.rate_hz


def _sound(found: RecordedTracks) -> None:
    assert np.isfinite(found.sampling_rate_hz), found.sampling_rate_hz
    assert found.sampling_rate_hz > 0, found.sampling_rate_hz
    times = [track.times for track in found.modules]
    times += [track.times for track in found.fused]
    times += [track.times for track in found.local]
    for each in times:
        assert np.isfinite(each).all(), "an instant that is none"
        assert (np.diff(each) > 0).all(), "instants that do not grow"
