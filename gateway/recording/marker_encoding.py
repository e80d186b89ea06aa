"""What became of markers to bytes and back; the layout is told in ``devices.recording_format``."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from devices import recording_format as fmt
from gateway.frames import MarkerFit, SkeletonFrame
from gateway.recording.skeleton_encoding import encode_skeleton_frame

_HEAD = struct.Struct("<qqHH")
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
    """Topic and message of everything that is recorded of a pose."""
    yield fmt.SKELETON, encode_skeleton_frame(frame)
    if frame.markers is not None:
        yield fmt.MARKERS, encode_markers_of(frame.sequence, frame.time_ns, frame.markers)


def encode_markers_of(sequence: int, time_ns: int, fit: MarkerFit) -> bytes:
    """As bytes; places are rounded to single precision, less than 0.1 µm at 1 m."""
    source = np.arange(len(fit.used), dtype=_SOURCE)
    for marker, whose in fit.renamed:
        source[marker] = whose
    places = np.concatenate([fit.positions, fit.virtual, fit.unlabelled])
    head = _HEAD.pack(sequence, time_ns, len(fit.used), len(fit.unlabelled))
    return b"".join(
        (head, source.tobytes(), fit.used.astype(np.uint8).tobytes(), places.astype(_PLACE).tobytes())
    )


def decode_markers(data: bytes) -> RecordedMarkers:
    """What ``data`` was made of. Raises ``ValueError`` for bytes that are none."""
    if len(data) < _HEAD.size:
        raise ValueError(f"{len(data)} bytes tell of no markers")
    sequence, time_ns, n, n_nameless = _HEAD.unpack_from(data)
    expected = _HEAD.size + 3 * n + 12 * (2 * n + n_nameless)
    if len(data) != expected:
        raise ValueError(f"{n} markers and {n_nameless} nameless ones take {expected} bytes, not {len(data)}")
    source = np.frombuffer(data, _SOURCE, n, _HEAD.size)
    used = np.frombuffer(data, np.uint8, n, _HEAD.size + 2 * n)
    places = np.frombuffer(data, _PLACE, -1, _HEAD.size + 3 * n).astype(np.float64).reshape(-1, 3)
    positions, virtual, unlabelled = np.split(places, [n, 2 * n])
    renamed = tuple((m, whose) for m, whose in enumerate(source.tolist()) if whose != m)
    residuals = np.linalg.norm(positions - virtual, axis=1)
    return RecordedMarkers(
        sequence, time_ns, MarkerFit(positions, virtual, residuals, used != 0, renamed, unlabelled)
    )
