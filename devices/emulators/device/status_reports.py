"""What a device says of itself on its own: who it is, how it fares. Sans-I/O."""

from __future__ import annotations

import math
from collections.abc import Mapping

from devices.emulators.device.sampling import SamplingTimer, Schedule
from devices.emulators.device.sender import Sender, Timed
from firmware_protocol import DeviceInfo, Health
from firmware_protocol.samples import SENSORS, STANDARD_GRAVITY

DEFAULT_RANGES: Mapping[str, float] = {
    "specific_force": 16 * STANDARD_GRAVITY,
    "magnetic_field": 1600.0,
    "angular_rate": math.radians(2000),
}
"""Largest reading of an axis by sensor, SI and µT."""

_FIRMWARE_VERSION = (1, 0, 0)
_HARDWARE_VERSION = (1, 0)
_FULL_BATTERY_V, _EMPTY_BATTERY_V = 4.2, 3.4
_BATTERY_LIFE_S = 8 * 3600.0


class StatusReports:
    """DeviceInfo at the start and every few seconds, Health every second."""

    def __init__(
        self,
        sender: Sender,
        samples: SamplingTimer,
        info: DeviceInfo,
        info_interval_s: float,
        health_interval_s: float,
        resets: int = 0,
    ) -> None:
        self.sender = sender
        self.info = info
        self._samples = samples
        self._resets = resets
        self._info_schedule = Schedule(sender.clock, info_interval_s, 0.0)
        # Modules were switched on one after the other: not all report at the same moment.
        self._health_schedule = Schedule(
            sender.clock, health_interval_s, health_interval_s * (0.1 + sender.module * 0.618034 % 0.9)
        )

    def until(self, true_time: float) -> list[Timed]:
        """Return reports due before a true time, s."""
        infos = [self.sender.packet(self.info, at) for at in self._info_schedule.until(true_time).tolist()]
        healths = [
            self.sender.packet(self.health(at), at) for at in self._health_schedule.until(true_time).tolist()
        ]
        return infos + healths

    def health(self, elapsed: float) -> Health:
        """Return how the device fares at a time of its clock, s."""
        module = self.sender.module
        charge = max(0.0, 0.97 - 0.005 * (module % 8) - elapsed / _BATTERY_LIFE_S)
        return Health(
            battery_percent=round(100 * charge),
            battery_voltage=round(_EMPTY_BATTERY_V + charge * (_FULL_BATTERY_V - _EMPTY_BATTERY_V), 3),
            temperature_celsius=round(31.0 - 8.0 * math.exp(-elapsed / 600.0), 2),
            rssi_dbm=-50 - module % 16,
            uptime_s=int(elapsed),
            samples_taken=self._samples.count_before(elapsed) % 2**32,
            samples_dropped=0,
            sensor_errors=0,
            resets=self._resets % 2**16,
        )


def device_info(
    unique_id: bytes,
    sampling_rate_hz: float,
    sensors: tuple[str, ...],
    ranges: Mapping[str, float] = DEFAULT_RANGES,
) -> DeviceInfo:
    """Return who a device is (12 bytes of id); sensors that it lacks are absent."""
    acc, mag, gyr = (
        (ranges[name], sampling_rate_hz) if name in sensors else (None, None) for name in SENSORS
    )
    return DeviceInfo(
        unique_id=unique_id,
        hardware_version=_HARDWARE_VERSION,
        firmware_version=_FIRMWARE_VERSION,
        accelerometer_range=acc[0],
        gyroscope_range=gyr[0],
        magnetometer_range=mag[0],
        accelerometer_sampling_rate=acc[1],
        gyroscope_sampling_rate=gyr[1],
        magnetometer_sampling_rate=mag[1],
    )
