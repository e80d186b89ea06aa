"""A capture of modules as one kind of value: what readers of files give, whoever made them.

They are read by ``devices.vendor_formats`` and ``devices.emulators.data_sets``, and played as
modules would have sent them by ``devices.emulators.playback``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from firmware_protocol.samples import SENSORS

FloatArray = NDArray[np.float64]

NOMINAL_FIELD_UT = 50.0
"""Mean norm that magnetic readings in arbitrary units are scaled to, module by module, µT."""

_WILDEST = 10.0
"""Times the usual norm of a field; beyond, a reading is no field."""


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
