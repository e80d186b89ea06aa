"""Real recordings played as if their modules sent them. Sans-I/O.

What is played is ``devices.recorded_tracks``; the readers of public data sets are in ``data_sets``,
those of makers' files in ``devices.vendor_formats``.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterator

import numpy as np

from devices.emulators.delivery import Encoding, Transmission
from devices.emulators.device.status_reports import device_info
from devices.emulators.sensing.sample_encoding import SampleEncoder
from devices.recorded_tracks import FusedTrack, LocalTrack, ModuleTrack, RecordedTracks
from firmware_protocol import FusedSample, InertialSampleFine, LocalMeasurement, WireFrame, encode_packet

_SLOWER = "magnetic_field"
"""The sensor that may have no reading of an instant at which others have one."""

CLOCK_START_US = 1_000_000
"""What every module's counter shows at time 0 of a recording (some data begin before it)."""


def play(recording: RecordedTracks, encoding: Encoding | None = None) -> Iterator[Transmission]:
    """Yield what the modules would have sent, in order of time: (time in s, bytes) without any delay.

    Every module introduces itself, then sends its samples as ``InertialSampleFine``, and its own
    orientations as ``FusedSample``. The same recording always gives the same bytes.
    """
    encode = (encoding or Encoding()).encode
    senders = [_module_frames(track, recording.sampling_rate_hz) for track in recording.modules]
    senders += [_fused_frames(track) for track in recording.fused]
    senders += [_local_frames(track) for track in recording.local]
    for time_s, frame in heapq.merge(*senders, key=lambda timed: timed[0]):
        yield Transmission(time_s, encode(frame))


def _module_frames(track: ModuleTrack, sampling_rate_hz: float) -> Iterator[tuple[float, WireFrame]]:
    sensors = track.sensors
    first_s = float(track.times[0])
    info = device_info(struct.pack("<8sI", b"RECORDED", track.module), sampling_rate_hz, sensors)
    yield first_s, WireFrame(info.KIND, track.module, 0, _clock_us(first_s), encode_packet(info))
    bodies = _bodies(track, sensors)
    # Rows that the recording lacks are packets that were lost: their numbers stay unused.
    for row in sorted(bodies):
        time_s = float(track.times[row])
        frame = WireFrame(InertialSampleFine.KIND, track.module, row % 2**16, _clock_us(time_s), bodies[row])
        yield time_s, frame


def _bodies(track: ModuleTrack, sensors: tuple[str, ...]) -> dict[int, bytes]:
    """Return the bodies of the samples that can be sent, by row."""
    known = {name: np.isfinite(getattr(track, name)).all(axis=1) for name in sensors}
    is_sent = np.ones(len(track.times), dtype=np.bool_)
    for name in sensors:
        if name != _SLOWER:
            is_sent &= known[name]
    has_field = known.get(_SLOWER, np.zeros_like(is_sent))
    found: dict[int, bytes] = {}
    for present, rows in (
        (sensors, np.flatnonzero(is_sent & has_field)),
        (tuple(name for name in sensors if name != _SLOWER), np.flatnonzero(is_sent & ~has_field)),
    ):
        if len(rows) and present:
            readings = {name: getattr(track, name)[rows] for name in present}
            bodies = SampleEncoder(InertialSampleFine, present).encode(readings)
            found.update(zip(rows.tolist(), bodies, strict=True))
    return found


def _fused_frames(track: FusedTrack) -> Iterator[tuple[float, WireFrame]]:
    before_s = float(track.times[0])
    for row in np.flatnonzero(np.isfinite(track.q_es).all(axis=1)).tolist():
        time_s = float(track.times[row])
        w, x, y, z = track.q_es[row].tolist()
        body = encode_packet(FusedSample((w, x, y, z), (0.0, 0.0, 0.0), time_s - before_s))
        before_s = time_s
        yield time_s, WireFrame(FusedSample.KIND, track.module, row % 2**16, _clock_us(time_s), body)


def _local_frames(track: LocalTrack) -> Iterator[tuple[float, WireFrame]]:
    sigma = (track.sigma,) * 3
    kind = LocalMeasurement.KIND
    for row in np.flatnonzero(np.isfinite(track.values).all(axis=1)).tolist():
        time_s = float(track.times[row])
        x, y, z = track.values[row].tolist()
        body = encode_packet(LocalMeasurement(track.quantity, (x, y, z), sigma))
        yield time_s, WireFrame(kind, track.module, row % 2**16, _clock_us(time_s), body)


def _clock_us(time_s: float) -> int:
    return (CLOCK_START_US + round(time_s * 1e6)) % 2**32
