"""The heat maps of one camera at one instant as bytes: what goes over TCP or MQTT, and into recordings.

    offset  type      what
    0       char[4]   "MGHM"
    4       uint8     version: 1, or 2 of a person with a number
    5       uint8     n: length of the camera's name
    6       uint8     m: length of the network's name
    7       uint8     1: a person is shown; 0: none, and no maps follow
    8       uint32    sequence: pictures since the start
    12      int64     time, ns: of the picture, by the sender's clock
    20      uint32    length of all that follows
    24      char[n]   camera, UTF-8
    24+n    char[m]   network, UTF-8: it decides the names of the maps
    …       uint32    person's number, version 2 alone: see ``HeatMapMessage.person``
    …       uint8     messages of the same picture that follow this one, version 2 alone
    …       float64×6 the affine: pixel (x, y, 1) of the picture to (column, row) of the maps, by rows
    …       uint16×3  maps, rows, columns
    …       bytes     the maps, one byte a cell, likelihood × 255, compressed by zstd

Little endian. On a stream, messages follow each other without anything in between. No picture is part of it.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass

import numpy as np
import zstandard
from numpy.typing import NDArray

MAGIC = b"MGHM"
VERSION, NUMBERED_VERSION = 1, 2
FOUND_BY_CAMERA = 1 << 31
"""Numbers from here on are given by a camera to people it has found; below, by the gateway."""
_HEAD = struct.Struct("<4sBBBBIqI")
_PERSON = struct.Struct("<IB")
_MAPS = struct.Struct("<6d3H")
LONGEST = 4 << 20
"""Bytes of a message; 33 maps of 64 cells a side take about ten thousand."""
_LARGEST_MAPS = 64 << 20
FAINTEST = 4
"""Of 255: what is less likely is written as zero, which takes no room."""


@dataclass(frozen=True)
class HeatMapMessage:
    """The person in one picture of one camera."""

    camera: str
    network: str
    sequence: int
    time_ns: int
    likelihood: NDArray[np.uint8] | None
    """(n_keypoints, rows, columns), 255 is certain; None: nobody is in the picture."""
    map_from_pixel: NDArray[np.float64]
    """(2, 3)."""
    person: int = 0
    """Number of the person; 0: the one person that the camera follows."""
    following: int = 0
    """Messages of the same picture that follow this one."""

    @property
    def is_numbered(self) -> bool:
        """Whether it is one of several people's."""
        return bool(self.person or self.following)


def quantised(likelihood: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return likelihoods of 0 to 1 as bytes."""
    cells: NDArray[np.uint8] = np.rint(255.0 * np.clip(likelihood, 0.0, 1.0)).astype(np.uint8)
    # Nearly all cells are almost zero: as exact zeros they compress to almost nothing.
    cells[cells < FAINTEST] = 0
    return cells


def encode_heat_maps(message: HeatMapMessage) -> bytes:
    """Return a message as bytes. Raises ``ValueError`` for names longer than 255 bytes."""
    names = message.camera.encode(), message.network.encode()
    if max(map(len, names)) > 255:
        raise ValueError("names of cameras and networks have 255 bytes at most")
    body = b"".join(names)
    if message.is_numbered:
        body += _PERSON.pack(message.person, message.following)
    if message.likelihood is not None:
        body += _MAPS.pack(*message.map_from_pixel.ravel(), *message.likelihood.shape)
        body += zstandard.ZstdCompressor(level=1).compress(np.ascontiguousarray(message.likelihood).tobytes())
    head = _HEAD.pack(
        MAGIC, NUMBERED_VERSION if message.is_numbered else VERSION, len(names[0]), len(names[1]),
        message.likelihood is not None, message.sequence, message.time_ns, len(body),
    )  # fmt: skip
    return head + body


def retimed(message: bytes, sequence: int, time_ns: int) -> bytes:
    """Return a message with another sequence and time."""
    *before, _, _, length = _HEAD.unpack_from(message)
    return _HEAD.pack(*before, sequence, time_ns, length) + message[_HEAD.size :]


def camera_of(data: bytes) -> str | None:
    """Return the camera that whole messages are from; None: the bytes are not messages from end to end."""
    at, name = 0, None
    while at < len(data):
        if len(data) - at < _HEAD.size or not data.startswith(MAGIC, at):
            return None
        _, _, n, *_, length = _HEAD.unpack_from(data, at)
        first = at + _HEAD.size
        if length > LONGEST or first + length > len(data) or n > length:
            return None
        name = data[first : first + n].decode(errors="replace")
        at = first + length
    return name


class HeatMapReceiver:
    """A stream of bytes to messages. Never raises: what cannot be read is dropped, and counted by reason."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        """no_message (bytes passed over to the next one), bad_version, too_long, unreadable."""
        self.received = 0
        self._rest = b""

    def receive(self, data: bytes) -> list[HeatMapMessage]:
        """Return the messages that these bytes complete."""
        rest = self._rest + data
        found = []
        while (start := rest.find(MAGIC)) >= 0:
            if start:
                self.dropped["no_message"] += 1
            rest = rest[start:]
            if len(rest) < _HEAD.size:
                break
            _, version, *_, length = _HEAD.unpack_from(rest)
            is_known = version in {VERSION, NUMBERED_VERSION}
            if not is_known or length > LONGEST:
                self.dropped["too_long" if is_known else "bad_version"] += 1
                rest = rest[len(MAGIC) :]
                continue
            if len(rest) < _HEAD.size + length:
                break
            message = _read(rest[: _HEAD.size + length])
            rest = rest[_HEAD.size + length :]
            if message is None:
                self.dropped["unreadable"] += 1
            else:
                self.received += 1
                found.append(message)
        # The beginning of a message may be cut anywhere, also within its magic number.
        self._rest = rest if rest.startswith(MAGIC) else rest[-len(MAGIC) + 1 :]
        return found


def _read(data: bytes) -> HeatMapMessage | None:
    """Return one whole message; None: it contradicts itself."""
    _, version, n, m, has_maps, sequence, time_ns, _ = _HEAD.unpack_from(data)
    body = data[_HEAD.size :]
    at, person, following = n + m, 0, 0
    try:
        camera, network = body[:n].decode(), body[n:at].decode()
        if version == NUMBERED_VERSION:
            person, following = _PERSON.unpack_from(body, at)
            at += _PERSON.size
        if not has_maps:
            return HeatMapMessage(
                camera=camera,
                network=network,
                sequence=sequence,
                time_ns=time_ns,
                likelihood=None,
                map_from_pixel=np.zeros((2, 3)),
                person=person,
                following=following,
            )
        *affine, maps, rows, columns = _MAPS.unpack_from(body, at)
        cells = maps * rows * columns
        # Before anything is unpacked: a damaged head must not ask for all memory.
        if not (0 < cells <= _LARGEST_MAPS and np.isfinite(affine).all()):
            return None
        packed = body[at + _MAPS.size :]
        plain = zstandard.ZstdDecompressor().decompress(packed, max_output_size=cells)
        likelihood = np.frombuffer(plain, dtype=np.uint8).reshape(maps, rows, columns)
    except (struct.error, UnicodeDecodeError, ValueError, zstandard.ZstdError):
        return None
    return HeatMapMessage(
        camera=camera,
        network=network,
        sequence=sequence,
        time_ns=time_ns,
        likelihood=likelihood,
        map_from_pixel=np.reshape(affine, (2, 3)),
        person=person,
        following=following,
    )
