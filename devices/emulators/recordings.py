"""Real recordings as one kind of value, and played as if their modules sent them. Sans-I/O.

The readers of the data sets are in ``recording_formats``.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from devices.emulators.bodies import FloatArray
from devices.emulators.delivery import Encoding, Transmission
from devices.emulators.device.status_reports import device_info
from devices.emulators.sensing.sample_encoding import SENSORS, SampleEncoder
from firmware_protocol import FusedSample, InertialSampleFine, LocalMeasurement, WireFrame, encode_packet

NOMINAL_FIELD_UT = 50.0
"""Mean norm that magnetic readings in arbitrary units are scaled to, module by module, µT."""

_WILDEST = 10.0
"""Times the usual norm of a field; beyond, a reading is no field."""

_SLOWER = "magnetic_field"
"""The sensor that may have no reading of an instant at which others have one."""

CLOCK_START_US = 1_000_000
"""What every module's counter shows at time 0 of a recording (some data begin before it)."""


@dataclass(frozen=True)
class ModuleTrack:
    """All samples of one module, sensor axes. A row with a NaN was lost: it is not sent, yet counted.

    One that lacks the field alone is sent without it: some magnetometers sample more slowly.
    """

    module: int
    name: str
    """Segment or place that wears it."""
    times: FloatArray  # (n,) s, increasing
    specific_force: FloatArray  # (n, 3) m/s²
    angular_rate: FloatArray  # (n, 3) rad/s
    magnetic_field: FloatArray  # (n, 3) µT; all NaN: the module has no magnetometer
    magnetic_scale: float = 1.0
    """µT for one unit of the source: what the magnetic readings were multiplied by."""

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors that gave any value at all, in wire order."""
        return tuple(name for name in SENSORS if np.isfinite(getattr(self, name)).any())


@dataclass(frozen=True)
class FusedTrack:
    """Orientations that a module fused itself. NaN rows were lost: not sent, yet counted."""

    module: int
    name: str
    times: FloatArray  # (n,) s, increasing
    q_es: FloatArray  # (n, 4) wxyz, sensor axes to a world with Z up


@dataclass(frozen=True)
class ReferenceTrack:
    """Reference orientation of what a module sits on. NaN rows where it is not known."""

    name: str
    """As the module's."""
    times: FloatArray  # (n,) s, on the clock of the module's times
    q_wb: FloatArray  # (n, 4) wxyz, to a world with Z up


@dataclass(frozen=True)
class LocalTrack:
    """All readings of a local measuring device, world axes. NaN rows were not measured."""

    module: int
    name: str
    times: FloatArray  # (n,) s
    quantity: int
    """As on the wire: 1 acceleration (m/s²), 2 velocity (m/s), 3 position (m)."""
    values: FloatArray  # (n, 3)
    sigma: float
    """Standard deviation of each component that the device claims, in the quantity's unit."""


@dataclass(frozen=True)
class RecordedTracks:
    """A capture as its modules delivered it, with what else is known of the motion."""

    name: str
    sampling_rate_hz: float
    modules: tuple[ModuleTrack, ...]
    references: tuple[ReferenceTrack, ...] = field(default=())
    local: tuple[LocalTrack, ...] = field(default=())
    fused: tuple[FusedTrack, ...] = field(default=())
    begun_utc_ns: int = 0
    """Wall clock at time 0, ns since 1970; 0: not known."""
    notes: tuple[str, ...] = field(default=())
    """What the user should know of how it was read."""

    @property
    def module_ids(self) -> tuple[int, ...]:
        """Modules, in order: those with raw readings, then those with orientations alone."""
        return tuple(dict.fromkeys(track.module for track in self._tracks))

    @property
    def names(self) -> dict[int, str]:
        """What each module is called."""
        return {track.module: track.name for track in self._tracks}

    @property
    def _tracks(self) -> tuple[ModuleTrack | FusedTrack, ...]:
        return (*self.modules, *self.fused)

    @property
    def duration_s(self) -> float:
        """Time of the last sample of any module, s."""
        return max(float(track.times[-1]) for track in self._tracks)

    def reference(self, name: str) -> ReferenceTrack:
        """Return the reference of a segment by name. Raises ``KeyError`` naming those there are."""
        for track in self.references:
            if track.name == name:
                return track
        raise KeyError(f"no reference for {name!r}; there are {[track.name for track in self.references]}")


def track_of(
    module: int,
    name: str,
    times: FloatArray,
    specific_force: FloatArray,
    angular_rate: FloatArray | None = None,
    magnetic_field: FloatArray | None = None,
) -> ModuleTrack:
    """Return a track in SI units.

    Magnetic readings, of any unit, are scaled to a mean norm of ``NOMINAL_FIELD_UT``. Sensors that are None
    were not there.
    """
    absent = np.full_like(specific_force, np.nan)
    rate = absent if angular_rate is None else angular_rate
    norm = 0.0 if magnetic_field is None else _usual_norm(magnetic_field)
    if magnetic_field is None or not norm:
        return ModuleTrack(module, name, times, specific_force, rate, absent)
    # Public recordings give the field in many units, or as a share: only its direction is common.
    scale = NOMINAL_FIELD_UT / norm
    return ModuleTrack(module, name, times, specific_force, rate, magnetic_field * scale, scale)


def _usual_norm(field: FloatArray) -> float:
    """Return the mean norm of readings (n, 3) without wild ones; 0 where a magnetometer tells nothing.

    One that is switched off gives zeros, or nothing at all.
    """
    norms = np.linalg.norm(field, axis=1)
    known = np.isfinite(norms)
    if not known.any():
        return 0.0
    # A single wild value would shrink all others: the mean is of those near the usual one.
    norms[~known | (norms > _WILDEST * np.median(norms[known]))] = np.nan
    return float(np.nanmean(norms)) if np.isfinite(norms).any() else 0.0


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
