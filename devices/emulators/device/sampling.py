"""Samples that a device takes: when and how. What they hold is found out later, for many at once.

It samples by its own clock: evenly, until the host changes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from devices.emulators.bodies import FloatArray
from devices.emulators.device.emulated_flash import StoredSettings
from devices.emulators.device.sender import Sender, Timed
from devices.emulators.imperfections import ModuleClock

_NO_INSTANTS: FloatArray = np.empty(0)


class Schedule:
    """Instants ``phase + k interval`` of a clock, taken in order."""

    def __init__(self, clock: ModuleClock, interval_s: float, phase_s: float) -> None:
        self._clock = clock
        self._interval = interval_s
        self._phase = phase_s
        self._taken = 0

    def until(self, true_time: float) -> FloatArray:
        """Take the instants (n,) not yet taken that lie before a true time, by the clock, s."""
        instants = self.ahead(true_time)
        self._taken += len(instants)
        return instants

    def ahead(self, true_time: float) -> FloatArray:
        """Return the same instants without taking them."""
        end = self.count_before(self._clock.elapsed(true_time))
        if end <= self._taken:
            return _NO_INSTANTS
        return self._phase + np.arange(self._taken, end, dtype=np.float64) * self._interval

    def count_before(self, elapsed: float) -> int:
        """Return how many instants lie before one of the clock's times, s."""
        # An instant at that very time does not, whatever the rounding.
        return max(0, math.ceil((elapsed - self._phase) / self._interval - 1e-6))


class SamplingTimer:
    """One schedule after the other, with pauses, and a count of all samples."""

    def __init__(self, clock: ModuleClock) -> None:
        """Begin stopped."""
        self._clock = clock
        self._schedule: Schedule | None = None
        self._taken_before = 0

    def run(self, rate_hz: float, first_s: float) -> None:
        """Sample from the clock's time ``first_s`` on; ``stop`` first if it runs."""
        self._schedule = Schedule(self._clock, 1.0 / rate_hz, first_s)

    def stop(self, elapsed: float) -> None:
        """Take no sample from now on."""
        self._taken_before = self.count_before(elapsed)
        self._schedule = None

    def count_one(self) -> None:
        """Count a sample that is none of the timer's: a triggered one."""
        self._taken_before += 1

    def until(self, true_time: float) -> FloatArray:
        """Take the instants (n,) not yet taken before a true time, by the clock, s."""
        return _NO_INSTANTS if self._schedule is None else self._schedule.until(true_time)

    def ahead(self, true_time: float) -> FloatArray:
        """Return the same instants without taking them: what will be taken if nothing is changed."""
        return _NO_INSTANTS if self._schedule is None else self._schedule.ahead(true_time)

    def count_before(self, elapsed: float) -> int:
        """Return how many samples were taken before one of the clock's times, s."""
        running = 0 if self._schedule is None else self._schedule.count_before(elapsed)
        return self._taken_before + running


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
