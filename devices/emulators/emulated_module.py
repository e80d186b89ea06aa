"""What one emulated module says, and when: samples, who it is, how it fares. Sans-I/O.

A module knows only its own clock: "elapsed" is seconds since its start by that clock.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from devices.emulators.bodies import EmulatedLocalDevice, FloatArray
from devices.emulators.imperfections import ModuleClock, module_random
from devices.emulators.sample_encoding import SENSORS, SampleEncoder
from firmware_protocol import DeviceInfo, Health, LocalMeasurement, Packet, WireFrame, encode_packet

ACCELEROMETER_RANGE = 16 * 9.80665
GYROMETER_RANGE = math.radians(2000)
MAGNETOMETER_RANGE = 1600.0

_FIRMWARE_VERSION = (1, 0, 0)
_HARDWARE_VERSION = (1, 0)
_FULL_BATTERY_V, _EMPTY_BATTERY_V = 4.2, 3.4
_BATTERY_LIFE_S = 8 * 3600.0
_LOCAL_NOISE = 12


class Timed(NamedTuple):
    """A wire frame and the true time at which it is handed to the radio, s."""

    time_s: float
    frame: WireFrame


class Sender:
    """An id, a clock, and a sequence for every kind of wire frame."""

    def __init__(self, module: int, clock: ModuleClock) -> None:
        self.module = module
        self.clock = clock
        self.sequences: Counter[int] = Counter()
        """Wire frames sent so far, by kind."""

    def frame(self, kind: int, elapsed: float, body: bytes) -> Timed:
        """The next wire frame of this kind, stamped with the clock."""
        sequence = self.sequences[kind]
        self.sequences[kind] = sequence + 1
        wire_frame = WireFrame(kind, self.module, sequence % 2**16, self.clock.count_us(elapsed), body)
        return Timed(self.clock.true_time(elapsed), wire_frame)

    def packet(self, packet: Packet, elapsed: float) -> Timed:
        """The next wire frame of this packet's kind."""
        return self.frame(packet.KIND, elapsed, encode_packet(packet))


class Schedule:
    """Instants ``phase + k interval`` of a clock, taken in order."""

    def __init__(self, clock: ModuleClock, interval_s: float, phase_s: float) -> None:
        self._clock = clock
        self._interval = interval_s
        self._phase = phase_s
        self._taken = 0

    def until(self, true_time: float) -> FloatArray:
        """The instants (n,) not yet taken that lie before a true time, by the clock, s."""
        end = max(self._taken, self.count_before(self._clock.elapsed(true_time)))
        k = np.arange(self._taken, end, dtype=np.float64)
        self._taken = end
        return self._phase + k * self._interval

    def count_before(self, elapsed: float) -> int:
        """How many instants lie before one of the clock's times."""
        # An instant at that very time does not, whatever the rounding.
        return max(0, math.ceil((elapsed - self._phase) / self._interval - 1e-6))


class StatusReports:
    """DeviceInfo at the start and every few seconds, Health every second."""

    def __init__(
        self,
        sender: Sender,
        samples: Schedule,
        info: DeviceInfo,
        info_interval_s: float,
        health_interval_s: float,
    ) -> None:
        self._sender = sender
        self._samples = samples
        self._info = info
        self._info_schedule = Schedule(sender.clock, info_interval_s, 0.0)
        # Modules were switched on one after the other: not all report at the same moment.
        self._health_schedule = Schedule(
            sender.clock, health_interval_s, health_interval_s * (0.1 + sender.module * 0.618034 % 0.9)
        )

    def until(self, true_time: float) -> list[Timed]:
        """Reports due before a true time, s."""
        infos = [self._sender.packet(self._info, at) for at in self._info_schedule.until(true_time).tolist()]
        healths = [
            self._sender.packet(_health(self._sender.module, at, self._samples.count_before(at)), at)
            for at in self._health_schedule.until(true_time).tolist()
        ]
        return infos + healths


class EmulatedModule:
    """An inertial module: encodes what its sensors read."""

    def __init__(self, sender: Sender, encoder: SampleEncoder, sampling_rate_hz: float) -> None:
        self.sender = sender
        self._encoder = encoder
        self.schedule = Schedule(sender.clock, 1.0 / sampling_rate_hz, sender.clock.phase_s)

    def samples(self, instants: FloatArray, readings: dict[str, FloatArray]) -> list[Timed]:
        """Samples taken at instants (n,) of its clock, from readings (n, 3) by sensor."""
        bodies = self._encoder.encode(readings)
        frame, kind = self.sender.frame, self._encoder.kind
        return [frame(kind, at, body) for at, body in zip(instants.tolist(), bodies, strict=True)]


class EmulatedLocalSender:
    """A local measuring device: adds its noise and sends."""

    def __init__(self, sender: Sender, device: EmulatedLocalDevice, seed: int) -> None:
        self.sender = sender
        self.device = device
        self.schedule = Schedule(sender.clock, 1.0 / device.rate_hz, sender.clock.phase_s)
        self._rng = module_random(seed, device.module, _LOCAL_NOISE)

    def measurements(self, instants: FloatArray, true_values: FloatArray) -> list[Timed]:
        """Measurements at instants (n,) of its clock, from true values (n, 3), world axes."""
        values = true_values + self.device.sigma * self._rng.standard_normal(true_values.shape)
        sigma = (self.device.sigma,) * 3
        return [
            self.sender.packet(LocalMeasurement(self.device.quantity, (x, y, z), sigma), at)
            for at, (x, y, z) in zip(instants.tolist(), values.tolist(), strict=True)
        ]


def device_info(unique_id: bytes, sampling_rate_hz: float, sensors: tuple[str, ...]) -> DeviceInfo:
    """Who a module is (12 bytes of id); the sensors it does not carry are absent."""
    has_acc, has_mag, has_gyr = (sensor in sensors for sensor in SENSORS)
    return DeviceInfo(
        unique_id=unique_id,
        hardware_version=_HARDWARE_VERSION,
        firmware_version=_FIRMWARE_VERSION,
        accelerometer_range=ACCELEROMETER_RANGE if has_acc else None,
        gyrometer_range=GYROMETER_RANGE if has_gyr else None,
        magnetometer_range=MAGNETOMETER_RANGE if has_mag else None,
        accelerometer_sampling_rate=sampling_rate_hz if has_acc else None,
        gyrometer_sampling_rate=sampling_rate_hz if has_gyr else None,
        magnetometer_sampling_rate=sampling_rate_hz if has_mag else None,
    )


def _health(module: int, elapsed: float, samples_taken: int) -> Health:
    charge = max(0.0, 0.97 - 0.005 * (module % 8) - elapsed / _BATTERY_LIFE_S)
    return Health(
        battery_percent=round(100 * charge),
        battery_voltage=round(_EMPTY_BATTERY_V + charge * (_FULL_BATTERY_V - _EMPTY_BATTERY_V), 3),
        temperature_celsius=round(31.0 - 8.0 * math.exp(-elapsed / 600.0), 2),
        rssi_dbm=-50 - module % 16,
        uptime_s=int(elapsed),
        samples_taken=samples_taken % 2**32,
        samples_dropped=0,
        sensor_errors=0,
        resets=0,
    )
