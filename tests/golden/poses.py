"""Poses as they are stored, the kind of machine that they were made on, and by how much others differ."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import llvmlite.binding as llvm
import numba
import numpy as np

from devices import recording_format as fmt
from devices.recording_file import RecordingParts
from devices.recording_writer import DerivedRecordingWriter, session_record
from gateway.frames import FloatArray, MarkerFit, SkeletonFrame
from gateway.geometry.comparison import orientation_error
from gateway.recording.pose_encoding import decode_markers, decode_skeleton_frame, frame_messages
from gateway.support import processor

TOLERANCES = {
    "angle": 1e-9,  # rad
    "p_w": 1e-9,  # m
    "sigma": 1e-9,  # rad
    "angular_rate": 1e-7,  # rad/s: the optical methods difference angles over some 30 ms
    "joint_acceleration": 1e-7,  # m/s², likewise
    "markers": 1e-6,  # m, as they are recorded in single precision
}
"""How far poses may be off that were made on another kind of machine."""
MACHINE, METADATA_OF_RECORDING = "machine.json", "recording_sha256"
_LIBRARIES = ("numpy", "scipy", "numba", "llvmlite", "vqf", "astral")

Machine = Mapping[str, str]


def this_machine() -> Machine:
    """What the last bit of a pose may depend on: instructions, as kernels and libraries use them, and
    libraries. The processor itself does not count where all of them are settled."""
    config = numba.config
    return {
        "architecture": platform.machine(),
        "kernels for": config.CPU_NAME or llvm.get_host_cpu_name(),
        "with features": config.CPU_FEATURES or llvm.get_host_cpu_features().flatten(),
        "NumPy with": " ".join(np.show_config(mode="dicts")["SIMD Extensions"]["found"]),
        "BLAS kernels": os.environ.get(processor.BLAS_KERNELS) or llvm.get_host_cpu_name(),
        "C library": " ".join(platform.libc_ver()),
        **{library: version(library) for library in _LIBRARIES},
    }


def other_kind(made_on: Machine) -> str:
    """What distinguishes the machine that poses were made on from this one; empty: nothing does."""
    here = this_machine()
    return ", ".join(name for name in sorted({*here, *made_on}) if here.get(name) != made_on.get(name))


class PoseMessages(NamedTuple):
    """One pose as it is recorded."""

    skeleton: bytes
    markers: bytes | None
    """What became of the markers; None where there are none."""


class StoredPoses(NamedTuple):
    """A file of poses."""

    poses: list[PoseMessages]
    machine: Machine
    """That they were made on."""
    recording_sha256: str
    """Of the recording that they were made of."""


def sha256(path: Path) -> str:
    """Of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def messages_of(frames: Iterable[SkeletonFrame]) -> list[PoseMessages]:
    """Poses as they are recorded."""
    kept = (dict(frame_messages(frame)) for frame in frames)
    return [PoseMessages(messages[fmt.SKELETON], messages.get(fmt.MARKERS)) for messages in kept]


def write_poses(path: Path, stored: StoredPoses) -> None:
    """Write the file anew."""
    session = session_record({}, name=path.stem, **{METADATA_OF_RECORDING: stored.recording_sha256})
    machine = json.dumps(dict(stored.machine), indent=1).encode()
    with DerivedRecordingWriter(path, session, {MACHINE: machine}, 0, replaces=True) as writer:
        for skeleton, markers in stored.poses:
            time_ns = decode_skeleton_frame(skeleton).time_ns
            writer.add(fmt.SKELETON, time_ns, skeleton)
            if markers is not None:
                writer.add(fmt.MARKERS, time_ns, markers)


def read_poses(path: Path) -> StoredPoses:
    """Raises ``RecordingError`` when there is no such file."""
    parts = RecordingParts(path)
    poses: list[PoseMessages] = []
    for message in parts.messages():
        if message.topic == fmt.SKELETON:
            poses.append(PoseMessages(message.data, None))
        elif message.topic == fmt.MARKERS:
            poses[-1] = poses[-1]._replace(markers=message.data)
    assert parts.defect is None, f"{path}: {parts.defect}"
    machine = json.loads(parts.head.attachments[MACHINE])
    return StoredPoses(poses, machine, parts.head.session[METADATA_OF_RECORDING])


@dataclass
class Comparison:
    """Poses as they were against poses as they are."""

    before: int
    """Poses there were."""
    now: int
    moved: int = 0
    """Poses of the same instant of which a bit differs."""
    first: str = ""
    """What differs first; empty: nothing does."""
    unlike: str = ""
    """What differs first and cannot be rounding: instants, statuses, what is defined; empty: nothing does."""
    largest: dict[str, float] = field(default_factory=lambda: dict.fromkeys(TOLERANCES, 0.0))
    """Difference of each quantity, where both are defined; q and -q are the same orientation."""

    @property
    def is_identical(self) -> bool:
        """To the last bit."""
        return not self.first

    @property
    def is_within_tolerance(self) -> bool:
        """The same but for rounding."""
        return not self.unlike and all(self.largest[name] <= TOLERANCES[name] for name in TOLERANCES)


def compare(before: Sequence[PoseMessages], now: Sequence[PoseMessages]) -> Comparison:
    """Poses belong together by their instants."""
    found = Comparison(len(before), len(now))
    was = {decode_skeleton_frame(pose.skeleton).time_ns: pose for pose in before}
    made = {decode_skeleton_frame(pose.skeleton).time_ns: pose for pose in now}
    if list(was) != list(made) or len(was) != len(before) or len(made) != len(now):
        only = sorted(set(was) ^ set(made))
        found.first = found.unlike = f"{len(before)} poses before, {len(now)} now" + (
            f"; only one has that of {only[0]} ns" if only else "; instants are repeated or out of order"
        )
    for k, time_ns in enumerate(was):
        if time_ns in made and was[time_ns] != made[time_ns]:
            found.moved += 1
            where = f"pose {k} (counted from 0): "
            unlike = _compare_pose(was[time_ns], made[time_ns], found.largest)
            found.first = found.first or where + (unlike or "numbers")
            found.unlike = found.unlike or (where + unlike if unlike else "")
    return found


def _compare_pose(before: PoseMessages, now: PoseMessages, largest: dict[str, float]) -> str:
    """Enlarge ``largest``; what differs that cannot be rounding."""
    a, b = decode_skeleton_frame(before.skeleton), decode_skeleton_frame(now.skeleton)
    for name in ("sequence", "root", "status"):
        if not np.array_equal(getattr(a, name), getattr(b, name)):
            return f"{name} was {getattr(a, name)}, is {getattr(b, name)}"
    has_turned = (a.q_wb != b.q_wb).any(axis=1)
    _enlarge(largest, "angle", orientation_error(b.q_wb, a.q_wb).total[has_turned])
    for name in ("p_w", "sigma", "angular_rate", "joint_acceleration"):
        _enlarge(largest, name, getattr(b, name) - getattr(a, name))
    for name in ("q_wb", "p_w", "sigma", "angular_rate", "joint_acceleration"):
        if not np.array_equal(np.isnan(getattr(a, name)), np.isnan(getattr(b, name))):
            return f"{name} is defined for other segments"
    if before.markers is None or now.markers is None:
        return "" if before.markers == now.markers else "markers came or went"
    return _compare_fits(decode_markers(before.markers).fit, decode_markers(now.markers).fit, largest)


def _compare_fits(a: MarkerFit, b: MarkerFit, largest: dict[str, float]) -> str:
    if len(a.unlabelled) != len(b.unlabelled) or a.renamed != b.renamed:
        return "markers were named otherwise"
    if not np.array_equal(a.used, b.used):
        return "other markers had a say"
    for name in ("positions", "virtual", "unlabelled"):
        _enlarge(largest, "markers", getattr(b, name) - getattr(a, name))
        if not np.array_equal(np.isnan(getattr(a, name)), np.isnan(getattr(b, name))):
            return f"{name} of other markers are defined"
    return ""


def _enlarge(largest: dict[str, float], name: str, difference: FloatArray) -> None:
    known = np.abs(difference[np.isfinite(difference)])
    largest[name] = max(largest[name], float(known.max(initial=0.0)))
