"""Poses, and what became of their markers, to bytes and back; layouts: ``devices.recording_format``."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from devices import recording_format as fmt
from gateway.frames import FloatArray, MarkerFit, SkeletonFrame

_HEAD = struct.Struct("<qqiHBB")
_ARRAYS = (("q_wb", 4), ("angular_rate", 3), ("joint_acceleration", 3), ("p_w", 3), ("sigma", 1))
"""Fields in the order of their bits, with the numbers a segment."""
_UNDEFINED = np.float64(np.nan).tobytes()
_LITTLE = np.dtype("<f8")


def encode_skeleton_frame(frame: SkeletonFrame) -> bytes:
    """Return a frame as bytes. An array that is NaN throughout (the usual NaN, to the bit) is left out."""
    n_segments = len(frame.status)
    mask, parts = 0, []
    for bit, (name, width) in enumerate(_ARRAYS):
        data = np.ascontiguousarray(getattr(frame, name), dtype=_LITTLE).tobytes()
        if data != _UNDEFINED * (n_segments * width):
            mask |= 1 << bit
            parts.append(data)
    head = _HEAD.pack(frame.sequence, frame.time_ns, frame.root, n_segments, mask, 0)
    return b"".join((head, frame.status.astype(np.uint8).tobytes(), *parts))


def decode_skeleton_frame(data: bytes) -> SkeletonFrame:
    """Return the frame that ``data`` was made of. Raises ``ValueError`` for bytes that are none."""
    if len(data) < _HEAD.size:
        raise ValueError(f"{len(data)} bytes are no skeleton frame")
    # The mask says which arrays follow; arrays that are NaN throughout are left out to save space.
    sequence, time_ns, root, n_segments, mask, _ = _HEAD.unpack_from(data)
    offset = _HEAD.size + n_segments
    present = [(name, width) for bit, (name, width) in enumerate(_ARRAYS) if mask >> bit & 1]
    expected = offset + 8 * n_segments * sum(width for _, width in present)
    # Checked before anything is read: the file may be damaged, and must not be read past its end.
    if len(data) != expected:
        raise ValueError(f"a skeleton frame of {n_segments} segments has {expected} bytes, not {len(data)}")
    arrays: dict[str, FloatArray] = {}
    for name, width in _ARRAYS:
        shape = (n_segments,) if width == 1 else (n_segments, width)
        if (name, width) in present:
            values = np.frombuffer(data, _LITTLE, n_segments * width, offset)
            arrays[name] = values.astype(np.float64).reshape(shape)
            offset += 8 * n_segments * width
        else:
            arrays[name] = np.full(shape, np.nan)
    status = np.frombuffer(data, np.uint8, n_segments, _HEAD.size).copy()
    return SkeletonFrame(
        sequence=sequence,
        time_ns=time_ns,
        q_wb=arrays["q_wb"],
        angular_rate=arrays["angular_rate"],
        joint_acceleration=arrays["joint_acceleration"],
        p_w=arrays["p_w"],
        sigma=arrays["sigma"],
        status=status,
        root=root,
    )


_MARKERS_HEAD = struct.Struct("<qqHH")
_PLACE = np.dtype("<f4")
_SOURCE = np.dtype("<i2")


@dataclass(frozen=True, slots=True)
class RecordedMarkers:
    """What became of the markers of one recorded pose."""

    sequence: int
    time_ns: int
    """Those of the pose."""
    fit: MarkerFit


def frame_messages(frame: SkeletonFrame) -> Iterator[tuple[str, bytes]]:
    """Yield topic and message of everything that is recorded of a pose."""
    yield fmt.SKELETON, encode_skeleton_frame(frame)
    if frame.markers is not None:
        yield fmt.MARKERS, encode_markers_of(frame.sequence, frame.time_ns, frame.markers)


def encode_markers_of(sequence: int, time_ns: int, fit: MarkerFit) -> bytes:
    """Return a fit as bytes; places are rounded to single precision, less than 0.1 µm at 1 m."""
    source = np.arange(len(fit.used), dtype=_SOURCE)
    for marker, whose in fit.renamed:
        source[marker] = whose
    places = np.concatenate([fit.positions, fit.virtual, fit.unlabelled])
    head = _MARKERS_HEAD.pack(sequence, time_ns, len(fit.used), len(fit.unlabelled))
    return b"".join(
        (head, source.tobytes(), fit.used.astype(np.uint8).tobytes(), places.astype(_PLACE).tobytes())
    )


def decode_markers(data: bytes) -> RecordedMarkers:
    """Return what ``data`` was made of. Raises ``ValueError`` for bytes that are none."""
    if len(data) < _MARKERS_HEAD.size:
        raise ValueError(f"{len(data)} bytes tell of no markers")
    sequence, time_ns, n, n_nameless = _MARKERS_HEAD.unpack_from(data)
    expected = _MARKERS_HEAD.size + 3 * n + 12 * (2 * n + n_nameless)
    if len(data) != expected:
        raise ValueError(f"{n} markers and {n_nameless} nameless ones take {expected} bytes, not {len(data)}")
    source = np.frombuffer(data, _SOURCE, n, _MARKERS_HEAD.size)
    used = np.frombuffer(data, np.uint8, n, _MARKERS_HEAD.size + 2 * n)
    places = np.frombuffer(data, _PLACE, -1, _MARKERS_HEAD.size + 3 * n).astype(np.float64).reshape(-1, 3)
    positions, virtual, unlabelled = np.split(places, [n, 2 * n])
    # A marker whose source is another label was renamed to its own.
    renamed = tuple((m, whose) for m, whose in enumerate(source.tolist()) if whose != m)
    residuals = np.linalg.norm(positions - virtual, axis=1)
    return RecordedMarkers(
        sequence, time_ns, MarkerFit(positions, virtual, residuals, used != 0, renamed, unlabelled)
    )
