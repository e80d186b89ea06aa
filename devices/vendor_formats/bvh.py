"""BVH: a hierarchy of joints with rest offsets, then a line of channels a frame, as animation programs write.

A file says neither its unit nor where its joints are on a person. Joints are known by their names and by how
they hang together; the person's own legs give the unit. Axes of segments follow from the rest posture: the
bone is the segment's length, and where the person looks at rest is forward, whatever arms and legs do there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from devices.deferred import Rotation
from devices.recorded_tracks import FusedTrack, LocalTrack, RecordedTracks
from devices.vendor_formats.gaps import checked_rate
from devices.vendor_formats.sheets import FloatArray, FormatError, read_lines
from firmware_protocol.samples import POSITION

PATH_DEVICE = 60
"""Module id under which the path of the hips is sent, as of a local measuring device."""
_PATH_SIGMA_M = 0.01
_TO_WORLD = {
    1: np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    2: np.eye(3),
    0: np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}
"""From the file's axes to a world with Z up, by the axis that points up there."""
_SAME_RATE = 1e-4
_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_SIDES = {"left": "left", "lft": "left", "l": "left", "right": "right", "rgt": "right", "r": "right"}
_PARTS = {
    "thigh": ("upleg", "upperleg", "thigh", "bipthigh", "femur", "hip", "buttock"),
    "shank": ("leg", "lowerleg", "lowleg", "shin", "calf", "knee", "tibia", "shank", "bipcalf"),
    "foot": ("foot", "ankle", "bipfoot"),
    "upper_arm": ("arm", "uparm", "upperarm", "humerus", "shldr"),
    "forearm": ("forearm", "lowarm", "lowerarm", "elbow", "radius"),
    "hand": ("hand", "wrist"),
    "shoulder_girdle": ("shouldergirdle", "collar", "clavicle", "shoulder"),
}
"""What joints of a side are called, without side and separators: the segment that begins there."""
_HEAD = ("head",)
_LONG = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shank", "shank": "foot"}
"""Segments whose length lies along their bone, with the one that ends it."""


@dataclass
class _Joint:
    name: str
    parent: int
    offset: FloatArray
    channels: list[str] = field(default_factory=list)
    first: int = 0
    """Column of its first channel."""


@dataclass(frozen=True)
class _Motion:
    joints: list[_Joint]
    values: FloatArray  # (F, C)
    rate_hz: float
    notes: tuple[str, ...]


def read_bvh(
    path: Path, leg_m: float, given: Mapping[str, str] | None = None, *, partial: bool = False
) -> RecordedTracks:
    """Read a module for every segment of a person, by the segment's name, and the hips' path.

    leg_m: thigh and shank together of who shall move so, m: the file's unit follows from its own. given:
    joint to segment, where names do not say it. partial: take the frames before the first damage. Raises
    ``FormatError``.
    """
    motion = _read(path, partial=partial)
    joints = motion.joints
    segments = _segments(joints, path, given or {})
    turned, places = _posture(motion)
    rest = np.array([joint.offset for joint in joints])
    for j, joint in enumerate(joints):
        if joint.parent >= 0:
            rest[j] = rest[joint.parent] + joint.offset
    up = _up_axis(joints, segments, rest, path)
    right = rest[segments["right_thigh"]] - rest[segments["left_thigh"]]
    axes = _rest_axes(segments, rest, up, right)
    world = _TO_WORLD[int(np.argmax(np.abs(up)))]
    if up.sum() < 0:  # a half turn about a level axis, and no mirror
        world = np.diag([1.0, -1.0, -1.0]) @ world
    times = np.arange(len(motion.values)) / motion.rate_hz
    fused = tuple(
        FusedTrack(module, name, times, _quaternions(world @ turned[:, joint] @ axes[name]))
        for module, (name, joint) in enumerate(segments.items())
    )
    unit_m = leg_m / _leg(segments, rest, path)
    hips = 0.5 * (places[:, segments["left_thigh"]] + places[:, segments["right_thigh"]]) * unit_m
    local = LocalTrack(PATH_DEVICE, "pelvis", times, POSITION, hips @ world.T, _PATH_SIGMA_M)
    named = ", ".join(f"{joints[joint].name} → {name}" for name, joint in segments.items())
    notes = (
        f"joints: {named}",
        f"the file's unit is taken for {unit_m:.4g} m, by which its legs are as long as the body's",
        *motion.notes,
    )
    return RecordedTracks("bvh", motion.rate_hz, (), local=(local,), fused=fused, notes=notes)


def _quaternions(rotations: FloatArray) -> FloatArray:
    """Return quaternions (F, 4), wxyz, of rotations (F, 3, 3)."""
    q: FloatArray = Rotation.from_matrix(rotations).as_quat(canonical=True, scalar_first=True)
    return q


def _read(path: Path, *, partial: bool) -> _Motion:
    lines = read_lines(path)
    at = next((n for n, line in enumerate(lines) if line.strip().upper() == "MOTION"), None)
    if not lines[0].strip().upper().startswith("HIERARCHY") or at is None:
        what = "begins with HIERARCHY" if at is not None else "has a line MOTION behind its hierarchy"
        raise FormatError(f"{path}: not a BVH file, or cut off: it {what}")
    joints = _hierarchy(lines[1:at], path)
    head = " ".join(lines[at + 1 : at + 3])
    header = re.search(r"Frames:\s*(\d+)\s+Frame Time:\s*([-+.\deE]+)", head)
    seconds = float(header[2]) if header and re.fullmatch(r"[-+]?[\d.]+([eE][-+]?\d+)?", header[2]) else 0.0
    if header is None or not 0 < seconds < 60:
        raise FormatError(
            f"{path}: line {at + 2}: 'Frames: N' and 'Frame Time: SECONDS' are wanted behind MOTION"
        )
    # Frame times are rounded in most files: 0.0333333 means 30 Hz.
    rate_hz = 1.0 / seconds
    rate_hz = round(rate_hz) if abs(rate_hz - round(rate_hz)) < _SAME_RATE * rate_hz else rate_hz
    values, notes = _values(
        lines, at + 3, sum(len(joint.channels) for joint in joints), path, partial=partial
    )

    if len(values) != int(header[1]):
        notes += (f"{path}: {len(values)} frames, of which 'Frames:' tells {header[1]}: all that are there",)
    if len(values) < 2:
        raise FormatError(f"{path}: {len(values)} frames: a motion needs two at least")
    return _Motion(joints, values, checked_rate(rate_hz, path), notes)


def _values(
    lines: list[str], begin: int, count: int, path: Path, *, partial: bool
) -> tuple[FloatArray, tuple[str, ...]]:
    rows: list[list[float]] = []
    for number, line in enumerate(lines[begin:], begin + 1):
        if not line.strip():
            continue
        try:
            row = [float(text) for text in line.split()]
            if len(row) != count:
                raise ValueError(f"{len(row)} numbers where {count} channels are wanted")
            if not np.isfinite(row).all():
                raise ValueError("a number is infinite, or none")
        except ValueError as error:
            message = f"{path}: line {number}: {error}"
            if partial:
                # A file that was cut off ends in the middle of a line.
                return np.array(rows).reshape(-1, count), (f"{message}: the frames before it are taken",)
            raise FormatError(f"{message}; --partial imports the frames before it") from None
        rows.append(row)
    return np.array(rows).reshape(-1, count), ()


def _hierarchy(lines: list[str], path: Path) -> list[_Joint]:
    joints: list[_Joint] = []
    open_joints: list[int] = []
    """-1 for an end site."""
    column = 0
    for number, line in enumerate(lines, 2):
        words = line.split()
        kind = words[0].upper() if words else ""
        if kind in {"ROOT", "JOINT"}:
            name = " ".join(words[1:]).removesuffix("{").strip()
            joints.append(_Joint(name, open_joints[-1] if open_joints else -1, np.zeros(3)))
            open_joints.append(len(joints) - 1)
        # An end site has an offset too, which belongs to no joint.
        elif kind == "END":
            open_joints.append(-1)
        elif kind == "OFFSET" and open_joints:
            offset = _numbers(words[1:4], 3, path, number)
            if open_joints[-1] >= 0:
                joints[open_joints[-1]].offset = offset
        elif kind == "CHANNELS" and open_joints and open_joints[-1] >= 0:
            joint = joints[open_joints[-1]]
            joint.channels, joint.first = words[2:], column
            column += len(joint.channels)
            if any(
                not re.fullmatch("[XYZ](position|rotation)", each, re.IGNORECASE) for each in joint.channels
            ):
                raise FormatError(
                    f"{path}: line {number}: channels are Xposition, Zrotation and so on: {line.strip()}"
                )
        elif "}" in kind and open_joints:
            open_joints.pop()
        elif kind not in {"", "{"}:
            raise FormatError(f"{path}: line {number}: '{line.strip()[:40]}' is nothing that a hierarchy has")
    if not joints or open_joints:
        raise FormatError(
            f"{path}: its hierarchy does not close: {len(open_joints)} brackets are open at MOTION"
        )
    if sum(joint.parent < 0 for joint in joints) > 1:
        raise FormatError(f"{path}: several ROOTs: one person a file can be read")
    return joints


def _numbers(words: list[str], count: int, path: Path, number: int) -> FloatArray:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise FormatError(f"{path}: line {number}: {error}") from None
    if len(values) != count or not np.isfinite(values).all():
        raise FormatError(f"{path}: line {number}: {count} numbers are wanted behind OFFSET")
    return values


def _posture(motion: _Motion) -> tuple[FloatArray, FloatArray]:
    """Return rotations (F, J, 3, 3) and places (F, J, 3) of all joints, in the file's axes and unit."""
    frames, joints = len(motion.values), motion.joints
    turned, places = np.empty((frames, len(joints), 3, 3)), np.empty((frames, len(joints), 3))
    for j, joint in enumerate(joints):
        columns = motion.values[:, joint.first : joint.first + len(joint.channels)]
        kinds = [channel.lower() for channel in joint.channels]
        # The order of the channels is the order of the rotations, and each joint may have another one.
        order = "".join(kind[0].upper() for kind in kinds if kind.endswith("rotation"))
        angles = columns[:, [n for n, kind in enumerate(kinds) if kind.endswith("rotation")]]
        own = Rotation.from_euler(order, angles, degrees=True).as_matrix() if order else np.eye(3)[None]
        place = np.tile(joint.offset, (frames, 1))
        for n, kind in enumerate(kinds):
            if kind.endswith("position"):
                place[:, "xyz".index(kind[0])] = columns[:, n]
        if joint.parent < 0:
            turned[:, j], places[:, j] = own, place
        else:
            above = turned[:, joint.parent]
            turned[:, j] = above @ own
            places[:, j] = places[:, joint.parent] + np.einsum("fij,fj->fi", above, place)
    return turned, places


def _segments(joints: list[_Joint], path: Path, given: Mapping[str, str]) -> dict[str, int]:
    """Return segment to the joint where it begins. Raises ``FormatError`` without hips and both legs."""
    names = {joint.name: j for j, joint in enumerate(joints)}
    for name in given:
        if name not in names:
            raise FormatError(f"{path}: --map {name}=…: no such joint; there are {', '.join(names)}")
    found: dict[str, int] = {"pelvis": 0}
    for side in ("left", "right"):
        called = {j: part for j, joint in enumerate(joints) if (part := _called(joint.name, side))}
        for segment, spellings in _PARTS.items():
            # of several spellings the first: LeftUpLeg before LeftHip; those farther out win over one that
            # only bears the limb (LHipJoint is not LeftHip)
            own = [j for word in spellings for j, part in called.items() if part == word]
            if own:
                found[f"{side}_{segment}"] = own[0]
        _shoulder_for_arm(found, side, joints)
    heads = [j for j, joint in enumerate(joints) if _plain(joint.name) in _HEAD]
    if heads:
        found["head"] = heads[0]
    thorax = _bearer(found, joints)
    if thorax is not None:
        found["thorax"] = thorax
    found |= {segment: names[name] for name, segment in given.items()}
    missing = [f"{side}_{part}" for side in ("left", "right") for part in ("thigh", "shank", "foot")]
    missing = [name for name in missing if name not in found]
    if missing:
        raise FormatError(
            f"{path}: no joint is called as {', '.join(missing)} would be: tell with --map JOINT=SEGMENT; "
            f"there are {', '.join(names)}"
        )
    return dict(sorted(found.items(), key=lambda item: item[1]))


def _shoulder_for_arm(found: dict[str, int], side: str, joints: list[_Joint]) -> None:
    """Take a joint that is called shoulder for the upper arm where nothing else is, and an elbow follows."""
    arm, girdle, forearm = (f"{side}_{part}" for part in ("upper_arm", "shoulder_girdle", "forearm"))
    if arm in found or forearm not in found:
        return
    found[arm] = joints[found[forearm]].parent
    if found.get(girdle) == found[arm]:
        del found[girdle]


def _bearer(found: Mapping[str, int], joints: list[_Joint]) -> int | None:
    """Return the joint that carries both arms and the neck; None if it is the hips."""
    ways = [[*_way(joints, found[name])] for name in ("left_upper_arm", "right_upper_arm") if name in found]
    if len(ways) < 2:
        return None
    shared = [j for j in ways[0] if j in ways[1]]
    return shared[0] if shared and shared[0] != 0 else None


def _way(joints: list[_Joint], joint: int) -> Iterator[int]:
    while joint >= 0:
        yield joint
        joint = joints[joint].parent


def _plain(name: str) -> str:
    return re.sub(r"[\W_\d]+", "", name.rpartition(":")[2]).lower()


def _called(name: str, side: str) -> str | None:
    """Return what is left of a joint's name without its side; None for another side or none."""
    words = [word.lower() for word in _WORDS.findall(name.rpartition(":")[2])]
    sides = [n for n, word in enumerate(words) if word in _SIDES]
    if not sides or _SIDES[words[sides[0]]] != side:
        return None
    return "".join(word for n, word in enumerate(words) if n != sides[0])


def _up_axis(joints: list[_Joint], segments: Mapping[str, int], rest: FloatArray, path: Path) -> FloatArray:
    """Return the axis of the file (3,) that points from the feet to the hips at rest, signed."""
    feet = 0.5 * (rest[segments["left_foot"]] + rest[segments["right_foot"]])
    tall = 0.5 * (rest[segments["left_thigh"]] + rest[segments["right_thigh"]]) - feet
    if not np.abs(tall).max() > 0:
        raise FormatError(f"{path}: at rest its feet are where its hips are: {joints[0].name} has no legs")
    up: FloatArray = np.zeros(3)
    axis = int(np.argmax(np.abs(tall)))
    up[axis] = np.sign(tall[axis])
    return up


def _rest_axes(
    segments: Mapping[str, int], rest: FloatArray, up: FloatArray, right: FloatArray
) -> dict[str, FloatArray]:
    """Return the axes (3, 3) of every segment at rest: x forward, y up, z right, in the file's axes."""
    level = right - (right @ up) * up
    forward = np.cross(up, level / np.linalg.norm(level))
    axes: dict[str, FloatArray] = {}
    for name in segments:
        side, _, part = name.partition("_")
        along = up
        if part in _LONG and (end := segments.get(f"{side}_{_LONG[part]}")) is not None:
            bone = rest[segments[name]] - rest[end]
            along = bone / np.linalg.norm(bone) if np.linalg.norm(bone) > 0 else up
        elif part == "hand" and f"{side}_forearm" in segments:
            along = axes[f"{side}_forearm"][:, 1]
        ahead = forward - (forward @ along) * along
        if np.linalg.norm(ahead) < 0.1:  # arms stretched forward at rest
            ahead = -up - (-up @ along) * along
        ahead /= np.linalg.norm(ahead)
        axes[name] = np.stack([ahead, along, np.cross(ahead, along)], axis=1)
    return axes


def _leg(segments: Mapping[str, int], rest: FloatArray, path: Path) -> float:
    """Return the thigh and shank together, mean of both sides, in the file's unit."""
    lengths = [
        float(np.linalg.norm(rest[segments[f"{side}_{end}"]] - rest[segments[f"{side}_{begin}"]]))
        for side in ("left", "right")
        for begin, end in (("thigh", "shank"), ("shank", "foot"))
    ]
    if min(lengths) <= 0:
        raise FormatError(f"{path}: a thigh or a shank has no length")
    return 0.5 * sum(lengths)
