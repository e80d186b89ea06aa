"""Datagrams of the MVN network streamer: poses and trackers of an Xsens suit, to values and back.

A datagram is a head of 24 bytes and items, big-endian: ``MXTP`` and two digits for its kind, the number of
the sample, its part of that sample, how many items, the time in ms, the character, how many segments, and
how many bytes follow (MVN real-time network streaming protocol). World axes: right-handed, z up. Segment
axes: x forward, y to the left, z up, in a T-pose; those of joint angles x forward, y up, z to the right with
the arms hanging, as the ISB has them. Over TCP datagrams stand one after another.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from devices.vendor_protocols.plausibility import Gate, either_way, fault
from devices.vendor_protocols.rotations import Quaternion

Vector = tuple[float, float, float]

PORT = 9763
MAGIC = b"MXTP"
QUATERNIONS, META, SCALE, JOINT_ANGLES, TRACKERS, TIME_CODE = b"02", b"12", b"13", b"20", b"23", b"25"
SEGMENTS = (
    "pelvis", "l5", "l3", "t12", "thorax", "neck", "head",
    "right_shoulder_girdle", "right_upper_arm", "right_forearm", "right_hand",
    "left_shoulder_girdle", "left_upper_arm", "left_forearm", "left_hand",
    "right_thigh", "right_shank", "right_foot", "right_toes",
    "left_thigh", "left_shank", "left_foot", "left_toes",
)  # fmt: skip
"""In the order of their numbers, from 1; what MVN calls T8 is the thorax."""
STREAMED_NAMES = (
    "Pelvis", "L5", "L3", "T12", "T8", "Neck", "Head",
    "RightShoulder", "RightUpperArm", "RightForeArm", "RightHand",
    "LeftShoulder", "LeftUpperArm", "LeftForeArm", "LeftHand",
    "RightUpperLeg", "RightLowerLeg", "RightFoot", "RightToe",
    "LeftUpperLeg", "LeftLowerLeg", "LeftFoot", "LeftToe",
)  # fmt: skip
"""The same as MVN calls them."""
PARENTS = (0, 1, 2, 3, 4, 5, 6, 5, 8, 9, 10, 5, 12, 13, 14, 1, 16, 17, 18, 1, 20, 21, 22)
"""Numbers likewise; 0: none."""
_SIDEWAYS = {"left": (0.0, -1.0, 0.0, 0.0), "right": (1.0, 0.0, 0.0, 0.0)}
TO_ISB: tuple[Quaternion, ...] = tuple(
    _SIDEWAYS[name.partition("_")[0]]
    if name.endswith(("arm", "hand"))
    else (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)
    for name in SEGMENTS
)
"""Takes the axes of each segment as MVN has them to those of the ISB; w first."""
LONGEST = 8192
"""Bytes after the head of a datagram."""
POINTS = 256
"""Points of a segment: the origin of segment n is number 256 n."""
_HEAD = struct.Struct(">4s2siBBiBBBBHH")
_LAST = 0x80


@dataclass(frozen=True, slots=True)
class SegmentPose:
    """Where one segment is."""

    segment: int
    position: Vector  # m
    orientation: Quaternion  # segment to world, w first


@dataclass(frozen=True, slots=True)
class JointRotation:
    """How one joint is bent."""

    parent: int
    child: int
    angles: Vector
    """Degrees about x, y, z of the ISB's axes: parent to child is the turn about z, then x, then y."""


@dataclass(frozen=True, slots=True)
class Tracker:
    """What one tracker measured and made of it."""

    segment: int
    orientation: Quaternion  # sensor to world
    free_acceleration: Vector  # m/s², world
    specific_force: Vector  # m/s²
    angular_rate: Vector  # rad/s
    field: Vector  # fields of calibration


Item = SegmentPose | JointRotation | Tracker


@dataclass(frozen=True, slots=True)
class Datagram:
    """Items of one sample, all of them or a part."""

    sample: int
    time_ms: int
    character: int
    items: tuple[Item, ...]


class Layout(NamedTuple):
    """How the items of a kind are laid out, and what their numbers can be."""

    form: struct.Struct
    read: Callable[[Sequence[float]], Item]
    write: Callable[[Item], Sequence[float]]
    gates: Sequence[Gate]
    quaternion: int | None
    """Place of the first of its four numbers."""


def _pose(v: Sequence[float]) -> Item:
    return SegmentPose(int(v[0]), (v[1], v[2], v[3]), (v[4], v[5], v[6], v[7]))


def _joint(v: Sequence[float]) -> Item:
    return JointRotation(int(v[0]) // POINTS, int(v[1]) // POINTS, (v[2], v[3], v[4]))


def _tracker(v: Sequence[float]) -> Item:
    vectors = [(v[at], v[at + 1], v[at + 2]) for at in (5, 8, 11, 14)]
    return Tracker(int(v[0]), (v[1], v[2], v[3], v[4]), vectors[0], vectors[1], vectors[2], vectors[3])


def _of_pose(item: Item) -> Sequence[float]:
    assert isinstance(item, SegmentPose)
    return item.segment, *item.position, *item.orientation


def _of_joint(item: Item) -> Sequence[float]:
    assert isinstance(item, JointRotation)
    return item.parent * POINTS, item.child * POINTS, *item.angles


def _of_tracker(item: Item) -> Sequence[float]:
    assert isinstance(item, Tracker)
    measured = (*item.free_acceleration, *item.specific_force, *item.angular_rate, *item.field)
    return item.segment, *item.orientation, *measured


_SEGMENT = Gate("no_segment", 1, 255)
_POINT = Gate("no_segment", POINTS, 256 * POINTS - 1)
_UNIT = either_way("not_a_rotation", 1.02)
_LEAST_NORM = 0.98
LAYOUTS: Mapping[bytes, Layout] = {
    QUATERNIONS: Layout(
        struct.Struct(">i7f"), _pose, _of_pose, (_SEGMENT, *[either_way("too_far", 1e5)] * 3, *[_UNIT] * 4), 4
    ),
    JOINT_ANGLES: Layout(
        struct.Struct(">2i3f"),
        _joint,
        _of_joint,
        (_POINT, _POINT, *[either_way("no_angle", 720.0)] * 3),
        None,
    ),
    TRACKERS: Layout(
        struct.Struct(">i16f"),
        _tracker,
        _of_tracker,
        (
            _SEGMENT,
            *[_UNIT] * 4,
            *[either_way("force_beyond_sensor", 250.0)] * 6,
            *[either_way("rate_beyond_sensor", 40.0)] * 3,
            *[either_way("field_beyond_sensor", 100.0)] * 3,
        ),
        1,
    ),
}
"""By kind: those that something is made from."""


def encode(
    kind: bytes, sample: int, time_ms: int, items: Sequence[Item], character: int = 0, segments: int = 23
) -> bytes:
    """Return a datagram of items."""
    layout = LAYOUTS[kind]
    data = b"".join(_packed(layout, item) for item in items)
    return _headed(kind, sample, time_ms, data, len(items), character, segments)


def encode_text(kind: bytes, sample: int, time_ms: int, text: str, character: int = 0) -> bytes:
    """Return a datagram of kind ``META`` or ``TIME_CODE``."""
    return _headed(kind, sample, time_ms, _string(text), 1, character, 23)


def encode_scale(sample: int, time_ms: int, origins: Mapping[str, Vector]) -> bytes:
    """Return the datagram of where segments begin in the neutral posture, m; no points on them."""
    data = b"".join(_string(name) + struct.pack(">3f", *place) for name, place in origins.items())
    data = struct.pack(">I", len(origins)) + data + struct.pack(">I", 0)
    return _headed(SCALE, sample, time_ms, data, 1, 0, len(origins))


def _packed(layout: Layout, item: Item) -> bytes:
    return layout.form.pack(*layout.write(item))


def _string(text: str) -> bytes:
    data = text.encode()
    return struct.pack(">i", len(data)) + data


def _headed(
    kind: bytes, sample: int, time_ms: int, data: bytes, n_items: int, character: int, segments: int
) -> bytes:
    head = (MAGIC, kind, sample & 0x7FFFFFFF, _LAST, n_items, time_ms & 0x7FFFFFFF)
    return _HEAD.pack(*head, character, segments, 0, 0, 0, len(data)) + data


class MvnDecoder:
    """What one streamer sends, over UDP or TCP.

    ``dropped``: noise (bytes between datagrams), bad_length, cut_off (another begins in it), not_finite, and
    what cannot be: no_segment, not_a_rotation, too_far, no_angle, rate, force and field beyond a sensor.
    """

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self.unused = 0
        """Datagrams of kinds that nothing is made from."""
        self._rest = b""

    def feed(self, data: bytes) -> list[Datagram]:
        """Return the datagrams that these bytes complete, in order."""
        found, rest = [], self._rest + data
        while True:
            begin = _begin(rest)
            self.dropped["noise"] += begin
            rest = rest[begin:]
            if len(rest) < _HEAD.size:
                break
            length = _length(rest)
            if length is None:
                self.dropped["bad_length"] += 1
                rest = rest[1:]
                continue
            another = rest.find(MAGIC, 1, length)
            if another > 0:  # it was cut off, or has a wrong length
                self.dropped["cut_off"] += 1
                rest = rest[another:]
                continue
            if len(rest) < length:
                break
            datagram = self._read(rest[:length])
            found += [] if datagram is None else [datagram]
            rest = rest[length:]
        self._rest = rest
        self.dropped += Counter()  # without the zeros
        return found

    def _read(self, data: bytes) -> Datagram | None:
        _, kind, sample, _, n_items, time_ms, character, *_ = _HEAD.unpack_from(data)
        layout = LAYOUTS.get(kind)
        if layout is None:
            self.unused += 1
            return None
        items = []
        for k in range(n_items):
            values = layout.form.unpack_from(data, _HEAD.size + k * layout.form.size)
            why = fault(values, layout.gates) or _norm_fault(values, layout.quaternion)
            if why is not None:
                self.dropped[why] += 1
                return None
            items.append(layout.read(values))
        return Datagram(sample, time_ms, character, tuple(items))


def _begin(rest: bytes) -> int:
    """Return where a datagram begins, or may begin at the end; the length where none does."""
    place = rest.find(MAGIC)
    if place >= 0:
        return place
    lengths = (n for n in range(len(MAGIC) - 1, 0, -1) if rest.endswith(MAGIC[:n]))
    return len(rest) - next(lengths, 0)


def _norm_fault(values: Sequence[float], place: int | None) -> str | None:
    if place is None or _LEAST_NORM <= math.hypot(*values[place : place + 4]) <= _UNIT.most:
        return None
    return _UNIT.name


def _length(rest: bytes) -> int | None:
    """Return the bytes of the datagram that begins here; None: none does."""
    _, kind, _, _, n_items, _, _, _, _, _, _, length = _HEAD.unpack_from(rest)
    layout = LAYOUTS.get(kind)
    if layout is not None:
        size = n_items * layout.form.size
        return _HEAD.size + size if length in (0, size) else None  # older versions do not say it
    if not length and kind in (META, TIME_CODE) and len(rest) >= _HEAD.size + 4:
        length = 4 + int.from_bytes(rest[_HEAD.size : _HEAD.size + 4], "big")
    return _HEAD.size + length if kind.isalnum() and length <= LONGEST else None
