"""Readers of the public data sets that the gateway is measured on: folder or file to ``RecordedTracks``.

All give SI units and wxyz quaternions to a world with Z up. Magnetic readings in arbitrary units are
scaled so that each module's mean norm is ``NOMINAL_FIELD_UT``.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from devices.deferred import Rotation, loadmat
from devices.emulators.bodies import FloatArray
from devices.recorded_tracks import LocalTrack, ModuleTrack, RecordedTracks, ReferenceTrack, track_of
from devices.vendor_formats.xsens_text import read_mt_file
from firmware_protocol.samples import POSITION

LOCAL_DEVICE = 60
"""Module id under which optical positions are sent as those of a local measuring device."""

METAL_TABLE_S = 5.0
"""The chain of ``ring_chain5`` lies on a metal table for so long; the figures count what comes after."""

RING_OPTICAL_LAG_S = 0.016
"""How much later than the modules the optical system of ``ring_chain5`` shows the same motion, s.

From rates alone, gyroscopes against the turn from one optical frame to the next: 16.0 ms on each of the five
rigid segments and in each quarter of the trial. The data's description says about 20 ms.
"""

_OPTICAL_SIGMA_M = 0.001
_FLIPPED_RATE = 12.0  # rad/s, beyond what the pendulum does: its optical reference has flipped
_LONGEST_FLIP_S = 0.5
_SHORTEST_INTERVAL_S = 0.001  # time stamps are in ms and some are given twice
_BROAD_INTERVAL_S = 0.0035

MTW_SEGMENTS = {
    0x23: "right_hand",
    0x24: "right_foot",
    0x25: "left_shoulder_girdle",
    0x26: "left_upper_arm",
    0x27: "left_forearm",
    0x28: "left_hand",
    0x29: "head",
    0x2A: "thorax",
    0x2B: "right_thigh",
    0x2C: "left_thigh",
    0x2D: "pelvis",
    0x2E: "right_shank",
    0x2F: "right_shoulder_girdle",
    0x30: "right_forearm",
    0x31: "left_foot",
    0x33: "left_shank",
    0x34: "right_upper_arm",
}
"""Last byte of the module's serial number, which is its module id here, to the segment that wears it."""


def read_ring_chain5(trial: Path, kind: str = "rigid", root_marker: int | None = None) -> RecordedTracks:
    """Read five modules at 40 Hz on a chain, an optical reference at 30 Hz, and the root's position.

    trial: folder of the trial. kind: ``rigid`` or ``nonrigid`` (modules on foam).
    root_marker: marker 1 to 4 of segment 1 that gives the position of the local device; None: their mean.
    Modules are numbered and named as the segments, 1 to 5. Optical times are moved by
    ``RING_OPTICAL_LAG_S`` onto those of the modules, so the first is negative.
    """
    imu = _named_columns(trial / f"imu_{kind}.csv", header_row=2)
    optical = _named_columns(trial / "omc.csv", header_row=2)
    times = np.arange(len(imu)) / 40.0
    optical_times = np.arange(len(optical)) / 30.0 - RING_OPTICAL_LAG_S

    def triple(table: Any, prefix: str) -> FloatArray:
        return np.stack([table[f"{prefix}_{axis}"] for axis in "xyz"], axis=1)

    modules, references = [], []
    for segment in range(1, 6):
        name = f"segment_{segment}"
        acc, gyr, mag = (triple(imu, f"seg{segment}_{sensor}") for sensor in ("acc", "gyr", "mag"))
        modules.append(track_of(segment, name, times, acc, gyr, mag))
        q_wb = np.stack([optical[f"seg{segment}_quat_{axis}"] for axis in "wxyz"], axis=1)
        references.append(ReferenceTrack(name, optical_times, q_wb))

    # The mean of all markers is closer to the middle of the segment than any one of them.
    markers = range(1, 5) if root_marker is None else [root_marker]
    root = np.mean([triple(optical, f"seg1_marker{marker}") for marker in markers], axis=0)
    local = LocalTrack(LOCAL_DEVICE, "root", optical_times, POSITION, root, _OPTICAL_SIGMA_M)
    return RecordedTracks(f"ring_chain5_{kind}", 40.0, tuple(modules), tuple(references), (local,))


def read_broad(path: Path) -> RecordedTracks:
    """Read a BROAD trial (.mat): module 1 at 285.714 Hz, optical orientation and position at its instants."""
    trial = _matlab(path)
    times: FloatArray = np.arange(len(trial["imu_acc"]), dtype=np.float64) * _BROAD_INTERVAL_S
    module = ModuleTrack(1, "module", times, trial["imu_acc"], trial["imu_gyr"], trial["imu_mag"])
    reference = ReferenceTrack("module", times, trial["opt_quat"])
    local = LocalTrack(LOCAL_DEVICE, "module", times, POSITION, trial["opt_pos"], _OPTICAL_SIGMA_M)
    return RecordedTracks(f"broad_{path.stem}", 1.0 / _BROAD_INTERVAL_S, (module,), (reference,), (local,))


def _matlab(path: Path) -> dict[str, Any]:
    """Return the variables of a MATLAB file. Raises ``OSError`` and ``ValueError``."""
    try:
        return dict(loadmat(path, squeeze_me=True))
    except OSError:
        raise
    except Exception as error:  # the library raises whatever bytes of no such file lead it to
        raise ValueError(f"no MATLAB file: {error}") from error


def read_repoimu_tstick(path: Path) -> RecordedTracks:
    """Read a RepoIMU T-stick trial: module 1 at 100 Hz with optical orientation."""
    track, reference = _read_repoimu(path, 1, "module")
    return RecordedTracks(f"repoimu_{path.stem}", 100.0, (track,), (reference,))


def read_repoimu_pendulum(folder: Path) -> RecordedTracks:
    """Read the three segments of a RepoIMU pendulum trial, modules 1 to 3, about 50 Hz.

    The logger repeated what had not changed: rows without a new angular rate are dropped, and the
    accelerometer and the magnetometer, which changed more rarely still, are interpolated between their
    own changes. Reference rows in which the optical markers have flipped are NaN. The source's world and
    segments have X down: a swing in one plane is the same with X up, but with it all three references lean
    out of that plane to the other side than the gyroscopes turn.
    """
    paths = sorted(folder.glob("*_Segment_[123].csv"))
    if len(paths) != 3:
        raise FileNotFoundError(f"{len(paths)} segments of a pendulum in {folder}; three are needed")
    pairs = [_read_repoimu(path, n, f"segment_{n}") for n, path in enumerate(paths, start=1)]
    modules = tuple(module for module, _ in pairs)
    references = tuple(_x_down_to_z_up(_without_flips(reference)) for _, reference in pairs)
    return RecordedTracks("repoimu_pendulum", 50.0, modules, references)


def read_hipose_mtw17(folder: Path) -> RecordedTracks:
    """Return seventeen Xsens modules on a whole body at 60 Hz, with the orientations of Xsens' own filter.

    The references' world, north-west-up, is turned to east-north-up. They are orientations of the
    module (sensor axes), not of the segment.
    """
    files = [read_mt_file(path) for path in sorted(folder.glob("*_00b45c*.csv"))]
    if not files:
        raise FileNotFoundError(f"no file of an MTw module in {folder}")
    # Counters of modules that were synchronised count the same instants.
    first = min(int(file.counter[0]) for file in files)
    modules, references = [], []
    for file in files:
        module, times = int(file.path.stem[-2:], 16), (file.counter - first) / 60.0
        name, read = MTW_SEGMENTS[module], file.readings
        modules.append(track_of(module, name, times, read[:, :3], read[:, 3:6], read[:, 6:9]))
        references.append(ReferenceTrack(name, times, read[:, 9:]))
    return RecordedTracks("hipose_mtw17", 60.0, tuple(modules), tuple(references))


def _named_columns(path: Path, header_row: int) -> Any:
    return np.genfromtxt(path, delimiter=",", skip_header=header_row, names=True)


def _read_repoimu(path: Path, module: int, name: str) -> tuple[ModuleTrack, ReferenceTrack]:
    lines = path.read_text().splitlines()[2:]
    table = np.array([_numbers(line) for line in lines if line.strip(";")])
    times, q_wb = table[:, 0], table[:, 1:5]
    acc, gyr, mag = table[:, 5:8], table[:, 8:11], table[:, 11:14]
    fresh = _changes(gyr) & (np.diff(times, prepend=-np.inf) > 0.0)
    at = times[fresh]
    acc, mag = _between_changes(times, acc, at), _between_changes(times, mag, at)
    track = track_of(module, name, at, acc, gyr[fresh], mag)
    return track, ReferenceTrack(name, times, q_wb)


def _numbers(line: str) -> list[float]:
    """Return the fields of a line; numbers with exponents may have decimal commas."""
    return [float(text.replace(",", ".")) for text in line.strip().strip(";").split(";")]


def _changes(values: FloatArray) -> Any:
    """Return whether a row differs from the one before, (n,); the first does."""
    return np.concatenate([[True], (np.diff(values, axis=0) != 0.0).any(axis=1)])


def _between_changes(times: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    fresh = _changes(values)
    return np.stack([np.interp(at, times[fresh], column) for column in values[fresh].T], axis=1)


def _without_flips(track: ReferenceTrack) -> ReferenceTrack:
    """Set rows to NaN next to a turn faster than the pendulum can be, and between two such turns.

    Markers that have been taken for one another are soon told apart again, with a second flip.
    """
    rotation = Rotation.from_quat(track.q_wb, scalar_first=True)
    turn = (rotation[:-1].inv() * rotation[1:]).magnitude()
    is_flip = turn > _FLIPPED_RATE * np.maximum(np.diff(track.times), _SHORTEST_INTERVAL_S)
    flips = np.flatnonzero(is_flip)
    q_wb = track.q_wb.copy()
    q_wb[np.concatenate([flips, flips + 1])] = np.nan
    for away, back in itertools.pairwise(flips):
        if track.times[back] - track.times[away] < _LONGEST_FLIP_S:
            q_wb[away : back + 1] = np.nan
    return replace(track, q_wb=q_wb)


def _x_down_to_z_up(track: ReferenceTrack) -> ReferenceTrack:
    """Return the reference in a world with Z up and of segment axes with X up, from X down in both."""
    known = np.isfinite(track.q_wb).all(axis=1)
    half_turn = Rotation.from_euler("z", 180, degrees=True)
    to_z = Rotation.from_euler("y", -90, degrees=True) * half_turn
    q_wb = np.full_like(track.q_wb, np.nan)
    turned = to_z * Rotation.from_quat(track.q_wb[known], scalar_first=True) * half_turn
    q_wb[known] = turned.as_quat(scalar_first=True)
    return replace(track, q_wb=q_wb)


READERS: dict[str, Callable[[Path], RecordedTracks]] = {
    "broad": read_broad,
    "hipose_mtw17": read_hipose_mtw17,
    "repoimu_pendulum": read_repoimu_pendulum,
    "repoimu_tstick": read_repoimu_tstick,
    "ring_chain5": read_ring_chain5,
}
"""Name of a data set to its reader; most take a file, those of several modules their folder."""
