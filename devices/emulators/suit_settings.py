"""How an emulated suit is built: its settings, and its devices made by them, with their clocks, flash,
mountings and errors drawn. What is wrong with it is in ``imperfections``.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from devices.deferred import Rotation
from devices.emulators.bodies import NO_MODULE, EmulatedBody, FloatArray, IntArray
from devices.emulators.delivery import Encoding
from devices.emulators.device.emulated_card import EmulatedCard
from devices.emulators.device.emulated_device import EmulatedDevice, Equipment
from devices.emulators.device.emulated_flash import EmulatedFlash, provision
from devices.emulators.device.relay_device import RelayDevice
from devices.emulators.device.sampling import RAW
from devices.emulators.device.status_reports import DEFAULT_RANGES
from devices.emulators.imperfections import (
    Imperfections,
    ModuleClock,
    ModuleErrors,
    draw_clock,
    draw_errors,
    module_random,
)
from devices.emulators.makers.vendor_emulator import VendorEmulator
from devices.emulators.motion.motions import BodyMotion
from devices.emulators.sensing.ideal_sensors import GRAVITY, MAGNETIC_FIELD, SensedMotion
from devices.emulators.sensing.inertial_sampler import InertialSampler
from devices.emulators.sensing.light_sampler import Sunlight
from devices.emulators.sensing.sample_encoding import SampleEncoder
from firmware_protocol import RELAY, InertialSample, InertialSampleFine
from firmware_protocol.messages import DEVICE_INFO_INTERVAL_S
from firmware_protocol.samples import SENSORS


@dataclass(frozen=True)
class SuitSettings:
    """The suit as it was made and set up.

    Its devices go by numbers: those that the body gives as module ids. A device sends under its number
    until somebody has set it up otherwise.
    """

    sampling_rate_hz: float = 100.0
    """What the devices have stored; they do so in steps of 0.1 Hz."""
    module_rates_hz: Mapping[int, float] = field(default_factory=dict)
    """Sampling rates of single devices that differ."""
    sensors: tuple[str, ...] = SENSORS
    """What every module carries."""
    module_modes: Mapping[int, int] = field(default_factory=dict)
    """Modes of single inertial modules that differ from ``mode``."""
    is_fine: bool = False
    """Send ``InertialSampleFine`` instead of ``InertialSample``."""
    mode: int = 2
    """Mode that inertial modules have stored: 1 fused on board, 2 raw, 3 on trigger."""
    has_relay: bool = False
    """A relay gathers all packets and forwards batches (byte streams only)."""
    has_card: bool = True
    """The relay has a memory card."""
    encoding: Encoding = field(default_factory=Encoding)
    emulator: Callable[[int], VendorEmulator] | None = None
    """Language of another maker that the inertial modules speak, by number, each on a link of its own."""
    stored_ids: Mapping[int, int] = field(default_factory=dict)
    """Ids that devices have stored, by number, where they differ: swapped modules, or two of one id."""
    fresh: frozenset[int] = frozenset()
    """Devices that come from the factory: nothing stored, all of id 0."""
    gravity: FloatArray = field(default_factory=GRAVITY.copy)
    """(3,) world, m/s²."""
    magnetic_field: FloatArray = field(default_factory=MAGNETIC_FIELD.copy)
    """(3,) world, µT."""
    sunlight: Sunlight | None = None
    """What the modules' photoelectric cells see; None: they have none."""
    info_interval_s: float = DEVICE_INFO_INTERVAL_S
    health_interval_s: float = 1.0
    block_s: float = 0.5
    """Length of the blocks in which ``SuitTraffic.transmissions`` computes what is sent."""

    def rate(self, number: int) -> float:
        """Return the sampling rate that a device has stored, Hz."""
        return self.module_rates_hz.get(number, self.sampling_rate_hz)


ERRORS, CLOCK, RADIO, HOST, UPLINK, AIR = range(6)
"""Purposes of random streams."""


class SuitParts:
    """What a suit is made from, and all that is drawn for it."""

    def __init__(
        self, motion: BodyMotion, settings: SuitSettings, imperfections: Imperfections, seed: int
    ) -> None:
        self._motion = motion
        self._settings = settings
        self._imperfections = imperfections
        self._seed = seed
        ids = motion.body.module_ids
        self._segments = np.flatnonzero(ids != NO_MODULE)
        self.inertial: tuple[int, ...] = tuple(ids[self._segments].tolist())
        """Numbers of the inertial modules, in the order of their segments."""

    def random(self, number: int, purpose: int) -> np.random.Generator:
        """Return the random stream of a device for one purpose."""
        return module_random(self._seed, number, purpose)

    def modules(self) -> dict[int, EmulatedDevice]:
        """Return the inertial modules and the local measuring devices, by number."""
        settings, local = self._settings, self._motion.body.local_devices
        rates = {number: settings.rate(number) for number in self.inertial}
        devices = {
            number: self._device(
                number, rate_hz, settings.module_modes.get(number, settings.mode), settings.sensors
            )
            for number, rate_hz in rates.items()
        }
        return devices | {d.module: self._device(d.module, d.rate_hz, RAW, ()) for d in local}

    def relay(self, numbers: Iterable[int]) -> RelayDevice:
        """Return a relay as fast as the fastest of those devices."""
        settings = self._settings
        fastest = max((settings.rate(number) for number in numbers), default=settings.sampling_rate_hz)
        flash = EmulatedFlash(seed=self._seed)
        provision(flash, {"sampling_rate": fastest})
        return RelayDevice(
            self._equipment(RELAY, (), fixed_id=RELAY),
            self._clock(RELAY, fastest),
            flash,
            1.0 / fastest,
            EmulatedCard() if settings.has_card else None,
        )

    def sampler(self, devices: dict[int, EmulatedDevice]) -> InertialSampler:
        """Return what samples the inertial modules among the devices."""
        settings = self._settings
        errors = {
            number: draw_errors(self._imperfections, self.random(number, ERRORS)) for number in self.inertial
        }
        arms, R_bs = _mountings(self._motion.body, self._segments, list(errors.values()))
        motion = SensedMotion(
            self._motion, self._segments, arms, R_bs, settings.gravity, settings.magnetic_field
        )
        return InertialSampler(
            motion,
            SampleEncoder(InertialSampleFine if settings.is_fine else InertialSample, settings.sensors),
            self._imperfections,
            errors,
            self._seed,
            {number: device.disturbances for number, device in devices.items()},
            settings.sunlight,
        )

    def _device(self, number: int, rate_hz: float, mode: int, sensors: tuple[str, ...]) -> EmulatedDevice:
        flash = EmulatedFlash(seed=self._seed + number)
        # A device fresh from the factory has an empty flash, and so the factory's settings.
        if number not in self._settings.fresh:
            stored: dict[str, Any] = {
                "module_id": self._settings.stored_ids.get(number, number),
                "sampling_rate": rate_hz,
                "mode": mode,
                "accelerometer_range": DEFAULT_RANGES["specific_force"],
                "magnetometer_range": DEFAULT_RANGES["magnetic_field"],
                "gyroscope_range": DEFAULT_RANGES["angular_rate"],
            }
            provision(flash, stored)
        return EmulatedDevice(self._equipment(number, sensors), self._clock(number, rate_hz), flash)

    def _equipment(self, number: int, sensors: tuple[str, ...], fixed_id: int | None = None) -> Equipment:
        return Equipment(
            number=number,
            unique_id=struct.pack("<8sHH", b"EMULATED", self._seed % 2**16, number),
            sensors=sensors,
            fixed_id=fixed_id,
            info_interval_s=self._settings.info_interval_s,
            health_interval_s=self._settings.health_interval_s,
        )

    def _clock(self, number: int, rate_hz: float) -> ModuleClock:
        return draw_clock(self._imperfections, self.random(number, CLOCK), 1.0 / rate_hz)


def _mountings(
    body: EmulatedBody, segments: IntArray, errors: list[ModuleErrors]
) -> tuple[FloatArray, FloatArray]:
    """Return where the modules are in truth: lever arms (M, 3), m, and rotations (M, 3, 3) to the segment."""
    shifts = np.array([e.placement for e in errors]).reshape(-1, 3)
    turns = np.array([e.placement_rotation for e in errors]).reshape(-1, 3, 3)
    nominal = Rotation.from_quat(body.sensor_to_segment[segments], scalar_first=True).as_matrix()
    return body.module_positions[segments] + shifts, nominal @ turns
