"""How an emulated suit is built; what is wrong with it is in ``imperfections``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from devices.emulators.bodies import FloatArray
from devices.emulators.delivery import Encoding
from devices.emulators.makers.vendor_emulator import VendorEmulator
from devices.emulators.sensing.ideal_sensors import GRAVITY, MAGNETIC_FIELD
from devices.emulators.sensing.light_sampler import Sunlight
from devices.emulators.sensing.sample_encoding import SENSORS
from firmware_protocol.messages import DEVICE_INFO_INTERVAL_S


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
