"""C3D: joint centres and tips as points, segment rotations, joint angles.

After the C3D file format user guide (Motion Lab Systems, 2021): Intel byte order, floating-point numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gateway.frames import FloatArray
from gateway.recording.exporters.take import Take, TakenMarkers, markers_of, rotated, rotation

_BLOCK_BYTES = 512
_INTEL = 84
_POINT_BYTES = 4 * 4
"""x, y, z and the residual."""
_UNITS = {1.0: "m", 100.0: "cm", 1000.0: "mm"}
_MOST_IN_WORD = 2**16 - 1
_LAST_BLOCK = _MOST_IN_WORD
"""That a parameter can name."""
_MOST_IN_LIST = 255
"""Labels of one parameter; longer lists go on in LABELS2, LABELS3, …"""
_FRAMES_AT_ONCE = 4096
"""That are made and written together: a file may be as long as the disk has room."""
_FLOATS = -1.0
"""Scale of points that are stored as floating-point numbers; residuals are whole units of its size."""
_MOST_RESIDUAL, _RESIDUAL_STEP, _NOT_SEEN = 127, 256.0, -1.0
"""Residuals are the upper byte of a word whose lower one tells which cameras saw the point."""

Value = str | int | float | list[str] | list[int]
Groups = dict[str, dict[str, Value]]


def write(take: Take, path: Path, units_per_m: float) -> str | None:
    """Write a take as C3D, and return what it leaves out. Raises ``OSError``.

    Points are ``<segment>``, ``<segment>_tip``, one a joint in degrees (listed in POINT:ANGLES), and the
    markers that the poses were made from, with their distances from the body as residuals (negative: not
    seen). The segments' 4 × 4 matrices stand under ROTATION, which names their place by a number of 16 bits:
    where the points take more blocks than that, they are left out.
    """
    markers = markers_of(take)
    segments, joints = take.skeleton.segment_names, take.skeleton.joints
    angles = [f"{joint.name}_angles" for joint in joints]
    labels = [*segments, *(f"{name}_tip" for name in segments), *angles]
    labels += [] if markers is None else markers.labels
    n_frames = len(take.q_wb)
    point_blocks = -(-n_frames * len(labels) * _POINT_BYTES // _BLOCK_BYTES)
    groups = _point_groups(take, labels, angles, _UNITS.get(units_per_m, "mm"))
    groups["ROTATION"] = _rotation_group(take)
    start = 2 + len(_parameters(groups)) // _BLOCK_BYTES
    groups["POINT"]["DATA_START"] = start
    if has_rotations := start + point_blocks <= _LAST_BLOCK:
        groups["ROTATION"]["DATA_START"] = start + point_blocks
    else:
        del groups["ROTATION"]
    section = _parameters(groups).ljust((start - 2) * _BLOCK_BYTES, b"\0")
    with path.open("wb") as file:
        file.write(_header(take, len(labels), start) + section)
        for rows in _blocks(n_frames):
            file.write(_points(take, markers, rows, units_per_m).astype("<f4").tobytes())
        if has_rotations:
            file.write(bytes(-file.tell() % _BLOCK_BYTES))
            for rows in _blocks(n_frames):
                file.write(_matrices(take, rows, units_per_m).astype("<f4").tobytes())
    if has_rotations:
        return None
    return f"{path.name} has no rotations: C3D cannot hold them behind more than 32 MiB of points"


def _blocks(n_frames: int) -> Iterator[slice]:
    """Yield the rows of all frames, some thousand at once."""
    return (slice(first, first + _FRAMES_AT_ONCE) for first in range(0, n_frames, _FRAMES_AT_ONCE))


def _points(take: Take, markers: TakenMarkers | None, rows: slice, units_per_m: float) -> FloatArray:
    """Return the points of some frames with their residuals, (F, N, 4)."""
    q_wb, places = take.q_wb[rows], take.p_w[rows]
    tips = places + rotated(q_wb, take.skeleton.tips)
    angles = np.nan_to_num(np.degrees(take.joint_angles[rows])).reshape(len(q_wb), -1, 3)
    known = np.concatenate([places * units_per_m, tips * units_per_m, angles], axis=1)
    points = np.concatenate([known, np.zeros((*known.shape[:2], 1))], axis=2)
    if markers is None:
        return points
    residuals = np.minimum(np.floor(markers.residuals[rows, :, None] * units_per_m), _MOST_RESIDUAL)
    words = np.where(np.isnan(residuals), _NOT_SEEN, residuals * _RESIDUAL_STEP)
    seen = np.concatenate([np.nan_to_num(markers.positions[rows] * units_per_m), words], axis=2)
    return np.concatenate([points, seen], axis=1)


def _matrices(take: Take, rows: slice, units_per_m: float) -> FloatArray:
    """Return rotation and place of the proximal joint of every segment, (F, S, 17).

    A 4 × 4 matrix, column by column, and how reliable it is.
    """
    q_wb = take.q_wb[rows]
    frames, segments = q_wb.shape[:2]
    pose = np.zeros((frames, segments, 4, 4))
    pose[..., :3, :3] = rotation(q_wb).as_matrix().reshape(frames, segments, 3, 3)
    pose[..., :3, 3] = take.p_w[rows] * units_per_m
    pose[..., 3, 3] = 1.0
    columns = pose.transpose(0, 1, 3, 2).reshape(frames, segments, 16)
    return np.concatenate([columns, np.zeros((frames, segments, 1))], axis=2)


def _numbers(take: Take) -> tuple[int, int]:
    """Return the numbers of the first and the last frame; the one at 0 s is 1."""
    first = max(1, 1 + round(take.begins_s * take.rate_hz))
    return first, first + len(take.q_wb) - 1


def _header(take: Take, n_points: int, start: int) -> bytes:
    """Return the first block. Frames whose numbers need more than its 16 bits are counted from 1 there."""
    first, last = _numbers(take)
    if last >= _MOST_IN_WORD:
        first, last = 1, min(len(take.q_wb), _MOST_IN_WORD)
    words = np.array([n_points, 0, first, last, 10, 0, 0, start, 1], "<u2")
    words[5:7] = np.array([_FLOATS], "<f4").view("<u2")
    rate = np.array([take.rate_hz], "<f4").tobytes()
    return (b"\x02\x50" + words.tobytes() + rate).ljust(_BLOCK_BYTES, b"\0")


def _point_groups(take: Take, labels: list[str], angles: list[str], unit: str) -> Groups:
    """Return the parameters that every C3D file has; where the points begin is told later."""
    first, last = _numbers(take)
    lists = [labels[i : i + _MOST_IN_LIST] for i in range(0, len(labels), _MOST_IN_LIST)]
    names = ["LABELS", *(f"LABELS{n}" for n in range(2, len(lists) + 1))]
    groups: Groups = {
        "POINT": {
            "USED": len(labels),
            **dict(zip(names, lists, strict=True)),
            "DESCRIPTIONS": [""] * len(lists[0]),
            "SCALE": _FLOATS,
            "UNITS": unit,
            "RATE": take.rate_hz,
            "DATA_START": 0,
            "FRAMES": min(len(take.q_wb), _MOST_IN_WORD),
            "ANGLES": angles,
        },
        "ANALOG": {"USED": 0, "LABELS": list[str](), "GEN_SCALE": 1.0, "RATE": take.rate_hz},
        "FORCE_PLATFORM": {"USED": 0, "ZERO": [1, 0]},
    }
    if last >= _MOST_IN_WORD:
        # Numbers of 32 bits in two words each, as Vicon writes them.
        words = {"ACTUAL_START_FIELD": first, "ACTUAL_END_FIELD": last}
        groups["TRIAL"] = {name: list(divmod(number, 2**16))[::-1] for name, number in words.items()}
    return groups


def _rotation_group(take: Take) -> dict[str, Value]:
    names = list(take.skeleton.segment_names)
    return {"USED": len(names), "DATA_START": 0, "RATE": take.rate_hz, "LABELS": names, "RATIO": 1}


def _parameters(groups: Groups) -> bytes:
    """Return the section of parameters, filled to whole blocks."""
    entries = b""
    for number, (group, parameters) in enumerate(groups.items(), 1):
        entries += _entry(group, -number, b"\0")
        for name, value in parameters.items():
            entries += _entry(name, number, _value(value) + b"\0")
    blocks = -(-(4 + len(entries) + 2) // _BLOCK_BYTES)
    return (bytes([1, 0x50, blocks, _INTEL]) + entries).ljust(blocks * _BLOCK_BYTES, b"\0")


def _entry(name: str, group: int, content: bytes) -> bytes:
    """Return a group or parameter; its content ends with the length of a description that it has not."""
    step = (len(content) + 2).to_bytes(2, "little")
    return bytes([len(name), group % 256]) + name.encode("ascii") + step + content


def _value(value: Value) -> bytes:
    """Return type, dimensions and data of a parameter."""
    if isinstance(value, str):
        return bytes([255, 1, len(value)]) + value.encode("latin-1", "replace")
    if isinstance(value, float):
        return bytes([4, 0]) + np.array([value], "<f4").tobytes()
    if isinstance(value, int):
        return bytes([2, 0]) + np.array([value], "<u2").tobytes()
    if all(isinstance(each, int) for each in value) and value:
        return bytes([2, 1, len(value)]) + np.array(value, "<u2").tobytes()
    texts = [str(each).encode("latin-1", "replace") for each in value]
    width = max(map(len, texts), default=0)
    return bytes([255, 2, width, len(texts)]) + b"".join(text.ljust(width) for text in texts)
