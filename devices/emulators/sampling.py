"""Samples that a device takes: when and how. What they hold is found out later, for many at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from devices.emulators.bodies import FloatArray
from devices.emulators.sender import Sender, Timed
from devices.emulators.stored_settings import StoredSettings

FUSED, RAW, TRIGGERED = 1, 2, 3
"""Values of the setting ``mode``."""


class SampleSettings(NamedTuple):
    """The settings that samples depend on."""

    mode: int
    rate_hz: float
    ranges: Mapping[str, float]
    """Largest reading of an axis by sensor, SI and µT."""
    calibration: tuple[float, ...]
    """(30,) as the setting declares."""

    @classmethod
    def of(cls, settings: StoredSettings) -> SampleSettings:
        """Return the settings as a device has them stored."""
        return cls(
            mode=settings["mode"],
            rate_hz=round(settings["sampling_rate"], 1),  # a step is 0.1 Hz
            ranges={
                "specific_force": settings["accelerometer_range"],
                "magnetic_field": settings["magnetometer_range"],
                "angular_rate": settings["gyroscope_range"],
            },
            calibration=tuple(settings["calibration"]),
        )


class Trigger(NamedTuple):
    """What made a device sample besides its timer."""

    number: int
    """Chosen by the host."""
    sent_s: float
    """True time at which the sample is sent, s."""


class Sampling(NamedTuple):
    """A run of samples of one device under the same settings."""

    device: int
    """Number of the device."""
    sender: Sender
    instants: FloatArray
    """(n,) by the sender's clock, s, n > 0."""
    settings: SampleSettings
    stream: int
    """Another one when the device has begun anew, or in another mode."""
    trigger: Trigger | None = None

    @property
    def times(self) -> FloatArray:
        """(n,) true times, s."""
        return self.sender.clock.true_time(self.instants)

    def frame(self, kind: int, elapsed: float, body: bytes) -> Timed:
        """Return one of the samples as a wire frame; a triggered one bears the trigger's number."""
        if self.trigger is None:
            return self.sender.frame(kind, elapsed, body)
        timed = self.sender.numbered(kind, elapsed, body, self.trigger.number)
        return timed._replace(time_s=self.trigger.sent_s)
