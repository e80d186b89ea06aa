"""Skeleton frames to bytes and back, bit for bit; the layout is told in ``devices.recording_format``."""

from __future__ import annotations

import struct

import numpy as np

from gateway.frames import FloatArray, SkeletonFrame

_HEAD = struct.Struct("<qqiHBB")
_ARRAYS = (("q_wb", 4), ("angular_rate", 3), ("joint_acceleration", 3), ("p_w", 3), ("sigma", 1))
"""Fields in the order of their bits, with the numbers a segment."""
_UNDEFINED = np.float64(np.nan).tobytes()
_LITTLE = np.dtype("<f8")


def encode_skeleton_frame(frame: SkeletonFrame) -> bytes:
    """A frame as bytes. An array that is NaN throughout (the usual NaN, to the bit) is left out."""
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
    """The frame that ``data`` was made of. Raises ``ValueError`` for bytes that are none."""
    if len(data) < _HEAD.size:
        raise ValueError(f"{len(data)} bytes are no skeleton frame")
    sequence, time_ns, root, n_segments, mask, _ = _HEAD.unpack_from(data)
    offset = _HEAD.size + n_segments
    present = [(name, width) for bit, (name, width) in enumerate(_ARRAYS) if mask >> bit & 1]
    expected = offset + 8 * n_segments * sum(width for _, width in present)
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
        sequence,
        time_ns,
        arrays["q_wb"],
        arrays["angular_rate"],
        arrays["joint_acceleration"],
        arrays["p_w"],
        arrays["sigma"],
        status,
        root,
    )
