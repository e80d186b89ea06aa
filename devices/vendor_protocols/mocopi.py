"""Datagrams of Sony's mocopi: bones of a body, fused by the app, 50 or 60 times a second.

Every field is a length, four letters and a value, little-endian; some hold fields: ``head``, ``sndf``, and
``skdf`` (the skeleton) or ``fram`` (one instant). Right-handed, y up, bones relative to their parents,
unrotated in a T-pose facing z. (Sony's specification, and its published supplement.)
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from devices.vendor_protocols.plausibility import either_way, fault

PORT = 12351
FORMAT = b"sony motion format"
PARENTS = (-1, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 7, 11, 12, 13, 7, 15, 16, 17, 0, 19, 20, 21, 0, 23, 24, 25)
"""Of the bones by number: root, seven of the torso, two of the neck, head, left arm, right arm, left leg,
right leg from shoulder or hip outwards."""
LONGEST = 8192
_SIGN, _SIGN_AT = b"ftyp" + FORMAT, 12
"""Where every datagram has it."""
_FIELD = struct.Struct("<I4s")
_TRANSFORM = struct.Struct("<7f")
_GATES = (*[either_way("not_a_rotation", 1.02)] * 4, *[either_way("too_far", 1e4)] * 3)
_LEAST_NORM = 0.98


@dataclass(frozen=True, slots=True)
class Frame:
    """All bones at one instant."""

    number: int
    time_ms: int
    bones: tuple[tuple[int, tuple[float, float, float, float], tuple[float, float, float]], ...]
    """Number, turn against the parent (w first), place in the parent, m."""


def encode(frame: Frame) -> bytes:
    """Return the datagram of an instant."""
    bones = b"".join(
        _field(
            b"btdt",
            _field(b"bnid", struct.pack("<H", bone)) + _field(b"tran", _TRANSFORM.pack(x, y, z, w, *p)),
        )
        for bone, (w, x, y, z), p in frame.bones
    )
    head = _field(b"head", _field(b"ftyp", FORMAT) + _field(b"vrsn", b"\x01"))
    sender = _field(b"sndf", _field(b"ipad", bytes(8)) + _field(b"rcvp", struct.pack("<H", PORT)))
    dated = _field(b"fnum", struct.pack("<I", frame.number)) + _field(
        b"time", struct.pack("<I", frame.time_ms)
    )
    dated += _field(b"uttm", struct.pack("<d", frame.time_ms * 1e-3))
    return head + sender + _field(b"fram", dated + _field(b"btrs", bones))


def _field(name: bytes, value: bytes) -> bytes:
    return _FIELD.pack(len(value), name) + value


def _fields(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield names and values. Raises ``ValueError`` where lengths do not fit."""
    place = 0
    while place < len(data):
        if len(data) - place < _FIELD.size:
            raise ValueError("a field is cut off")
        length, name = _FIELD.unpack_from(data, place)
        place += _FIELD.size
        if length > len(data) - place:
            raise ValueError("a field is longer than what holds it")
        yield name, data[place : place + length]
        place += length


class MocopiDecoder:
    """What one app sends. ``dropped``: noise, bad_field, cut_off (another begins in it), and what cannot be:
    not_a_rotation, too_far."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self.unused = 0
        """Descriptions of the skeleton."""
        self._rest = b""

    def feed(self, data: bytes) -> list[Frame]:
        """Return the instants that these bytes complete, in order."""
        found, rest = [], self._rest + data
        while len(rest) >= _FIELD.size:
            length = _length(rest)
            if length == 0:
                begin = rest.find(b"head", 5) - 4
                begin = begin if begin > 0 else len(rest) - _FIELD.size + 1
                self.dropped["noise"] += begin
                rest = rest[begin:]
                continue
            if length is None:  # nor is it known whether one does that another cuts off
                break
            another = rest.find(_SIGN, _SIGN_AT + 1, length)
            if another > _SIGN_AT:  # it was cut off, or has a wrong length
                self.dropped["cut_off"] += 1
                rest = rest[another - _SIGN_AT :]
                continue
            if len(rest) < length:
                break
            frame = self._read(rest[:length])
            found += [] if frame is None else [frame]
            rest = rest[length:]
        self._rest = rest
        return found

    def _read(self, data: bytes) -> Frame | None:
        try:
            parts = dict(_fields(data))
            if dict(_fields(parts[b"head"]))[b"ftyp"] != FORMAT:
                raise ValueError("another format")
            # The skeleton's definition comes in datagrams of its own, which hold no pose.
            if b"fram" not in parts:
                self.unused += 1
                return None
            inner = dict(_fields(parts[b"fram"]))
            (number,), (time_ms,) = struct.unpack("<I", inner[b"fnum"]), struct.unpack("<I", inner[b"time"])
            bones = [dict(_fields(value)) for name, value in _fields(inner[b"btrs"]) if name == b"btdt"]
            transforms = [(struct.unpack("<H", b[b"bnid"])[0], _TRANSFORM.unpack(b[b"tran"])) for b in bones]
        except (ValueError, KeyError, struct.error):
            self.dropped["bad_field"] += 1
            return None
        for _, values in transforms:
            why = fault(values, _GATES) or _norm_fault(values)
            if why is not None:
                self.dropped[why] += 1
                return None
        return Frame(
            # Sony sends x y z w; orientations are w x y z here.
            number,
            time_ms,
            tuple((n, (v[3], v[0], v[1], v[2]), (v[4], v[5], v[6])) for n, v in transforms),
        )


def _norm_fault(values: Sequence[float]) -> str | None:
    return None if math.hypot(*values[:4]) >= _LEAST_NORM else "not_a_rotation"


def _length(rest: bytes) -> int | None:
    """Return the bytes of the datagram that begins here; 0: none does; None: not yet known."""
    place = 0
    for names in ({b"head"}, {b"sndf"}, {b"fram", b"skdf"}):
        if len(rest) < place + _FIELD.size:
            return None
        length, name = _FIELD.unpack_from(rest, place)
        if name not in names or length > LONGEST:
            return 0
        place += _FIELD.size + length
    return place
